"""The check of floating-point images: no value is impossible, and none is further below zero than the noise of the image explains.

Images of which a dark image was subtracted are noise around zero where no light falls. Setting the values below zero to zero would make
these places brighter than they are, so that they are kept. What is further below zero is no noise, but a fault of the subtraction, of a
filter or of a conversion between colour spaces.
"""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stage.errors import ImageError

NOISE_SIGMAS = 6.0
"""Standard deviations below zero down to which a value counts as noise: normal noise falls below in one of 10^9 readings."""
MANY_TRIPLES, MIN_TRIPLES = 500, 30
"""From the first number of triples of neighbours near zero on, the standard error of the noise is below a tenth. From fewer, as a small
shadow has, down to the second, the noise is taken larger by two of its standard errors."""
TRIPLES_ERROR = 1.2
"""The standard error, as a part of the noise, over 1 / √triples, which overlap: 0.9 of 50 to 1.2 of 900, of 400 images of noise."""
KEPT_PART, MEAN_OF_KEPT = 0.9, 0.6573
"""Part of the second differences, the smallest, from which noise is measured, so that edges do not count; and the mean absolute value of
this part of normal ones in standard deviations: sqrt(2 / pi) (1 - exp(-z² / 2)) / 0.9 with z = 1.645."""
FEW_PART = 0.1
"""Noise of few triples is believed if its floor is at most this part of the brightest value: else nothing tells it from what lies in the
image."""
SAMPLE = 1 << 20
"""About as many values of a larger image are looked at in each direction."""
WIDENS = 1.5
"""The factor by which the range of values near zero is widened where few lie in it."""
SHRINKS = 0.9
"""The range of values near zero is shrunk again while it becomes shorter than this part."""
STRIDE = 3
"""Pixels between the neighbours of a triple: demosaicing and filters make the noise of closer ones alike."""
ROUNDING = 1e-6
"""Part of the brightest value down to which a value below zero counts as rounding of the sums and filters of an image."""
RAW_STRAY = 1e-3
"""The part of the pixels of a camera raw image that may be below the noise: sensors have dead pixels, and the colours between pixels have
less noise than the recorded ones, so that the measured noise is below that of the latter. A wrong black level moves all dark pixels."""
HALF_INFINITY = 0x7C00
"""The bits of the half value infinity; NaN and values below zero have larger ones."""
CLIP_NEGATIVE = "--clip-negative sets such values to 0"
"""The advice in error messages of commands that have this option."""


def check_radiance(
    path: str | Path,
    pixels: np.ndarray,  # [rows, cols, channels] floating point
    *,
    remedy: str = "mend the image",  # what the message about negative values says can be done
    stray: float = 0.0,  # the part of the pixels that may be below the noise, such as RAW_STRAY
) -> None:
    """Check that no value is NaN, infinite, or further below zero than the noise of the image.
    Raises ImageError if some values are; the message counts the pixels and names the first."""
    if _is_plain_half(pixels):
        return
    check_finite(path, pixels)
    floor = noise_floor(pixels)
    if (pixels.min(axis=(0, 1)) >= floor).all():
        return
    negative = pixels < floor
    if negative.any() and negative.any(axis=-1).mean() > stray:
        found = _found(negative, "negative")
        raise ImageError(f"{path}: {found}, down to {float(pixels.min()):.4g} where noise explains {float(floor.max()):.2g}: {remedy}")


def check_finite(path: str | Path, pixels: np.ndarray) -> None:
    """Check that no value is NaN or infinite."""
    if _is_plain_half(pixels):
        return
    infinite = ~np.isfinite(pixels)
    if infinite.any():
        raise ImageError(f"{path}: {_found(infinite, 'not finite (NaN or infinity)')}: mend the image")


def clip_negative(pixels: np.ndarray) -> tuple[np.ndarray, int]:
    """Set the values to zero that are further below it than the noise of the image.
    `pixels`: [rows, cols, channels] floating point, finite. Returns the image, a copy if a value changes, and the number of pixels with
    such a value."""
    negative = pixels < noise_floor(pixels)
    count = int(negative.any(axis=-1).sum())
    return (np.where(negative, pixels.dtype.type(0), pixels) if count else pixels), count


