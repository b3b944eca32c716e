"""White-card frames → flat.exr, dark frames → dark.exr, in the encoding and with the meaning that stage/correction.py reads.

Correction takes the dark off the flat itself, so a flat keeps as much dark as the manifest's dark holds: the dark of the white
card's own exposure is exchanged for it.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage import images
from stage.capture import Capture
from stage.colour import convert, linearise
from stage.colour_spaces import linear_space
from stage.errors import CalibrationError, ImageError

Progress = Callable[[int], None]
"""Called with how many images are read."""


class MeanImage(NamedTuple):
    """The mean of several images of one thing."""

    pixels: np.ndarray  # [rows, cols, 3] float64, linear
    noise: float
    """Root mean square of one image's difference from the mean, over all pixels; 0 for one image."""
    images: int


def mean_image(paths: Sequence[Path], capture: Capture, *, refuse_saturated: bool = False,
               progress: Progress | None = None) -> MeanImage:
    """Mean of images in linear values.

    Args:
        paths: image files of the capture's resolution and encoding.
        capture: says resolution, colour space and saturation.
        refuse_saturated: a saturated reading inside the mask is an error.
        progress: told after every image.

    Raises:
        CalibrationError: no image.
        ImageError: an image has another size, impossible values, or saturated readings; names it.
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
        images.check_radiance(path, recorded)
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
    """The flat field as correction reads it: white, less its own dark frame, plus the dark frame that correction takes off.

    Without `white_dark` the capture's dark is taken to be that of the white card too.

    Args:
        white: mean of the white-card frames.
        white_dark: mean of dark frames at their exposure, or None.
        capture: its dark frame and mask.

    Returns:
        [rows, cols, 3] float32, linear.

    Raises:
        CalibrationError: the card is not brighter than the dark frame somewhere in the mask.
    """
    dark = np.zeros_like(white.pixels)
    if capture.manifest.dark is not None:
        path = capture.file(capture.manifest.dark)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        images.check_radiance(path, recorded)
        dark = linearise(recorded, capture.manifest.color_space).astype(np.float64)
    light = white.pixels - (dark if white_dark is None else white_dark.pixels)
    unlit = int((light[capture.mask()] <= 0).any(axis=-1).sum())
    if unlit:
        raise CalibrationError(f"the white card is not brighter than the dark frame at {unlit} pixels of the mask")
    return np.maximum(light + dark, 0).astype(np.float32)


def recorded_values(linear: np.ndarray, capture: Capture) -> np.ndarray:
    """Linear values in the capture's encoding, so that they are read as its images are.

    Args:
        linear: [rows, cols, 3] float32.
    """
    space = capture.manifest.color_space
    return convert(np.ascontiguousarray(linear, dtype=np.float32), linear_space(space), space)
