"""Flat field and dark frame from images of a white card and dark images, in the encoding that stage/stack/correction.py reads.

The correction subtracts the dark frame of the manifest from the flat field. The dark frame of the exposure of the white card is
therefore replaced by the dark frame of the manifest.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.colour.colour import convert, linearise
from stage.colour.colour_spaces import linear_space
from stage.colour.radiance import RAW_STRAY, check_radiance
from stage.errors import CalibrationError, ImageError
from stage.formats import images
from stage.formats.camera_raw import path_is_raw


class MeanImage(NamedTuple):
    """The mean of several images of one object, and their noise."""

    pixels: np.ndarray  # [rows, cols, 3] float64, linear
    noise: float
    """The root mean square of the difference of an image from the mean, over all pixels; 0 for one image."""
    images: int
    """The count of images."""


def mean_image(paths: Sequence[Path], capture: Capture, *, refuse_saturated: bool = False,
               progress: Callable[[int], None] | None = None) -> MeanImage:
    """Return the mean of images in linear values.

    Args:
        paths: image files with the resolution and the encoding of the capture.
        capture: the capture that gives resolution, colour space and saturation.
        refuse_saturated: True makes a saturated reading inside the mask an error.
        progress: called after every image with the count of images that have been read.

    Raises:
        CalibrationError: no image is given.
        ImageError: an image has another size, impossible values, or saturated readings; the message names it.
    """
    if not paths:
        raise CalibrationError("no image is given")
    manifest = capture.manifest
    mask = capture.mask() if refuse_saturated and manifest.saturation is not None else None
    total = np.zeros((capture.camera.height, capture.camera.width, 3))
    squares = 0.0
    for index, path in enumerate(paths):
        images.check_resolution(path, capture.camera.resolution)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        check_radiance(path, recorded, stray=RAW_STRAY if path_is_raw(path) else 0.0)
        if mask is not None and manifest.saturation is not None:
            count = int((np.any(recorded >= manifest.saturation, axis=-1) & mask).sum())
            if count:
                raise ImageError(f"{path}: {count} pixels are at or above the saturation of {manifest.saturation:g}: "
                                 "shorten the exposure")
        linear = linearise(recorded, manifest.color_space).astype(np.float64)
        total += linear
        squares += float((linear**2).mean())
        if progress is not None:
            progress(index + 1)
    mean = total / len(paths)
    variance = max(squares / len(paths) - float((mean**2).mean()), 0.0)
    return MeanImage(mean, variance**0.5, len(paths))


def make_flat(white: MeanImage, white_dark: MeanImage | None, capture: Capture) -> np.ndarray:
    """Return the flat field for the correction: white card minus its own dark frame, plus the dark frame of the capture.

    Args:
        white: the mean of the images of the white card.
        white_dark: the mean of dark images at the same exposure; None takes the dark frame of the capture for them.
        capture: the capture that gives the dark frame and the mask.

    Returns:
        [rows, cols, 3] float32, linear.

    Raises:
        CalibrationError: the card is not brighter than the dark frame somewhere in the mask.
    """
    dark = np.zeros_like(white.pixels)
    if capture.manifest.dark is not None:
        path = capture.file(capture.manifest.dark)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        check_radiance(path, recorded)
        dark = linearise(recorded, capture.manifest.color_space).astype(np.float64)
    light = white.pixels - (dark if white_dark is None else white_dark.pixels)
    unlit = int((light[capture.mask()] <= 0).any(axis=-1).sum())
    if unlit:
        raise CalibrationError(f"the white card is not brighter than the dark frame at {unlit} pixels of the mask")
    return np.maximum(light + dark, 0).astype(np.float32)


def recorded_values(linear: np.ndarray, capture: Capture) -> np.ndarray:
    """Encode linear values as the images of a capture are encoded.

    Args:
        linear: [rows, cols, 3] float32, scene-linear.
        capture: the capture that gives the colour space.

    Returns:
        [rows, cols, 3] float32.
    """
    space = capture.manifest.color_space
    return convert(np.ascontiguousarray(linear, dtype=np.float32), linear_space(space), space)
