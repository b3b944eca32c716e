"""Camera raw files: linear values of the sensor through rawpy (LibRaw), which `pip install 'relit[raw]'` installs.

A value is (count - black) / (white - black), with the levels that the file gives for each colour; it is negative where noise is. Nothing
else is applied: no white balance, no conversion of colours, no curve, no brightening, no denoising. The two colours that a pixel of the
mosaic lacks are means of the pixels of that colour around it, weighted by their distance; in a mosaic of 2 × 2 pixels this is bilinear
interpolation. It is linear, so that images still add up, and invents nothing brighter or darker than its neighbours.
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage import inputs
from stage.errors import ImageError
from stage.formats.exif import Exposure, sound, upright, upright_size

SUFFIXES = {".3fr", ".arw", ".cr2", ".cr3", ".crw", ".dcr", ".dng", ".erf", ".fff", ".iiq", ".kdc", ".mef", ".mos", ".mrw", ".nef", ".nrw",
            ".orf", ".pef", ".raf", ".rw2", ".rwl", ".sr2", ".srf", ".srw"}
ORIENTATIONS = {0: 1, 1: 2, 2: 4, 3: 3, 4: 5, 5: 8, 6: 6, 7: 7}
"""The orientation of EXIF by LibRaw's `flip`, whose bits mirror columns (1) and rows (2) and exchange both (4)."""
COLOURS = {"R": 0, "G": 1, "B": 2}
WEIGHTS = (1, 2, 1), (1, 4, 6, 4, 1)
"""Weights along rows and columns of the neighbours that colours are taken from, for mosaics of 2 × 2 pixels and for others."""

XYZ_FROM_REC709 = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
"""ITU-R BT.709 primaries with the white D65, in the digits that LibRaw uses."""
SINGULAR = 1e-9
"""The determinant below which a matrix of colours is no matrix: LibRaw holds zeros for cameras that it does not know."""


class RawHeader(NamedTuple):
    """Metadata of a camera raw file, read before its pixels are unpacked."""

    width: int  # of the upright image
    height: int
    orientation: int  # a key of `stage.formats.exif.TURNS`
    exposure: Exposure


def header_of(source: inputs.Source) -> RawHeader:
    """Read the size, the orientation and the exposure of a camera raw file that is open."""
    with _parsed(source) as raw:
        return _header(source, raw)


def decode(source: inputs.Source) -> np.ndarray:
    """Read the linear values of a camera raw file that is open, upright.
    Returns [rows, cols, 1 or 3] float32 in the colours of the sensor: 0 is black and 1 saturates. A pixel that takes part of a colour from
    a saturated one has at least 1 there. Raises ImageError if the file is damaged, of no known camera, has other colours than red, green
    and blue, or rawpy is not installed."""
    header = header_of(source)
    source.check_pixels(header.width, header.height)
    with _parsed(source) as raw:  # once more: LibRaw does not unpack what it has told the size of
        raw.unpack()
        names = raw.color_desc.decode("ascii", "replace")
        black = np.array(raw.black_level_per_channel, dtype=np.float32)
        # LibRaw takes the white level of most cameras from a table; the file of some knows better where they saturate
        white = np.full(4, raw.white_level, dtype=np.float32)
        limits = np.array(raw.camera_white_level_per_channel or [0] * 4, dtype=np.float32)
        white = np.where(limits > black, np.minimum(white, np.maximum(limits, 1)), white)
        if not (white > black).all():
            raise ImageError(f"{source.path}: its white level {white.min():g} is not above its black level {black.max():g}")
        counts = np.asarray(raw.raw_image_visible)
        if counts.ndim == 3:  # three colours in every pixel
            if counts.shape[2] < 3 or names[:3] != "RGB":
                raise ImageError(f"{source.path}: has the colours {names}: relit reads red, green and blue")
            values = (counts[..., :3].astype(np.float32) - black[:3]) / (white[:3] - black[:3])
        elif raw.num_colors == 1:
            values = ((counts.astype(np.float32) - black[0]) / (white[0] - black[0]))[..., None]
        else:
            if not set(names) <= set(COLOURS):
                raise ImageError(f"{source.path}: has a mosaic of the colours {names}: relit reads red, green and blue")
            index = np.asarray(raw.raw_colors_visible)
            mosaic = (counts.astype(np.float32) - black[index]) / (white - black)[index]
            values = demosaic(mosaic, np.array([COLOURS[name] for name in names], dtype=np.uint8)[index])
        return upright(np.ascontiguousarray(values), header.orientation)


