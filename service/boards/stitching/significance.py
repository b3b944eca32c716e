"""Test deviations from a nominal height map for significance: means over windows and regions against their σ, with a stated false-alarm
probability.

The mean over a set of pixels with weights w = 1 / (noise² + shared²) has the variance (Σ w² noise² + (Σ w shared)²) / (Σ w)²: noise
averages out, the errors that neighbours share do not. With M tests on a board, each has the false-alarm probability P / M (Bonferroni's
bound; windows overlap, so that the probability of any false alarm on a board is below P, Gaussian errors given).

Windows are squares of the smallest defect's side, twice that, and so on, at every place (a multi-scale scan statistic: Glaz, Naus,
Wallenstein, "Scan Statistics", 2001). A deviation counts at most CLIP σ beyond the tolerance, so that a spike of one pixel is no
defect. Noise that neighbours share, and a form of the board that stays, widen the spread of the windows' means beyond what σ says: each
size is tested against the spread and middle that its own windows have (the empirical null distribution: Efron, "Large-scale simultaneous
hypothesis testing", JASA 2004).
"""

from statistics import NormalDist
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import label

from service.boards.stitching.grid import HeightMap, bends, edge_variance, robust_sigma, shift_error

CLIP = 6.0
ENOUGH_WINDOWS = 100
"""The least number of windows whose spread says what their errors are."""
MOST_WINDOWS, WIDEST, HALVINGS = 200_000, 1000.0, 10
"""Most windows from which that is taken, the largest factor by which they may scatter more than noise, and the halvings that find it."""
LEAST_MEASURED = 0.5
"""The least part of a window that must be measured."""
LEAST_CARRIED, LEAST_PART = 3, 0.25
"""The least side of windows whose pixels are looked at one by one, and the part of the mean that two thirds of them must exceed."""
DOUBLINGS = 5
"""Sizes of windows, each twice the one before."""
POWER = NormalDist().inv_cdf(0.95)
"""σ above the threshold at which a defect is found with a probability of 95 %."""
MATCH_PX = 0.05
"""The least standard deviation of the shift between two maps, pixels: optics and sampling differ from map to map."""


class Mean(NamedTuple):
    """The weighted mean of some pixels."""

    value: float
    """Metres."""
    sigma: float
    """Metres."""
    pixels: int


class Scan(NamedTuple):
    """Result of the tests of all windows."""

    significant: np.ndarray  # [rows, cols] bool: pixels of significant windows
    side: np.ndarray  # [rows, cols] int: side of the smallest significant window over a pixel, negative where its mean is; 0 without one
    mean_sigma: np.ndarray  # [rows, cols] σ of the mean of the smallest window around each pixel, at the border of that which ends there,
    #                         metres; NaN with too few measured
    findable: np.ndarray  # [rows, cols] deviation that is found in that window with a probability of 95 %, metres
    score: np.ndarray  # [rows, cols] the largest |mean| less tolerance over σ of the windows around a pixel
    sides_px: tuple[int, ...]
    tests: int
    threshold: float
    """σ from which on a window is significant."""
    spread: dict[int, float]
    """By the side of windows, the factor by which their means scatter more than σ says."""
    detectable_m: dict[int, float]
    """By the side of windows in pixels, the deviation that is found with a probability of 95 % in the median window."""


def threshold(false_alarm: float, tests: int, *, sides: int = 2) -> float:
    """Return from how many σ on a deviation counts so that all tests together raise a false alarm with at most a given probability.
    `false_alarm`: above 0 and below 1. `sides`: 2 where a deviation of either sign is an alarm, else 1."""
    return float(-NormalDist().inv_cdf(false_alarm / (max(tests, 1) * sides)))


def mean_of(deviation: HeightMap, pixels: np.ndarray, *, spread: float = 1.0) -> Mean | None:
    """Return the weighted mean over pixels, [rows, cols] bool, whose noise is `spread` times what is stated; None where none is known."""
    used = pixels & deviation.measured
    count = int(used.sum())
    if count == 0:
        return None
    variance, systematic = deviation.variance[used], deviation.systematic[used]
    weight = 1 / (variance + systematic**2)
    total = float(weight.sum())
    square = spread**2 * float((weight**2 * variance).sum()) + float((weight * systematic).sum()) ** 2
    return Mean(float((weight * deviation.height[used]).sum()) / total, float(np.sqrt(square)) / total, count)