def clipping_sentences(clipped: Mapping[str, int]) -> list[str]:
    """Return a sentence about values that were set to 0; none where nothing was."""
    if not clipped:
        return []
    most = max(clipped, key=lambda name: clipped[name])
    images = "1 image" if len(clipped) == 1 else f"{len(clipped)} images"
    return [f"images: {sum(clipped.values())} pixels of {images} were negative beyond the noise and set to 0 by --clip-negative, "
            f"{clipped[most]} of them in {most}."]


def noise_floor(pixels: np.ndarray) -> np.ndarray:
    """Return the value of each channel below which no noise around zero falls.

    The noise is measured on triples of neighbours that are as near to zero as the most negative value: their second differences leave
    out shading, as a systematic offset has none. Without such triples, as in rendered images, every negative value is too low.
    `pixels`: [rows, cols, channels] floating point, finite. Returns [channels] float32, at most 0."""
    lowest = np.minimum(pixels.min(axis=(0, 1)), 0).astype(np.float64)
    floor = np.zeros(pixels.shape[-1], dtype=np.float32)
    for channel in np.flatnonzero(lowest < 0):
        values = pixels[..., channel].astype(np.float32, copy=False)
        floor[channel] = -max(NOISE_SIGMAS * _noise_near_zero(values, -lowest[channel]), ROUNDING * float(values.max()))
    return floor


def _is_plain_half(pixels: np.ndarray) -> bool:
    """Return whether pixels are half values that are finite and not below zero: their bits are then below those of infinity."""
    return pixels.dtype == np.float16 and pixels.size > 0 and int(pixels.view(np.uint16).max()) < HALF_INFINITY


def _noise_near_zero(values: np.ndarray, most: float) -> float:
    """Return the standard deviation of the noise around zero of values, [rows, cols] float32; 0 where too few are there.

    The range of values that count as near zero begins at ±most, and shrinks to that which the noise explains. Where few are so dark, as in
    a narrow shadow, it is wider, up to FEW_PART of the brightest value: brighter values have no less noise.
    """
    brightest, count, noise = float(values.max()), 0, 0.0
    while True:
        differences = _second_differences(values, most)
        if len(differences) >= MIN_TRIPLES:
            count, kept = len(differences), int(KEPT_PART * len(differences))
            noise = float(np.partition(differences, kept)[:kept].mean(dtype=np.float64)) / MEAN_OF_KEPT / math.sqrt(6)
            if not 0 < NOISE_SIGMAS * noise < SHRINKS * most:
                break
            most = NOISE_SIGMAS * noise
        elif count:
            break
        else:
            most *= WIDENS
            if most > FEW_PART * brightest:
                return 0.0
    if count >= MANY_TRIPLES:
        return noise
    larger = noise * (1 + 2 * TRIPLES_ERROR / math.sqrt(count))
    return larger if NOISE_SIGMAS * larger <= FEW_PART * brightest else 0.0


def _second_differences(values: np.ndarray, most: float) -> np.ndarray:
    """Return the absolute second differences of the triples along rows and columns whose values lie within ±most, [triples] float32."""
    step = max(1, values.size // SAMPLE)
    first, middle, last = slice(None, -2 * STRIDE), slice(STRIDE, -STRIDE), slice(2 * STRIDE, None)
    found = []
    for grid in (values.T[:, ::step], values[:, ::step]):  # along rows, then along columns
        near = np.abs(grid) <= most
        found.append(np.abs(grid[first] - 2 * grid[middle] + grid[last])[near[first] & near[middle] & near[last]])
    return np.concatenate(found)


def _found(bad: np.ndarray, name: str) -> str:
    """Return how many pixels are bad, and where the first is."""
    where = bad.any(axis=-1)
    row, column = np.argwhere(where)[0]
    count = int(where.sum())
    return f"{f'{count} pixel is' if count == 1 else f'{count} pixels are'} {name}, the first at row {row}, column {column}"
