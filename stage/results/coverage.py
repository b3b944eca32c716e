"""The coverage of pixels along the border of an object before a dark background, from their readings under many lights."""

from collections.abc import Iterator

import numpy as np

from stage.results.mask_border import nearest
from stage.stack.stack import Stack

DIM = 0.25
"""The background is dark where, seen through partly covered pixels alone, it is below this share of the object's radiance: shading at the
rim changes that estimate by about as much."""
DARK = 0.04
"""The background is dark where its mean reading is below this share of the object's beside it: such light raises a coverage by at most
as much."""
MOSTLY_DARK = 0.9
"""Where no background is near, as in a narrow hole, it counts as dark if this share of the other border pixels sees a dark one."""
MOST_LIGHTS = 24
"""The count of lights that the coverage is estimated from, evenly spaced over those of the capture: more change it by less than .01."""
LIT_SHARE, QUANTILE = 0.5, 0.7
"""The share of the readings of a pixel that count, the brightest, and the quantile of their ratios that is the coverage: the pair with the
least error on rendered ellipsoids, matt and glossy, under lights around them and in front of them alone."""
STEP_PX, SLOPE = 2.5, 0.5
"""The step inwards over which the change of shading is measured, and the part of it that is taken to continue to the rim."""
CHUNK_PIXELS = 1 << 14
"""The count of border pixels that are estimated at one time: with their neighbours they take up to 200 MB."""
LEAST_COVERAGE = 0.02
"""A smaller coverage is none: noise, and the light that a dark background reflects."""