def scan_windows(deviation: HeightMap, *, tolerance_m: float | np.ndarray, false_alarm: float, smallest_px: int) -> Scan:
    """Look for significant windows over a whole board; pixels of significant windows do not count in larger ones.
    `tolerance_m`: deviations up to this are no defect; one number, or one for each pixel, [rows, cols]. `false_alarm`: the probability of
    any false alarm on a board without defects. `smallest_px`: side of the smallest window."""
    shape = deviation.measured.shape
    tolerance = np.broadcast_to(np.asarray(tolerance_m, dtype=np.float64), shape)
    known = deviation.measured
    sides = tuple(side for side in (smallest_px << k for k in range(DOUBLINGS)) if side <= min(shape))
    tests = sum(int((_sums(known, side) >= LEAST_MEASURED * side * side).sum()) for side in sides)
    limit = threshold(false_alarm, tests)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(known, 1 / (deviation.variance + deviation.systematic**2), 0)
    reach = tolerance + CLIP * deviation.sigma
    clipped = np.where(known, np.clip(deviation.height, -reach, reach), 0)
    noise, shared = np.where(known, deviation.variance, 0), np.where(known, deviation.systematic, 0)
    found, score = np.zeros(shape, dtype=np.int64), np.zeros(shape)
    mean_sigma, findable = (np.full(shape, np.nan) for _ in range(2))
    detectable: dict[int, float] = {}
    spread: dict[int, float] = {}
    for side in sides:
        weight = np.where(found != 0, 0, weight)
        usable = _sums(known & (found == 0), side) >= LEAST_MEASURED * side * side
        total = _sums(weight, side)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = np.where(usable, _sums(weight * clipped, side) / total, np.nan)
            own = np.sqrt(np.maximum(_sums(weight**2 * noise, side), 0)) / total
            both = _sums(weight * shared, side) / total
            sigma = np.where(usable, np.hypot(own, both), np.nan)
            allowed = np.where(usable, _sums(weight * tolerance, side) / total, 0)
            middle, spread[side] = _scatter(value, own, both, usable & (own > sigma / 2), usable)
            wide = np.where(usable, np.hypot(spread[side] * own, both), np.nan)  # what neighbours share is no noise, and scatters no more
            beyond = np.where(usable, np.minimum((np.abs(value) - allowed) / sigma, np.abs(value - middle * own) / wide), 0)
        if side == sides[0] and side >= LEAST_CARRIED:
            beyond[_carried_by_few(clipped, known & (found == 0), value, beyond >= limit)] = 0
        if usable.any():
            detectable[side] = float(np.median(allowed[usable] + (limit + POWER) * wide[usable]))
        if side == sides[0]:
            mean_sigma = _nearest(sigma, side)
            findable = _nearest(allowed + (limit + POWER) * wide, side)
        score = np.fmax(score, _centred(beyond, side))
        for sign in (1, -1):
            significant = (beyond >= limit) & (sign * value > 0)
            if significant.any():
                found[(_sums(np.pad(significant, side - 1), side) > 0.5) & (found == 0)] = sign * side  # all that the windows cover
    return Scan(found != 0, found, mean_sigma, findable, score, sides, tests, limit, spread, detectable)


