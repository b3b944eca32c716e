"""The matte of a capture: how much of each pixel the object covers, for pictures that are put over another background.

A mask image with partial values is the matte. From a mask without them, the coverage of the pixels along its border is estimated from the
captured images. Before a dark background the reading of a pixel under a light is its coverage times the radiance of the object there, which
is extrapolated from the nearest pixels inside. The same coverage must explain the readings under every light; what differs from light to
light is the shading. It makes the rim darker than the pixels inside under most lights and brighter under few, so the coverage is an upper
quantile of the ratios, over the lights that light these pixels well.

Convention: the images before a dark background are premultiplied: they hold radiance times coverage.
Source: Porter and Duff, "Compositing Digital Images", SIGGRAPH 1984, section 2 (coverage and premultiplied colour).
"""

from collections.abc import Callable
from enum import StrEnum
from typing import NamedTuple

import cv2
import numpy as np

from stage.capture import Capture
from stage.stack import Stack

BORDER_PX = 2.5
"""The coverage of pixels so close to the border of the mask is estimated: the filter of a renderer and the blur of a good lens reach as
far, and masks are off by a pixel."""
CLEAR_PX = 3.5
"""From this distance outside the mask, a pixel shows the background alone."""
FAR_PX = 8.0
"""A pixel of the object or of the background tells about pixels up to this distance."""
DARK = 0.04
"""The background is dark where its mean reading is below this share of the object's beside it: such light raises a coverage by at most
as much."""
MOSTLY_DARK = 0.9
"""Where no background is near, as in a narrow hole, it counts as dark if this share of the other border pixels sees a dark one."""
CUT, RIM_QUANTILE, RIM_COVERAGE = 0.003, 0.1, 0.15
"""The images are cut along the mask where the pixels just outside hold less than the first number, a share of the object's radiance, and
this quantile of the coverage of those just inside is above the last. A mask that is wider than the object has pixels there with almost
nothing. Then all pixels of the mask count as whole, because shading alone makes its rim dark."""
LEAST_DARK = 0.5
"""Where a smaller share of the border sees a dark background, the object cannot be told from it."""
SPREAD = 0.02
"""The images are blurred beyond one pixel where the second ring of pixels outside holds this share of the object's radiance, or more."""
MOST_LIGHTS = 32
"""The count of lights that the coverage is estimated from, evenly spaced over those of the capture: more change it by less than .01."""
FEWEST_LIGHTS = 6
"""With fewer lights, the shading of single pixels cannot be told from their coverage."""
LIT_SHARE, QUANTILE = 0.5, 0.7
"""The share of the readings of a pixel that count, the brightest, and the quantile of their ratios that is the coverage: the pair with the
least error on rendered ellipsoids, matt and glossy, under lights around them and in front of them alone."""
STEP_PX, SLOPE = 2.5, 0.5
"""The step inwards over which the change of shading is measured, and the part of it that is taken to continue to the rim."""
CHUNK_PIXELS = 1 << 14
"""The count of border pixels that are estimated at one time: with their neighbours they take up to 200 MB."""
CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], dtype=np.uint8)
PARTIAL = (0.02, 0.98)
"""The values of a mask image between which a pixel counts as partly covered."""


class MatteSource(StrEnum):
    """What the coverage of a matte is known from."""

    FULL = "full"
    """There is no mask: everything is the object."""
    BACKGROUND = "background"
    """The background is lit, and the mask has no partial values that would part it from the object: the picture keeps it, everywhere
    whole."""
    MASK = "mask"
    """The mask, whose pixels are wholly covered or not at all."""
    MASK_IMAGE = "mask image"
    """The partial values of the mask image."""
    IMAGES = "images"
    """The captured images, along the border of the mask."""


class Matte(NamedTuple):
    """How much of each pixel the object covers."""

    coverage: np.ndarray  # [rows, cols] float32, 0…1
    factor: np.ndarray  # [rows, cols] float32, 0…1; a sum of captured images times it is premultiplied by `coverage`
    source: MatteSource
    hard: float
    """The share of the border whose coverage is that of the mask, without partial values, because the background there is not dark; 0…1."""


def matte_of(capture: Capture, stack: Stack) -> Matte:
    """Return the matte of a capture.

    Args:
        capture: its mask says where the object is.
        stack: its images, as recorded or aligned.

    Raises:
        ImageError: the mask is empty or unreadable.
    """
    mask = capture.mask()
    if mask.all():
        whole = np.ones(mask.shape, dtype=np.float32)
        return Matte(whole, whole, MatteSource.FULL if capture.manifest.mask is None else MatteSource.MASK, 0.0)
    readings = _Readings(stack, mask.shape[1])
    given = capture.mask_values()
    if ((given > PARTIAL[0]) & (given < PARTIAL[1])).any() and given.max() >= PARTIAL[1]:
        border = np.argwhere((given > 0) & (given < 1))
        inside, clear = given >= PARTIAL[1], (given <= 0) & (_distance(given > 0) > 1)
        dark = _dark(readings, border, inside if inside.any() else mask, clear)
        factor = given.copy()
        factor[border[dark, 0], border[dark, 1]] = 1
        return Matte(given, factor, MatteSource.MASK_IMAGE, 0.0)
    return _estimated(readings, mask)


