"""The disparity of two cameras under projected texture: range, semi-global matching band by band, refinement, and what is refused.

A place is refused by its neighbourhood too: the mean and the contrast of its texture, and how far a bent surface lies from a plane.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

from kernels.device import to_numpy
from kernels.status import Status
from kernels.stereo.choice import choose
from kernels.stereo.cost import Labels, matching_cost
from kernels.stereo.paths import gather
from kernels.stereo.probe import probe
from kernels.stereo.refine import refine
from kernels.structured.pattern_frames import NoiseModel
from service.depth.stereo.rectification import RectifiedFrames
from service.depth.stereo.row_offsets import RowOffsets, row_offsets

VOLUME_BYTES = 192 << 20
"""Bytes of the costs of one band of rows, which bound the memory whatever the resolution."""
BYTES_PER_LABEL = 3
"""Bytes of one disparity of one pixel: its cost and the sum of its paths."""
HALO = 24
"""Rows above and below a band that are matched with it: paths over more rows hardly change the sums."""
LEAST_ROWS = 16
"""The least number of rows of a band without its halo."""
MOST_LABELS = 4096
"""Most disparities that are compared; so many are those of a scene that begins much nearer to the cameras than it can be in focus."""
PROBE_BYTES = 64 << 20
"""Bytes of the images of a band in which the range of disparities is looked for."""
SAMPLES_ACROSS = 250
"""Places of a row, roughly, that are compared with the whole row to find the range; at most one in eight pixels."""
PROBE_FRAMES = 4
"""Most frames from which the range is found."""
UNIQUE = 0.2
"""Least lead of a place that counts for the range."""
LEAST_PLACES = 20
"""Places that must be unique to find a range."""
FOUND_SHARE = 0.2
"""Share of unique places from which the rows of both images are not looked for elsewhere."""
MOST_ROWS_OFF = 24
"""Largest number of rows by which they are."""
CHANCE_SIGMAS = 5.0
"""By how many standard deviations a number of places must exceed that of images that have nothing to do with each other."""
BIN_PX = 8
"""Width of the bins in which disparities of unique places are counted."""
LEAST_IN_BIN = 3
"""Places that a bin and its neighbours need to count: single ones may be wrong."""
MARGIN_PX = 8
"""Disparities beyond the range of the places that are compared too."""

LEAST_LEAD = 0.15
"""Least lead over the best rival, relative to chance; with less the scene may repeat itself."""
MOST_MISFIT, MOST_CENTRE = 0.3, 0.35
"""Largest differences between the images within the window and in its middle, relative to the contrast of the window. Larger ones belong to
windows over an edge of depth, and to pixels beside it that matching has given to the wrong side."""
MOST_JUMP_PX = 0.75
"""Largest change of the disparity by its refinement."""
MOST_SLOPE = 0.5
"""Largest change of the disparity from pixel to pixel: steeper surfaces cannot be told from steps."""
LEAST_CONTRAST = 2.0
"""Least contrast of the texture in a window, in standard deviations of the noise of a smoothed reading."""
NEAR_REACH = 2
"""Half side of the window whose contrast tells whether the pixel itself has texture: 5 × 5 pixels."""
LEAST_NEAR = 0.25
"""Least contrast of these pixels, relative to that of the whole window. With less, what matched is the texture of another part."""
SMOOTHED_NOISE = 0.375
"""Standard deviation of white noise after the binomial filter 1 2 1 along rows and columns: the root of the sum of its squared weights."""
NOISE_FACTOR, ALIAS_FACTOR, FLOOR_PX = 2.0, 0.06, 0.018
"""σ² is that of the least squares fit with the misfit f of the window replaced by the root of (NOISE_FACTOR f)² + ALIAS_FACTOR², and
FLOOR_PX² in addition. The first accounts for neighbours that share their noise after smoothing and resampling, the second for edges of
texture that pixels undersample, the floor for interpolation, which further frames do not average out. Fitted on rendered planes at noise
from none to 2 % of full scale with one and four frames; the scenes of the tests are others."""
BEND_SIGMAS, BEND_DOUBT = 0.6, 0.5
"""A bend counts as far as it exceeds this many σ, so that noise is not taken for one; and this part of what is taken off is added to σ."""
SURE_LEAD = 0.3
"""Lead from which nothing is left to doubt."""


class Disparity(NamedTuple):
    """The disparity of a rectified pair."""

    disparity: np.ndarray  # [rows, cols] float32, pixels between the columns of both images; 0 where there is no estimate
    slope_x: np.ndarray  # [rows, cols] float32
    slope_y: np.ndarray  # [rows, cols] float32
    sigma: np.ndarray  # [rows, cols] float32, pixels
    lead: np.ndarray  # [rows, cols] float32, by how much the best rival fits worse, relative to chance
    contrast: np.ndarray  # [rows, cols] float32, standard deviation of the texture around the pixel, in the unit of the images
    status: np.ndarray  # [rows, cols] uint8
    offsets: RowOffsets
    """By how much the right image lies lower than the left one, at places over the whole image."""

    @classmethod
    def empty(cls, shape: tuple[int, int]) -> "Disparity":
        """Return arrays without any estimate."""
        disparity, slope_x, slope_y, sigma, lead, contrast = (np.zeros(shape, np.float32) for _ in range(6))
        return cls(disparity, slope_x, slope_y, sigma, lead, contrast, np.zeros(shape, np.uint8), RowOffsets.none())


class Places(NamedTuple):
    """The disparities of single places that are unique in their whole row."""

    disparity: np.ndarray  # [places] float32
    compared: int
    """Number of places that were compared."""


def unique_places(images: RectifiedFrames, device: str) -> Places:
    """Return the disparities of places over the whole image, of either sign."""
    frames, rows, cols = images.left[:PROBE_FRAMES].shape
    step = max(8, cols // SAMPLES_ACROSS)
    right_cols = images.right.shape[2]
    labels = Labels.covering(1 - right_cols, cols - 1, device)
    band = max(1, PROBE_BYTES // (12 * frames * (cols + right_cols) * step)) * step
    found: list[np.ndarray] = []
    compared = 0
    for first in range(0, rows, band):
        part = slice(first, min(first + band, rows))
        places = probe(images.left[:PROBE_FRAMES, part], images.right[:PROBE_FRAMES, part], images.right_seen[part], labels, step=step,
                       device=device)
        label, lead = to_numpy(places.label), to_numpy(places.lead)
        down, across = (np.minimum(np.arange(size) * step + step // 2, most) for size, most in
                        zip(label.shape, (part.stop - part.start - 1, cols - 1), strict=True))
        seen = images.left_seen[part][np.ix_(down, across)]
        found.append((labels.highest - label)[seen & (lead > UNIQUE)].astype(np.float32))
        compared += int(seen.sum())
    return Places(np.concatenate(found), compared)


def shifted_rows(images: RectifiedFrames, found: Places, device: str) -> tuple[int, int] | None:
    """Return by how many rows the right image lies lower, and how many unique places it has then, where these are far more than as it is;
    None where they are not, or enough are found as it is. `found`: the places as it is."""
    if len(found.disparity) > FOUND_SHARE * found.compared:
        return None
    counts = {}
    for shift in (way * size for size in range(2, MOST_ROWS_OFF + 1, 2) for way in (-1, 1)):
        right, seen = np.zeros_like(images.right), np.zeros_like(images.right_seen)
        here, there = (slice(max(0, -by), seen.shape[0] - max(0, by)) for by in (shift, -shift))
        right[:, here], seen[here] = images.right[:, there], images.right_seen[there]
        counts[shift] = len(unique_places(images._replace(right=right, right_seen=seen), device).disparity)
    best = max(counts, key=lambda shift: counts[shift])
    by_chance = float(np.median(list(counts.values())))
    sure = counts[best] >= max(2 * len(found.disparity), LEAST_PLACES + by_chance + CHANCE_SIGMAS * by_chance**0.5)
    return (best, counts[best]) if sure else None


def range_of(places: Places) -> tuple[float, float] | None:
    """Return the least and the largest disparity of the scene, with a margin; None where too few places are unique."""
    if len(places.disparity) < LEAST_PLACES:
        return None
    lowest = float(places.disparity.min())
    bins = ((places.disparity - lowest) // BIN_PX).astype(int)
    counts = np.pad(np.bincount(bins), 1)
    around = counts[:-2] + counts[1:-1] + counts[2:]
    kept = places.disparity[around[bins] >= LEAST_IN_BIN]
    if not len(kept):
        return None
    return float(kept.min()) - MARGIN_PX, float(kept.max()) + MARGIN_PX


def match(images: RectifiedFrames, least: float, most: float, noise: NoiseModel, device: str) -> Iterator[tuple[int, Disparity]]:
    """Match two rectified images band by band; yield how many rows are done, and the disparity of the whole image, final in those rows.
    `least, most`: the disparities that are considered. `noise`: of a reading before smoothing."""
    _, rows, cols = images.left.shape
    labels = Labels.covering(least, most, device)
    result = Disparity.empty((rows, cols))
    whole = VOLUME_BYTES // (BYTES_PER_LABEL * labels.count(device) * cols)
    step = max(LEAST_ROWS, whole - 2 * HALO)
    for first in range(0, rows, step):
        core = slice(first, min(first + step, rows))
        around = slice(max(core.start - HALO, 0), min(core.stop + HALO, rows))
        kept = slice(core.start - around.start, core.stop - around.start)
        found = _match_rows(images, around, labels, noise, device)
        for whole_map, part in zip(result[:7], found[:7], strict=True):
            whole_map[core] = part[kept]
        usable = found.status == Status.OK
        usable[:kept.start] = usable[kept.stop:] = False
        offsets = row_offsets(images.left[0, around], images.right[0, around], found.disparity, found.slope_x, found.slope_y, usable)
        result = result._replace(offsets=result.offsets.joined(offsets._replace(row=offsets.row + around.start)))
        yield core.stop, result


def _match_rows(images: RectifiedFrames, rows: slice, labels: Labels, noise: NoiseModel, device: str) -> Disparity:
    left, right = (np.ascontiguousarray(each[:, rows]) for each in (images.left, images.right))
    right_seen = images.right_seen[rows]
    volume = matching_cost(left, right, right_seen, labels, device=device)
    choice = choose(volume, gather(volume), labels, right_columns=right.shape[2])
    del volume
    label, fraction, disagreement, _, lead = (to_numpy(array) for array in choice)
    start = (labels.highest - label - fraction).astype(np.float32)
    fine = refine(left, right, start, device=device)
    disparity, slope_x, slope_y, sigma, misfit, centre, _ = (to_numpy(array) for array in fine)
    found = sigma > 0
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled = sigma / misfit * np.hypot(NOISE_FACTOR * misfit, ALIAS_FACTOR)
        sigma = np.where(found, np.hypot(scaled, FLOOR_PX), 0).astype(np.float32)
    level = np.maximum(left.mean(axis=0), 0)
    noisy = SMOOTHED_NOISE * np.sqrt(noise.read**2 + noise.gain * level)
    column = np.arange(start.shape[1]) - np.rint(start).astype(int)
    inside = (column >= 0) & (column < right.shape[2])
    inside &= np.take_along_axis(right_seen, np.clip(column, 0, right.shape[2] - 1), axis=1)
    uncertain = (misfit > MOST_MISFIT) | (centre > MOST_CENTRE) | (np.abs(disparity - start) > MOST_JUMP_PX)
    uncertain |= np.hypot(slope_x, slope_y) > MOST_SLOPE
    texture = contrast(left, WINDOW_REACH)
    near = contrast(left, NEAR_REACH)
    uncertain |= near < LEAST_NEAR * texture
    status = np.select(
        [~images.left_seen[rows], near < LEAST_CONTRAST * noisy, ~inside, (label == 0) | (label == labels.count(device) - 1),
         disagreement > 1, lead < LEAST_LEAD, ~found | uncertain],
        [Status.UNSOLVED, Status.LOW_MODULATION, Status.OCCLUDED, Status.OUT_OF_RANGE, Status.OCCLUDED, Status.UNDECIDED, Status.UNSURE],
        Status.OK).astype(np.uint8)
    above = bend(disparity, status == Status.OK)
    above *= np.maximum(0, 1 - (BEND_SIGMAS * sigma / np.maximum(np.abs(above), 1e-9)) ** 2)
    disparity, sigma = disparity - above, np.hypot(sigma, BEND_DOUBT * above)
    kept = found & np.isin(status, (Status.OK, Status.UNSURE))
    disparity, slope_x, slope_y, sigma = (np.where(kept, values, 0).astype(np.float32) for values in (disparity, slope_x, slope_y, sigma))
    return Disparity(disparity, slope_x, slope_y, sigma, lead, texture, status, RowOffsets.none())


WINDOW_REACH = 4
"""Half side of the window in which a disparity is fitted as a plane."""
MEAN_SQUARE = WINDOW_REACH * (WINDOW_REACH + 1) / 3
"""Mean square of the distance of the window's columns from its middle."""
MOST_BEND_PX = 1.5
"""Second differences beyond are steps of depth."""
LEAST_KNOWN = 0.3
"""Least part of the neighbours whose second difference must be known."""