def demosaic(mosaic: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """Return red, green and blue of every pixel of a mosaic.
    `mosaic`: [rows, cols] float32, 1 where the sensor saturates. `colour`: [rows, cols] 0 red, 1 green, 2 blue. Returns [rows, cols, 3]
    float32: the own colour of a pixel as it is, the others as means of those around it, and at least 1 where one of these is saturated."""
    import cv2  # a tenth of a second that captures of other images need not wait

    repeats_every_two = np.array_equal(colour[2:], colour[:-2]) and np.array_equal(colour[:, 2:], colour[:, :-2])
    weights = np.array(WEIGHTS[0 if repeats_every_two else 1], dtype=np.float32)
    near = np.ones((len(weights), len(weights)), np.uint8)
    result = np.empty((*mosaic.shape, 3), dtype=np.float32)
    for channel in range(3):
        own = colour == channel
        held = own.astype(np.float32)
        total = cv2.sepFilter2D(mosaic * held, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_CONSTANT)
        weight = cv2.sepFilter2D(held, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_CONSTANT)
        mean = np.where(weight > 0, total / np.where(weight > 0, weight, 1), 0)
        clipped = (own & (mosaic >= 1)).astype(np.uint8)
        if clipped.any():
            mean = np.where(cv2.dilate(clipped, near) > 0, np.maximum(mean, 1), mean)
        result[..., channel] = np.where(own, mosaic, mean)
    return result


def rec709_from_camera(path: str | Path) -> np.ndarray:
    """Return the matrix from the colours of a sensor, once white is balanced, to linear values with the primaries of Rec.709.
    Returns [3, 3] float64, whose rows add up to 1: what is white stays white. Raises ImageError if neither the file nor LibRaw knows the
    colours of this camera.

    Source:
        The matrices of cameras are those of Adobe's DNG Specification, ColorMatrix1 and 2, normalised as dcraw does.
    """
    with inputs.opened(path) as source, _parsed(source) as raw:
        raw.unpack()
        # LibRaw has a matrix from XYZ to the camera for most cameras, and for DNG files the one from the camera to Rec.709
        camera_from_xyz = np.array(raw.rgb_xyz_matrix[:3], np.float64)
        rec709_from_camera = np.array(raw.color_matrix, np.float64)[:, :3]
    if abs(np.linalg.det(camera_from_xyz)) > SINGULAR:
        camera = camera_from_xyz @ XYZ_FROM_REC709
        return np.asarray(np.linalg.inv(camera / camera.sum(axis=1, keepdims=True)))
    if abs(np.linalg.det(rec709_from_camera)) < SINGULAR:
        raise ImageError(f"{path}: neither the file nor LibRaw knows the colours of this camera: --colors camera keeps them")
    return np.asarray(rec709_from_camera / rec709_from_camera.sum(axis=1, keepdims=True))


@contextmanager
def _parsed(source: inputs.Source) -> Iterator[Any]:
    """Open a camera raw file with LibRaw, which has then read its tags and not yet its pixels."""
    if find_spec("rawpy") is None:
        raise ImageError(f"{source.path}: camera raw files are read with the extra raw: pip install 'relit[raw]'")
    import rawpy

    with source.reopened() as same:
        raw = rawpy.RawPy()
        try:
            raw.open_file(same)
            yield raw
        except rawpy.LibRawError as error:
            reason = error.args[0].decode() if error.args and isinstance(error.args[0], bytes) else str(error)
            raise ImageError(f"{source.path}: is no camera raw file that LibRaw reads, or it is damaged: {reason}") from error
        finally:
            raw.close()


def _header(source: inputs.Source, raw: Any) -> RawHeader:
    sizes, taken = raw.sizes, raw.other
    if min(sizes.width, sizes.height) < 1:
        raise ImageError(f"{source.path}: has {sizes.width}x{sizes.height} pixels")
    if not math.isclose(sizes.pixel_aspect, 1.0, abs_tol=0.005):
        raise ImageError(f"{source.path}: its pixels are {sizes.pixel_aspect:g} times as high as wide: relit reads square ones")
    orientation = ORIENTATIONS[sizes.flip & 7]
    return RawHeader(*upright_size(sizes.width, sizes.height, orientation), orientation,
                     Exposure(sound(taken.shutter_speed), sound(round(taken.aperture, 3)), sound(taken.iso_speed)))


def path_is_raw(path: str | Path) -> bool:
    """Return whether the suffix of a path is that of a camera raw file."""
    return Path(path).suffix.lower() in SUFFIXES
