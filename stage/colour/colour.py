"""Conversion of pixels between colour spaces.

The arithmetic is OpenColorIO's, with the configuration of `stage.colour.configuration`.
"""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np
import PyOpenColorIO as ocio

from stage.colour.colour_spaces import Review, channels_apart, is_linear, linear_space
from stage.colour.configuration import current, loaded
from stage.colour.location import location
from stage.errors import ColourError
from stage.formats.images import fractions

LARGEST_INTEGER = 65535
"""The full scale of 16-bit images."""
ROUNDING = 1.2e-7
"""Difference from the fraction of an integer that decoders leave: an ulp of one, a hundredth of the step of 16-bit integers."""

BAND = 1 << 16
"""Most pixels that one thread converts at a time."""

GREY_WEIGHTS = (0.299, 0.587, 0.114)
"""The luma weights of red, green and blue by ITU-R BT.601: published photometric stereo figures are computed on this grey."""


def linearise(pixels: np.ndarray, space: str) -> np.ndarray:
    """Convert recorded values to scene-linear values, in the space that `linear_space` names.
    `pixels`: [rows, cols, channels], encoded in `space`: float32, or uint8 or uint16 as `images.read_recorded` returns them. `space`: a
    ColorSpaceName. Returns [rows, cols, channels] float32; `pixels` without a copy when they are float32 and `space` is linear already."""
    apart = channels_apart(space)
    if pixels.dtype.kind == "u":
        if not apart:
            return convert(np.take(fractions(pixels.dtype), pixels), space, linear_space(space))
        return np.take(_linear_of_codes(space, pixels.dtype, location()), pixels)
    if is_linear(space):
        return pixels
    if not apart:
        return convert(pixels, space, linear_space(space))
    steps, linear = _linear_of_integers(space, location())
    with np.errstate(invalid="ignore"):
        nearest = (np.clip(pixels, 0, 1) * np.float32(LARGEST_INTEGER) + np.float32(0.5)).astype(np.uint16)
    if np.abs(steps[nearest] - pixels).max(initial=0) <= ROUNDING:  # as in every integer image: a table is ten times as fast
        return linear[nearest]
    return convert(pixels, space, linear_space(space))


@cache
def _linear_of_codes(space: str, kind: np.dtype, configuration: str) -> np.ndarray:
    """Return the scene-linear value of each integer of an image: [256] or [65536] float32."""
    return linearise(fractions(kind)[None, :, None], space).reshape(-1)


@cache
def _linear_of_integers(space: str, configuration: str) -> tuple[np.ndarray, np.ndarray]:
    """Return [65536] float32, the fractions of full scale that 16-bit integers stand for, and their scene-linear values.

    Fractions of 255 are among them: 65535 is a multiple of it. The primaries stay, so that each channel is converted alone.
    """
    steps = (np.arange(LARGEST_INTEGER + 1) / LARGEST_INTEGER).astype(np.float32)
    return steps, convert(steps[None, :, None], space, linear_space(space))[0, :, 0]


def convert(pixels: np.ndarray, source: str, target: str) -> np.ndarray:
    """Convert pixels from one colour space to another.
    `pixels`: [rows, cols, 1 or 3] float32, encoded in `source`; one channel stands for equal red, green and blue. Returns float32 in the
    shape of `pixels`; of one channel, the red channel of the converted grey. Raises ColourError if the configuration lacks a space, or
    cannot convert."""
    if source == target:
        return pixels
    grey = pixels.shape[2] == 1
    converted = np.array(np.repeat(pixels, 3, axis=2) if grey else pixels, dtype=np.float32, order="C")
    try:
        for configuration, begin, end in current().steps(source, target):
            _apply(loaded(configuration).getProcessor(begin, end), converted)
    except ocio.Exception as error:
        raise ColourError(f"cannot convert {source} to {target}: {' '.join(str(error).split())}") from error
    return converted[..., :1] if grey else converted


def through_view(pixels: np.ndarray, space: str, review: Review) -> np.ndarray:
    """Convert pixels to those of a display, through a view.
    `pixels`: [rows, cols, 3] float32, encoded in `space`. `review`: the view and the looks. Returns [rows, cols, 3] float32, 0…1."""
    found = current()
    chosen, look = found.view(review.view), "" if review.look is None else found.checked_look(review.look)
    if chosen is None:
        return convert(pixels, space, "srgb_texture")
    if found.find(space) is None:
        pixels, space = convert(pixels, space, found.aces(space)), found.aces(space)
    shown, config, pipeline = np.array(pixels, dtype=np.float32, order="C"), loaded(found.location), ocio.LegacyViewingPipeline()
    pipeline.setDisplayViewTransform(ocio.DisplayViewTransform(space, *chosen))
    pipeline.setLooksOverrideEnabled(bool(look))
    pipeline.setLooksOverride(look)
    try:
        _apply(pipeline.getProcessor(config), shown)
    except ocio.Exception as error:
        raise ColourError(f"cannot show {space}: {' '.join(str(error).split())}") from error
    return shown


def _apply(processor: ocio.Processor, pixels: np.ndarray) -> None:
    """Convert [rows, cols, 3] float32 pixels in place, bands of them side by side."""
    rgb, convert_band = pixels.reshape(-1, 3), processor.getDefaultCPUProcessor().applyRGB
    bands = [rgb[begin : begin + BAND] for begin in range(0, len(rgb), BAND)]
    if len(bands) == 1:
        convert_band(rgb)
    else:
        with ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="relit-colour") as pool:
            list(pool.map(convert_band, bands))


def rgb_matrix(source: str, target: str) -> np.ndarray:
    """Return the matrix that converts column vectors from one scene-linear space to another.
    Returns [3, 3] float32: rgb in `target` = matrix @ rgb in `source`."""
    primaries = np.eye(3, dtype=np.float32)[None]  # one row of three pixels: red, green and blue
    return np.ascontiguousarray(convert(primaries, source, target)[0].T)
