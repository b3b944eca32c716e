"""The matte of a capture: how much of each pixel the object covers, for pictures that are put over another background.

A mask image with partial values is the matte. From a mask without them, the coverage of the pixels along its border is estimated from the
captured images. Before a dark background the reading of a pixel under a light is its coverage times the radiance of the object there, which
is extrapolated from the nearest pixels inside. The same coverage must explain the readings under every light; what differs from light to
light is the shading. It makes the rim darker than the pixels inside under most lights and brighter under few, so the coverage is an upper
quantile of the ratios, over the lights that light these pixels well.

The rim of a mirror may be black under every light, which images cannot tell from the background. Where they put the outline far from that
of the mask, the coverage is that of the mask's own outline, smoothed, which is right to about a tenth.

Convention: the images before a dark background are premultiplied: they hold radiance times coverage.
Source: Porter and Duff, "Compositing Digital Images", SIGGRAPH 1984, section 2 (coverage and premultiplied colour).
"""

from collections.abc import Iterator
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.results.mask_border import SHARP_PX, border, distance, inside, nearest, outline_coverage, outline_offset, rim
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
REACHES_PX = (2.5, 5.0, 10.0)
"""The coverage of pixels so close to the border of the mask is estimated; the first of these distances counts outside of which the
background is dark. The filter of a renderer, the blur of a sharp lens and a mask that is a pixel off stay within the first; the others are
for objects out of focus."""
CLEAR_PX = 1.0
"""A pixel shows the background alone from this distance beyond the reach."""
FAR_PX = 6.0
"""A pixel of the object or of the background tells about pixels up to this distance beyond the reach."""
BRIGHT = 0.95
"""The quantile of the readings of a pixel that says how bright it is under some light: a rim that shading makes dark shines under some."""
CUT, LEAST_RIM, RIM_LIGHT = 0.003, 0.1, 0.15
"""The images are cut along the mask where the pixels just outside hold less than the first number, a share of the object's radiance, and
all but the second number, a share of the pixels just inside, are brighter than the third, a share of those further inside. A mask that is
wider than the object has pixels there with almost nothing. If the images are cut, all pixels of the mask count as whole."""
LEAST_DARK = 0.5
"""Least share of the border before a dark background; with less of it the object cannot be told from the background."""
FOLLOWED_PX, REFUSED_PX = 0.25, 0.55
"""Where the outline of the images lies inside that of the mask, up to the first distance the images count alone, from the second on the
mask. Light outside the mask is the object's."""
MASK_OFF_PX, MOST_OFF_PX = 0.3, 1.5
"""A mask counts as too narrow if the images put half of its outline by the first number of pixels further outside, or more; the second is
the most that counts."""
EMPTY = 0.03
"""A mask counts as too wide if half of its rim is darker than this, a share of the pixels further inside."""
SHARP_BLUR_PX, SOFT_BLUR_PX = 0.35, 0.6
"""The standard deviation of the filter of images that are sharp, a pixel wide, and of those that are not, as of renderers' Gaussians."""
SPREAD = 0.02
"""The images are blurred beyond one pixel where the second ring of pixels outside holds this share of the object's radiance, or more."""
FEWEST_LIGHTS = 6
"""With fewer lights, the shading of single pixels cannot be told from their coverage."""
ROUND = 0.001
"""A coverage that lacks less of 1 is 1."""
PARTIAL = (0.02, 0.98)
"""The values of a mask image between which a pixel counts as partly covered."""


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