def _estimated(readings: "_Readings", mask: np.ndarray) -> Matte:
    """Return the matte that the images give to a mask without partial values."""
    whole, coverage = np.ones(mask.shape, dtype=np.float32), mask.astype(np.float32)
    inside = _inside(mask, blurred=True)
    border = np.argwhere(_border(mask, inside, BORDER_PX))
    away = _distance(mask)
    dark = _dark(readings, border, inside if inside.any() else mask, away > min(CLEAR_PX, 0.99 * float(away.max())))
    if len(border) and dark.mean() < LEAST_DARK:
        return Matte(whole, whole, MatteSource.BACKGROUND, 1.0)
    if not inside.any() or not len(border) or readings.light_count < FEWEST_LIGHTS:
        return Matte(coverage, coverage, MatteSource.MASK, 1.0)
    known = np.ones(mask.shape, dtype=bool)
    known[border[~dark, 0], border[~dark, 1]] = False
    first, _ = _cover(readings, mask, inside, border[dark])
    if _is_cut(readings, mask, inside, known, first):
        return Matte(coverage, coverage, MatteSource.MASK, 0.0)
    # with the border where half is covered, the pixels that are wholly covered lie closer to it
    halved = np.where(known, first > 0.5, mask)
    blurred = _ring(readings, halved, inside, known, 1.0, 1.6) >= SPREAD
    inside = _inside(halved, blurred=blurred)
    border = np.argwhere(_border(halved, inside, BORDER_PX if blurred else 1.5) & known)
    if not inside.any():
        return Matte(coverage, coverage, MatteSource.MASK, 1.0)
    found, estimated = _cover(readings, halved, inside, border)
    coverage = np.where(known, found, coverage).astype(np.float32)
    hard = float(1 - np.mean(dark)) if estimated.any() else 1.0
    factor = np.where(known, coverage > 0, coverage).astype(np.float32)
    return Matte(coverage, factor, MatteSource.IMAGES if estimated.any() else MatteSource.MASK, hard)


class _Readings:
    """The readings of single pixels under lights that are evenly spaced over those of a stack."""

    def __init__(self, stack: Stack, width: int) -> None:
        count = stack.light_count
        self._stack, self._width, self.light_count = stack, width, count
        self._lights = np.unique(np.linspace(0, count - 1, min(count, MOST_LIGHTS)).round().astype(int))

    def of(self, pixels: np.ndarray) -> np.ndarray:
        """Return [n, lights · 3] float32 radiance of pixels [n] by their row-major indices, which lie close together."""
        first = int(pixels.min())
        values = self._stack.band(first, int(pixels.max()) + 1)
        picked = np.empty((len(pixels), len(self._lights), 3), dtype=np.float32)
        for row, light in enumerate(self._lights):
            for channel in range(3):
                picked[:, row, channel] = values[channel, light, pixels - first]
            picked[:, row] *= self._stack.scale[light]
        return picked.reshape(len(pixels), -1)

    def mean(self, places: np.ndarray) -> np.ndarray:
        """Return [n] the mean reading of places [n, 2] row and column."""
        means = [self.of(places[begin : begin + CHUNK_PIXELS] @ [self._width, 1]).mean(axis=1)
                 for begin in range(0, len(places), CHUNK_PIXELS)]
        return np.concatenate(means) if means else np.zeros(0, dtype=np.float32)

    def around(self, places: np.ndarray, inside: np.ndarray) -> np.ndarray:
        """Return [n, lights · 3] the mean of the 3 × 3 pixels around places [n, 2], of those that lie inside."""
        rows, cols = inside.shape
        offsets = np.array([(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1)])
        near = np.clip(places[:, None] + offsets, 0, [rows - 1, cols - 1])
        share = inside[near[..., 0], near[..., 1]] * np.exp(-0.5 * (offsets**2).sum(axis=1))
        indices, at = np.unique(near @ [self._width, 1], return_inverse=True)
        values, at = self.of(indices), at.reshape(near.shape[:2])
        total = np.zeros((len(places), values.shape[1]), dtype=np.float32)
        for offset in range(len(offsets)):
            total += values[at[:, offset]] * share[:, offset, None].astype(np.float32)
        return total / np.maximum(share.sum(axis=1), 1e-9)[:, None].astype(np.float32)