def box_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the mean in a square of 2 reach + 1 pixels around each pixel, [rows, cols] float64; borders are continued."""
    return np.asarray(uniform_filter(values, 2 * reach + 1, output=np.float64, mode="nearest"))


def contrast(images: np.ndarray, reach: int) -> np.ndarray:
    """Return the standard deviation of the readings in a square around each pixel, root mean square over the frames: [rows, cols] float32.
    `images`: [frames, rows, cols] float32. `reach`: half side of the square."""
    total = np.zeros(images.shape[1:])
    for image in images:
        readings = image.astype(np.float64) - float(image.mean())
        total += np.maximum(box_mean(readings**2, reach) - box_mean(readings, reach) ** 2, 0)
    return np.sqrt(total / len(images)).astype(np.float32)


def bend(disparity: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Return by how much a plane that is fitted in the window of each pixel lies above a surface that bends, in pixels of disparity.

    A surface of curvature k lies k x² / 2 above its tangent at a distance x, and the plane of least squares k/2 times the mean of x² above
    it in the middle. The curvature is the second difference over the window, averaged over the pixels around.
    `disparity`: [rows, cols] float32, each fitted as a plane. `usable`: [rows, cols] bool, where it holds. Returns [rows, cols] float64;
    0 where too few neighbours hold."""
    total = np.zeros(disparity.shape)
    for axis in (0, 1):
        before, after = (np.roll(disparity, shift, axis) for shift in (WINDOW_REACH, -WINDOW_REACH))
        known = usable & np.roll(usable, WINDOW_REACH, axis) & np.roll(usable, -WINDOW_REACH, axis)
        along = np.moveaxis(known, axis, 0)
        along[:WINDOW_REACH] = along[-WINDOW_REACH:] = False  # np.roll comes round from the other side
        second = before.astype(np.float64) + after - 2.0 * disparity
        known &= np.abs(second) < MOST_BEND_PX
        share = box_mean(known, WINDOW_REACH)
        mean = box_mean(np.where(known, second, 0), WINDOW_REACH) / np.maximum(share, 1e-9)
        total += np.where(share > LEAST_KNOWN, mean, 0) / WINDOW_REACH**2
    return total / 2 * MEAN_SQUARE
