"""Pixels of a mask that show no light of any lamp: a black background, of which the readings are noise alone.

The noise of neighbouring pixels has nothing in common, and light from a lamp has. So a tile whose mean is small, and changes from lamp to
lamp by far less than each of its pixels, shows nothing, and such tiles, in the mask and around it, say how dark and how steady a pixel is
that no lamp lights. A pixel with readings above the noise differs from them in its mean over the lights, or in its variance.
"""

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from kernels.photometric.model.samples import evenly, some_of
from service.reporting.progress import Timings
from stage.stack.stack import Stack

SIDE, TILES, LEAST_TILES = 8, 512, 8
"""Pixels along a side of a tile, tiles that are spread over the image, and number of them without light that tell what no light is."""
COMMON = 0.12
"""Largest part of the variance of its pixels that the mean of a tile without light has: of independent noise under four lights 0.08 at the
99.9th percentile, and the mean of noise that is cut off at zero changes with its strength."""
EVEN = 3.0
"""Largest square of the mean of such a tile, over the variance of its pixels: 1.4 where the noise of three channels is cut off at zero. A
dark wall that faces the middle of a ring of lamps reads the same under each."""
DIM = 0.03
"""Largest part that the readings of a tile without light have, root mean square, of those of the brightest pixels."""
BRIGHTEST = 0.99
"""Quantile of the pixels of all tiles that the brightest are."""
DARKEST, ALIKE = 0.1, 2.0
"""Quantile of the power of these tiles, and factor on it up to which a tile is alike: others hold some pixels of the object."""
RARE, MARGIN = 0.01, 2.0
"""Part of their pixels that lie far from the middle, and factor on how far they do, up to which a pixel is without light: five standard
deviations of a mean."""
TRIED, LEAST_FOUND = 4096, 4
"""Pixels of the mask, spread over it, that are looked at first, and number of them without light from which all are."""


class _Range:
    """The means and variances over the lights that pixels without light have."""

    def __init__(self, mean: np.ndarray, variance: np.ndarray) -> None:
        self._middle = np.median(mean)
        self._reach = MARGIN * np.quantile(np.abs(mean - self._middle), 1 - RARE)
        self._variance = MARGIN * np.quantile(variance, 1 - RARE)

    def holds(self, readings: np.ndarray) -> np.ndarray:
        """Return which pixels are without light, [n] bool, of their `readings`, [lights, n]."""
        near = np.abs(readings.mean(axis=0) - self._middle) <= self._reach
        return np.asarray(near & (readings.var(axis=0) <= self._variance))


def unlit(stack: Stack, mask: np.ndarray, timings: Timings) -> np.ndarray:
    """Return the pixels of a mask that no lamp lights, [rows, cols] bool; none where no black background in the image shows its noise."""
    found = np.zeros(mask.size, bool)
    dark = _range(stack, mask.shape)
    if dark is None or dark.holds(_grey(stack, stack.pick(some_of(mask, TRIED))[0])).sum() < LEAST_FOUND:
        return found.reshape(mask.shape)
    timings.stage("background", mask.size)
    for start, stop in _bands(stack, mask):
        within = np.flatnonzero(mask.reshape(-1)[start:stop])
        found[start + within] = dark.holds(_grey(stack, stack.band(start, stop)[:, :, within]))
        timings.advance(min(stop, mask.size))
    return _large(found.reshape(mask.shape))


def _large(found: np.ndarray) -> np.ndarray:
    """Return found pixels, [rows, cols] bool, without those of regions smaller than a tile, which noise makes of a dim object."""
    region, _ = ndimage.label(found)
    return np.asarray((np.bincount(region.reshape(-1)) >= SIDE**2)[region] & found)


def _bands(stack: Stack, mask: np.ndarray) -> Iterator[tuple[int, int]]:
    return ((start, stop) for start, stop in stack.bands(8 * stack.light_count) if mask.reshape(-1)[start:stop].any())


def _range(stack: Stack, shape: tuple[int, ...]) -> _Range | None:
    """Return what pixels without light show, of an image of this shape; None where too few tiles are."""
    corners = [row * shape[1] + col for row in range(0, shape[0] - SIDE + 1, SIDE) for col in range(0, shape[1] - SIDE + 1, SIDE)]
    if len(corners) < LEAST_TILES:
        return None
    within = (np.arange(SIDE)[:, None] * shape[1] + np.arange(SIDE)).reshape(-1)
    tiles = np.array(corners)[evenly(len(corners), TILES), None] + within
    readings = _grey(stack, stack.pick(tiles.reshape(-1))[0]).reshape(-1, *tiles.shape)
    power = (readings**2).mean(axis=0)
    noise, common = readings.var(axis=0).mean(axis=1), readings.mean(axis=2)
    alone = (common.var(axis=0) <= COMMON * noise) & (common.mean(axis=0) ** 2 <= EVEN * noise)
    dark = np.flatnonzero(alone & (power.mean(axis=1) < DIM**2 * np.quantile(power, BRIGHTEST)))
    if len(dark) < LEAST_TILES:
        return None
    alike = dark[power[dark].mean(axis=1) <= ALIKE * np.quantile(power[dark].mean(axis=1), DARKEST)]
    return _Range(readings[:, alike].mean(axis=0), readings[:, alike].var(axis=0))


def _grey(stack: Stack, values: np.ndarray) -> np.ndarray:
    """Return stored values, [3, lights padded, n], as radiance [lights, n] float32, the mean of the channels."""
    count = stack.light_count
    return np.asarray(values[:, :count].astype(np.float32).mean(axis=0) * stack.scale[:count, None].astype(np.float32))