def _cover(readings: _Readings, mask: np.ndarray, inside: np.ndarray, border: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return [rows, cols] float32 coverage, 1 inside and estimated at border [n, 2], and [n] bool where there was an estimate."""
    coverage = mask.astype(np.float32)
    estimated = np.zeros(len(border), dtype=bool)
    nearest = _nearest(inside)
    limit = np.array(mask.shape) - 1
    for begin in range(0, len(border), CHUNK_PIXELS):
        places = border[begin : begin + CHUNK_PIXELS]
        at = nearest(places)
        away = (at - places).astype(np.float64)
        length = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        deeper = np.clip(np.rint(at + away / length * STEP_PX).astype(int), 0, limit)
        radiance = readings.around(at, inside)
        rise = np.where(inside[deeper[:, 0], deeper[:, 1], None], radiance - readings.around(deeper, inside), 0)
        radiance = np.clip(radiance + SLOPE * (length / STEP_PX).astype(np.float32) * rise, 0.25 * radiance, 4 * np.maximum(radiance, 0))
        counted = (radiance >= np.quantile(radiance, 1 - LIT_SHARE, axis=1, keepdims=True)) & (radiance > 0)
        usable = (length[:, 0] <= FAR_PX) & counted.any(axis=1)
        ratio = np.divide(readings.of(places @ [mask.shape[1], 1]), radiance, out=np.full_like(radiance, np.inf), where=counted)[usable]
        place = np.rint(QUANTILE * (counted[usable].sum(axis=1) - 1)).astype(int)
        found = np.take_along_axis(np.sort(ratio, axis=1), place[:, None], axis=1)[:, 0]
        coverage[places[usable, 0], places[usable, 1]] = np.clip(np.where(found < PARTIAL[0], 0, found), 0, 1)
        estimated[begin : begin + CHUNK_PIXELS] = usable
    return coverage, estimated


def _dark(readings: _Readings, border: np.ndarray, inside: np.ndarray, clear: np.ndarray) -> np.ndarray:
    """Return [n] bool: the background beside the border pixels [n, 2] is dark in comparison with the object."""
    if not clear.any():
        return np.zeros(len(border), dtype=bool)
    at, beyond = _nearest(inside)(border), _nearest(clear)(border)
    near = np.hypot(*(beyond - border).T) <= FAR_PX
    object_, background = readings.mean(at), readings.mean(beyond)
    dark = background < DARK * object_
    told = dark[near] if near.any() else dark
    return np.where(near, dark, told.mean() >= MOSTLY_DARK if len(told) else False)


def _is_cut(readings: _Readings, mask: np.ndarray, inside: np.ndarray, known: np.ndarray, coverage: np.ndarray) -> bool:
    """Return whether the images are 0 from the border of the mask on, and hold whole pixels within it."""
    rim = mask & known & ~cv2.erode(mask.astype(np.uint8), CROSS, borderValue=1).astype(bool)
    return (bool(rim.any()) and float(np.quantile(coverage[rim], RIM_QUANTILE)) > RIM_COVERAGE
            and _ring(readings, mask, inside, known, 0.0, 1.1) < CUT)


def _ring(readings: _Readings, mask: np.ndarray, inside: np.ndarray, known: np.ndarray, least: float, most: float) -> float:
    """Return the mean reading of the known pixels outside a mask at a range of distances, as a share of that inside."""
    away = _distance(mask)
    ring = np.argwhere((away > least) & (away <= most) & known)
    edge = np.argwhere(inside & (_distance(~mask) <= CLEAR_PX))
    if not len(ring) or not len(edge):
        return 0.0
    return float(readings.mean(ring).mean() / max(readings.mean(edge).mean(), 1e-20))


def _inside(mask: np.ndarray, *, blurred: bool) -> np.ndarray:
    """Return the pixels of a mask that the object covers wholly: all but those at the border, and the middle of thin parts."""
    if not blurred:
        return cv2.erode(mask.astype(np.uint8), CROSS, borderValue=1).astype(bool)
    depth = _distance(~mask)
    ridge = (depth >= 1.9) & (depth >= cv2.dilate(depth, np.ones((5, 5), np.uint8)))
    return mask & ((depth > BORDER_PX) | ridge)


def _border(mask: np.ndarray, inside: np.ndarray, reach: float) -> np.ndarray:
    return (mask & ~inside) | (~mask & (_distance(mask) <= reach))


def _distance(mask: np.ndarray) -> np.ndarray:
    """Return [rows, cols] float32 the distance of each pixel to the nearest pixel of a mask, 0 on it."""
    return np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5))


def _nearest(mask: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from places [n, 2], row and column, to the nearest pixels [n, 2] of a mask that is not empty."""
    _, label = cv2.distanceTransformWithLabels((~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    at = np.zeros((int(label.max()) + 1, 2), dtype=np.int64)
    at[label[mask]] = np.argwhere(mask)
    return lambda places: at[label[places[:, 0], places[:, 1]]]