class Readings:
    """The readings of single pixels under lights that are evenly spaced over those of a stack."""

    def __init__(self, stack: Stack, width: int) -> None:
        """Take the stack of the captured images, which are `width` pixels wide."""
        count = stack.light_count
        self._stack, self._width, self.light_count = stack, width, count
        self._lights = np.unique(np.linspace(0, count - 1, min(count, MOST_LIGHTS)).round().astype(int))

    def of(self, places: np.ndarray) -> np.ndarray:
        """Return [n, lights · 3] float32 radiance of places [n, 2], row and column, of one region of the image."""
        return self._at(places @ [self._width, 1])

    def _at(self, pixels: np.ndarray) -> np.ndarray:
        """Return [n, lights · 3] float32 radiance of pixels [n] by their row-major indices."""
        first = int(pixels.min())
        values = np.asarray(self._stack.band(first, int(pixels.max()) + 1))  # as a plain array, which is picked from faster than a map
        picked = np.empty((len(pixels), len(self._lights), 3), dtype=np.float32)
        for row, light in enumerate(self._lights):
            for channel in range(3):
                picked[:, row, channel] = values[channel, light, pixels - first]
            picked[:, row] *= self._stack.scale[light]
        return picked.reshape(len(pixels), -1)

    def mean(self, places: np.ndarray) -> np.ndarray:
        """Return [n] the mean reading of places [n, 2] row and column."""
        return np.concatenate([np.zeros(0, dtype=np.float32), *(values.mean(axis=1) for values in self._chunks(places))])

    def quantile(self, places: np.ndarray, share: float) -> np.ndarray:
        """Return [n] a quantile of the readings of places [n, 2] row and column."""
        return np.concatenate([np.zeros(0, dtype=np.float32), *(np.quantile(values, share, axis=1) for values in self._chunks(places))])

    def _chunks(self, places: np.ndarray) -> Iterator[np.ndarray]:
        return (self.of(places[begin : begin + CHUNK_PIXELS]) for begin in range(0, len(places), CHUNK_PIXELS))

    def around(self, places: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """Return [n, lights · 3] the mean of the 3 × 3 pixels around places [n, 2], of those that are whole."""
        rows, cols = whole.shape
        offsets = np.array([(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1)])
        near = np.clip(places[:, None] + offsets, 0, [rows - 1, cols - 1])
        share = whole[near[..., 0], near[..., 1]] * np.exp(-0.5 * (offsets**2).sum(axis=1))
        indices, at = np.unique(near @ [self._width, 1], return_inverse=True)
        values, at = self._at(indices), at.reshape(near.shape[:2])
        total = np.zeros((len(places), values.shape[1]), dtype=np.float32)
        for offset in range(len(offsets)):
            total += values[at[:, offset]] * share[:, offset, None].astype(np.float32)
        return total / np.maximum(share.sum(axis=1), 1e-9)[:, None].astype(np.float32)


def cover(readings: Readings, mask: np.ndarray, whole: np.ndarray, border: np.ndarray, far: float) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the coverage of border pixels.

    Args:
        mask: [rows, cols] bool, which stands where there is no estimate.
        whole: [rows, cols] bool, the pixels that the object covers wholly.
        border: [n, 2] rows and columns of the pixels to estimate.
        far: how far a whole pixel may be from a border pixel, in pixels.

    Returns:
        [rows, cols] float32 coverage, 0…1, and [n] bool where there was an estimate.
    """
    coverage = mask.astype(np.float32)
    estimated = np.zeros(len(border), dtype=bool)
    nearest_whole = nearest(whole)
    limit = np.array(mask.shape) - 1
    for begin in range(0, len(border), CHUNK_PIXELS):
        places = border[begin : begin + CHUNK_PIXELS]
        at = nearest_whole(places)
        away = (at - places).astype(np.float64)
        length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        deeper = np.clip(np.rint(at + away / length * STEP_PX).astype(int), 0, limit)
        radiance = readings.around(at, whole)
        rise = np.where(whole[deeper[:, 0], deeper[:, 1], None], radiance - readings.around(deeper, whole), 0)
        radiance = np.clip(radiance + SLOPE * (length / STEP_PX).astype(np.float32) * rise, 0.25 * radiance, 4 * np.maximum(radiance, 0))
        counted = (radiance >= np.quantile(radiance, 1 - LIT_SHARE, axis=1, keepdims=True)) & (radiance > 0)
        usable = (length[:, 0] <= far) & counted.any(axis=1)
        ratio = np.divide(readings.of(places), radiance, out=np.full_like(radiance, np.inf), where=counted)[usable]
        place = np.rint(QUANTILE * (counted[usable].sum(axis=1) - 1)).astype(int)
        found = np.take_along_axis(np.sort(ratio, axis=1), place[:, None], axis=1)[:, 0]
        coverage[places[usable, 0], places[usable, 1]] = np.clip(np.where(found < LEAST_COVERAGE, 0, found), 0, 1)
        estimated[begin : begin + CHUNK_PIXELS] = usable
    return coverage, estimated


def before_dark(readings: Readings, border: np.ndarray, whole: np.ndarray, clear: np.ndarray, far: float) -> np.ndarray:
    """Return [n] bool: the background beside a border pixel is dark in comparison with the object there.

    Args:
        whole: [rows, cols] bool, pixels of the object alone.
        clear: [rows, cols] bool, pixels of the background alone.
    """
    if not (len(border) and clear.any() and whole.any()):
        return np.zeros(len(border), dtype=bool)
    beyond = nearest(clear)(border)
    near = np.hypot(*(beyond - border).T) <= far
    dark = readings.mean(beyond) < DARK * readings.mean(nearest(whole)(border))
    return np.where(near, dark, np.mean(dark[near] if near.any() else dark) >= MOSTLY_DARK)


def mixed_with_dark(readings: Readings, border: np.ndarray, coverage: np.ndarray, whole: np.ndarray) -> bool:
    """Return whether border pixels of known coverage mix the object with a dark background, where no pixel shows the background alone.

    What they have beyond their coverage of the object's radiance is the background's.

    Args:
        border: [n, 2] rows and columns, at least one.
        coverage: [rows, cols] 0…1, below 1 at the border.
        whole: [rows, cols] bool, pixels of the object alone, at least one.
    """
    share = coverage[border[:, 0], border[:, 1]]
    beside = readings.mean(nearest(whole)(border))
    background = float(np.sum(readings.mean(border) - share * beside)) / max(float(np.sum((1 - share) * beside)), 1e-30)
    return background < DIM