def cover(
    readings: Readings,
    mask: np.ndarray,  # [rows, cols] bool, which stands where there is no estimate
    whole: np.ndarray,  # [rows, cols] bool, the pixels that the object covers wholly
    border: np.ndarray,  # [n, 2] rows and columns of the pixels to estimate
    far: float,  # how far a whole pixel may be from a border pixel, in pixels
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the coverage of border pixels. Returns [rows, cols] float32 coverage, 0…1, and [n] bool where there was an estimate."""
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
    `whole`: [rows, cols] bool, pixels of the object alone. `clear`: [rows, cols] bool, pixels of the background alone."""
    if not (len(border) and clear.any() and whole.any()):
        return np.zeros(len(border), dtype=bool)
    beyond = nearest(clear)(border)
    near = np.hypot(*(beyond - border).T) <= far
    dark = readings.mean(beyond) < DARK * readings.mean(nearest(whole)(border))
    return np.where(near, dark, np.mean(dark[near] if near.any() else dark) >= MOSTLY_DARK)


def mixed_with_dark(readings: Readings, border: np.ndarray, coverage: np.ndarray, whole: np.ndarray) -> bool:
    """Return whether border pixels of known coverage mix the object with a dark background, where no pixel shows the background alone.

    What they have beyond their coverage of the object's radiance is the background's.
    `border`: [n, 2] rows and columns, at least one. `coverage`: [rows, cols] 0…1, below 1 at the border. `whole`: [rows, cols] bool,
    pixels of the object alone, at least one."""
    share = coverage[border[:, 0], border[:, 1]]
    beside = readings.mean(nearest(whole)(border))
    background = float(np.sum(readings.mean(border) - share * beside)) / max(float(np.sum((1 - share) * beside)), 1e-30)
    return background < DIM


class MatteSource(StrEnum):
    """The source of the coverage of a matte."""

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
    """The coverage of the pixels by the object, and its source."""

    coverage: np.ndarray  # [rows, cols] float32, 0…1
    factor: np.ndarray  # [rows, cols] float32, 0…1; a sum of captured images times it is premultiplied by `coverage`
    source: MatteSource
    hard: float
    """The share of the border whose coverage is that of the mask, without partial values, because the background there is not dark; 0…1."""


def matte_of(capture: Capture, stack: Stack) -> Matte:
    """Return the matte of a capture."""
    mask, given = capture.mask(), capture.mask_values()
    readings = Readings(stack, mask.shape[1])
    if ((given > PARTIAL[0]) & (given < PARTIAL[1])).any() and given.max() >= PARTIAL[1]:
        return _given(readings, given)
    if mask.all():
        whole = np.ones(mask.shape, dtype=np.float32)
        return Matte(whole, whole, MatteSource.FULL if capture.manifest.mask is None else MatteSource.MASK, 0.0)
    return _estimated(readings, mask)


def _given(readings: Readings, given: np.ndarray) -> Matte:
    """Return the matte of a mask image with partial values."""
    places, whole, outside = np.argwhere((given > 0) & (given < 1)), given >= PARTIAL[1], given <= 0
    clear = outside & (distance(given > 0) > 1) if outside.any() else outside
    if clear.any():
        dark = before_dark(readings, places, whole, clear, REACHES_PX[-1] + FAR_PX)
    else:  # a tight crop or a small hole: the partly covered pixels alone show the background
        dark = np.full(len(places), mixed_with_dark(readings, places, given, whole))
    factor = given.copy()
    factor[places[dark, 0], places[dark, 1]] = 1
    return Matte(given, factor, MatteSource.MASK_IMAGE, 0.0)


def _estimated(readings: Readings, mask: np.ndarray) -> Matte:
    """Return the matte that the images give to a mask without partial values."""
    everything, hard = np.ones(mask.shape, dtype=np.float32), mask.astype(np.float32)
    away = distance(mask)
    for reach in REACHES_PX:
        whole = inside(mask, reach)
        places = np.argwhere(border(mask, whole, reach))
        clear = away > min(reach + CLEAR_PX, 0.99 * float(away.max()))
        dark = before_dark(readings, places, whole if whole.any() else mask, clear, reach + FAR_PX)
        if dark.mean() >= LEAST_DARK:
            break
    else:
        return Matte(everything, everything, MatteSource.BACKGROUND, 1.0)
    known = np.ones(mask.shape, dtype=bool)
    known[places[~dark, 0], places[~dark, 1]] = False
    if not whole.any() or not (rim(mask) & known).any() or readings.light_count < FEWEST_LIGHTS:
        return Matte(hard, hard, MatteSource.MASK, 1.0)
    light = _rim_light(readings, mask, whole, known)
    if np.quantile(light, LEAST_RIM) > RIM_LIGHT and _ring(readings, mask, whole, known, 0.0, 1.1) < CUT:
        return Matte(hard, hard, MatteSource.MASK, 0.0)
    first, _ = cover(readings, mask, whole, places[dark], reach + FAR_PX)
    shift = _shift(mask, known, first, is_wide=bool(np.median(light) < EMPTY))
    blur = SOFT_BLUR_PX if reach == REACHES_PX[0] else None  # out of focus: how much, the outline of the mask does not say
    # with the border where half is covered, the pixels that are wholly covered lie closer to it
    halved = np.where(known, _beside_outline(first, mask, known, shift, blur) > 0.5, mask)
    if reach == REACHES_PX[0] and _ring(readings, halved, whole, known, 1.0, 1.6) < SPREAD:
        reach, blur = SHARP_PX, SHARP_BLUR_PX
    whole = inside(halved, reach)
    if not whole.any():
        return Matte(hard, hard, MatteSource.MASK, 1.0)
    found, estimated = cover(readings, halved, whole, np.argwhere(border(halved, whole, reach) & known), reach + FAR_PX)
    if not estimated.any():
        return Matte(hard, hard, MatteSource.MASK, 1.0)
    outlined = mask if shift == 0 else halved  # which is where the mask should have been
    coverage = np.where(known, _beside_outline(found, outlined, known, 0.0, blur), hard)
    coverage = np.where(coverage < LEAST_COVERAGE, 0, np.where(coverage > 1 - ROUND, 1, coverage)).astype(np.float32)
    return Matte(coverage, np.where(known, coverage > 0, coverage).astype(np.float32), MatteSource.IMAGES, float(1 - np.mean(dark)))


def _shift(mask: np.ndarray, known: np.ndarray, coverage: np.ndarray, *, is_wide: bool) -> float:
    """Return how far the object reaches beyond a mask by a first estimate of its coverage, in pixels; 0 where the mask seems right."""
    at = rim(mask) & known
    shift = float(np.median(outline_offset(np.where(known, coverage - mask, 0), at)[at]))
    if shift < MASK_OFF_PX:
        shift = min(shift, 0.0) if is_wide else 0.0
    return float(np.clip(shift, -MOST_OFF_PX, MOST_OFF_PX))


def _beside_outline(coverage: np.ndarray, mask: np.ndarray, known: np.ndarray, shift: float, blur: float | None) -> np.ndarray:
    """Return the coverage that the images give, or that of the mask's outline where the images put the outline far inside it."""
    if blur is None:
        return coverage
    outline = outline_coverage(mask, shift_px=shift, blur_px=blur)
    lacking = outline_offset(np.where(known, outline - coverage, 0), rim(mask) & known)
    trust = np.clip((REFUSED_PX - lacking) / (REFUSED_PX - FOLLOWED_PX), 0, 1)
    return trust * coverage + (1 - trust) * outline


def _rim_light(readings: Readings, mask: np.ndarray, whole: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return [n] how bright each known pixel of the rim of a mask is, as a share of the nearest whole pixel."""
    places = np.argwhere(rim(mask) & known)
    return readings.quantile(places, BRIGHT) / np.maximum(readings.quantile(nearest(whole)(places), BRIGHT), 1e-20)


def _ring(readings: Readings, mask: np.ndarray, whole: np.ndarray, known: np.ndarray, least: float, most: float) -> float:
    """Return the mean reading of the known pixels outside a mask at a range of distances, as a share of that inside."""
    away = distance(mask)
    ring = np.argwhere((away > least) & (away <= most) & known)
    edge = np.argwhere(whole & (distance(~mask) <= REACHES_PX[-1] + FAR_PX))
    if not len(ring) or not len(edge):
        return 0.0
    return float(readings.mean(ring).mean() / max(readings.mean(edge).mean(), 1e-20))