def _carried_by_few(heights: np.ndarray, known: np.ndarray, mean: np.ndarray, windows: np.ndarray) -> np.ndarray:
    """Return which of some windows, [rows, cols] bool by their first pixels, deviate by outliers alone: a third of their pixels lies
    below a part of their mean, where a defect of their size that lies between pixels has half of its depth."""
    side = heights.shape[0] - windows.shape[0] + 1
    out = np.zeros_like(windows)
    places = np.argwhere(windows)
    for part in np.array_split(places, len(places) // 100_000 + 1):
        rows, cols = part.T
        sign = np.sign(mean[rows, cols])[:, None]
        inside = [sliding_window_view(values, (side, side))[rows, cols].reshape(len(part), side * side) for values in (heights, known)]
        own = np.sort(np.where(inside[1], sign * inside[0], np.inf), axis=1)[:, side * side // 3 - 1]
        out[rows, cols] = own < LEAST_PART * np.abs(mean[rows, cols])
    return out


def _scatter(value: np.ndarray, own: np.ndarray, both: np.ndarray, quiet: np.ndarray, usable: np.ndarray) -> tuple[float, float]:
    """Return the middle of the means of windows over their σ, and the factor of the noise, 1 at the least, with which noise and shared
    error together explain their robust scatter: of those with more noise than shared error, if there are enough of them."""
    taken = quiet if quiet.sum() >= ENOUGH_WINDOWS else usable
    if taken.sum() < ENOUGH_WINDOWS:
        return 0.0, 1.0
    step = -(-int(taken.sum()) // MOST_WINDOWS)
    value, own, both = (values[taken][::step] for values in (value, own, both))
    middle = float(np.median(value / np.hypot(own, both)))
    low, high = 1.0, 1.0
    while high < WIDEST and robust_sigma(value / np.hypot(high * own, both)) > 1:
        low, high = high, 2 * high
    for _ in range(HALVINGS if high > 1 else 0):
        factor = (low + high) / 2
        low, high = (factor, high) if robust_sigma(value / np.hypot(factor * own, both)) > 1 else (low, factor)
    return middle, high


def region_of(deviation: HeightMap, scan: Scan, part: np.ndarray) -> np.ndarray:
    """Return the whole connected area, [rows, cols] bool, that deviates by at least half as much as a significant part of it does at most.

    Deviations count as their means over the smallest significant window about each pixel, weighted by their variance and not clipped.
    """
    sign = 1 if scan.side[part].sum() > 0 else -1
    side = int(np.abs(scan.side[part]).min())
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(deviation.measured, 1 / (deviation.variance + deviation.systematic**2), 0)
        mean = sign * _around(weight * np.where(deviation.measured, deviation.height, 0), side) / _around(weight, side)
    seed = part & deviation.measured
    values = mean[seed][np.isfinite(mean[seed])]
    if values.size == 0 or values.max() <= 0:
        return seed
    high = deviation.measured & (np.nan_to_num(mean) >= values.max() / 2)
    labels, _ = label(high)
    own = np.unique(labels[seed & high])
    return np.asarray(np.isin(labels, own[own > 0]))


def _around(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums over the square of a side about each pixel, [rows, cols]."""
    before = side // 2
    return _sums(np.pad(values, ((before, side - 1 - before),) * 2), side)


def grown(pixels: np.ndarray, side: int) -> np.ndarray:
    """Return the pixels whose square of a side, about them, holds one of some pixels; both [rows, cols] bool."""
    return _around(pixels, side) > 0.5


def weighted_centre(values: np.ndarray, rows: np.ndarray, cols: np.ndarray) -> tuple[float, float]:
    """Return the mean row and column with the absolute values as weights, all [n]."""
    weight = np.abs(values)
    if not weight.any():
        weight = np.ones_like(values)
    return float((weight * rows).sum() / weight.sum()), float((weight * cols).sum() / weight.sum())


def _sums(values: np.ndarray, side: int) -> np.ndarray:
    """Return the sums over every square of a side, [rows − side + 1, cols − side + 1]."""
    whole = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    np.cumsum(np.cumsum(values, axis=0, dtype=np.float64), axis=1, out=whole[1:, 1:])
    return np.asarray(whole[side:, side:] - whole[:-side, side:] - whole[side:, :-side] + whole[:-side, :-side])


def _centred(windows: np.ndarray, side: int) -> np.ndarray:
    """Return values of windows at their middle pixels, [rows, cols]; NaN where the window does not fit."""
    first = (side - 1) // 2
    return np.pad(windows, ((first, side - 1 - first),) * 2, constant_values=np.nan)


def _nearest(windows: np.ndarray, side: int) -> np.ndarray:
    """Return values of windows at their middle pixels, and of the outermost windows from there to the border, [rows, cols]."""
    first = (side - 1) // 2
    return np.pad(windows, ((first, side - 1 - first),) * 2, mode="edge")


def compare(measured: HeightMap, nominal: HeightMap, *, shift_sigma_m: tuple[float, float]) -> HeightMap:
    """Return the deviation of two height maps on one grid.

    To the shared errors of both maps come those of edges, where a shift and interpolation change heights: slope times the uncertainty
    of the shift between the maps, and a part of the second difference. `shift_sigma_m`: standard deviation along x and y of the
    registration of the measured map."""
    deviation = measured.height - nominal.height
    known = np.isfinite(deviation)
    variance = measured.variance + nominal.variance
    noise = float(np.sqrt(np.median(variance[known]))) if known.any() else 0.0
    offset = float(np.median(deviation[known])) if known.any() else 0.0
    whole = np.where(np.isfinite(nominal.height), nominal.height, measured.height - offset)
    seen = np.where(np.isfinite(measured.height), measured.height - offset, whole)
    right, up = (max(sigma / measured.grid.pixel_m, MATCH_PX) for sigma in shift_sigma_m)
    edges = np.maximum(*(edge_variance(bends(heights), noise) for heights in (whole, seen)))
    # a wall that one map alone has hides by its place neither that it is there nor that it is missing
    edges += np.minimum(*(shift_error(heights, (right, up), noise) for heights in (whole, (whole + seen) / 2))) ** 2
    systematic = np.sqrt(measured.systematic**2 + nominal.systematic**2 + edges)
    return HeightMap(measured.grid, deviation, variance, np.where(known, systematic, np.nan))
