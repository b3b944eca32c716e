"""Register one patch of heights to another that shows the same surface: shift, rotation, offset and tilt, with their information.

A motion is six numbers in metres: x, y, rotation about z, height, and the slopes along x and y; rotation and slopes are multiplied by the
half-length L of the board. The coarse search compares the patches at every shift of whole pixels that the stage's error allows
(masked differences by the fast Fourier transform: Padfield, "Masked object registration in the Fourier domain", IEEE TIP 21(5), 2012);
what it finds is refined by least squares on the heights with Tukey's weights (Lucas and Kanade, "An iterative image registration
technique", IJCAI 1981, on heights in place of intensities).
"""

from enum import StrEnum
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter

from service.boards.stitching.form import without_plane
from service.boards.stitching.grid import BLOCK_PX, BoardGrid, HeightPatch, bends, blocks_of, edge_variance, gradients, robust_sigma
from service.boards.stitching.shift_search import LEAST_PIXELS, SHARED_PX, find_shifts
from stage.spread import tukey_weights

UNKNOWNS = 6
LATERAL = slice(0, 3)
"""The unknowns of a motion in the plane of the board: x, y and rotation."""
ROUNDS = 8
CLEAR_SLOPE = 5.0
"""A slope says something about a shift where it is this many times its noise."""
SIGNAL = 5.0
"""A surface has relief where its heights vary by this factor more than their noise."""
LEAST_CORRELATION, LEAST_MISFIT = 0.6, 1.6
"""Two patches do not show the same surface if the correlation of their reliefs at the best shift is below this, and the root mean square of
the residuals is above this many times the noise."""
CAPPED = 5.0
CLEAR_DIRECTION = 10.0
"""Information about a shift counts in directions where it is this many times what the noise of slopes alone gives."""
LEAST_CLEAR = 150
"""The fewest pixels with a clear slope that measure a shift."""
LEAST_LOG_ODDS = 7.0
"""Log odds (1000 : 1) by which the best shift must be more probable than any other; else the shift counts as not measured."""


class Evidence(StrEnum):
    """Result of measuring the shift in an overlap."""

    SHIFT = "shift"
    """The shift is measured."""
    FLAT = "flat"
    """There is too little relief: offset and tilt are measured, the shift is not."""
    REPEATS = "repeats"
    """Several shifts fit alike, as on pads of one pitch: offset and tilt are measured, the shift is not."""
    DIFFERS = "differs"
    """The patches do not show the same surface: nothing is measured."""


class Overlap(NamedTuple):
    """The difference of the motions of two patches (first − second), estimated from their common pixels."""

    evidence: Evidence
    difference: np.ndarray  # [6] metres
    information: np.ndarray  # [6, 6] 1/m²: the inverse of its covariance
    pixels: int
    correlation: float
    """Correlation of the heights of both patches at the best shift."""
    noise_factor: float
    """The scatter of the residuals over what the noise of both patches says."""
    shared_m: float
    """Standard deviation of the part of one patch's error that pixels of a block share, metres."""
    residual_m: float
    """Robust standard deviation of the residuals, metres."""
    candidates: tuple["Candidate", ...] = ()
    """Motions that fit alike, the most probable first, where the evidence is REPEATS."""


class Candidate(NamedTuple):
    """One of several motions that fit an overlap alike."""

    difference: np.ndarray  # [6] metres
    information: np.ndarray  # [6, 6] 1/m²


class _Common(NamedTuple):
    """The common pixels of two patches at one shift."""

    row: np.ndarray  # [n] of the grid
    col: np.ndarray
    first: np.ndarray  # [rows, cols] heights, NaN outside
    second: np.ndarray
    variance: np.ndarray  # of the difference
    window: tuple[slice, slice]
    """Rows and columns of the grid that the arrays cover."""


def measure_overlap(
    first: HeightPatch, second: HeightPatch, grid: BoardGrid, *,
    centre: tuple[float, float],  # x and y about which motions turn and tilt, metres
    length_m: float,  # L, metres
    shift_sigma_m: float,  # standard deviation along x and y of what is known about the shift before
    search_px: int,  # the largest shift that is looked at; 0 refines only
) -> Overlap | None:
    """Compare two patches on one grid. Returns None where fewer than LEAST_PIXELS are common."""
    common = _common(first, second, (0, 0))
    if common is None:
        return None
    candidates = find_shifts(first, second, *common.window, pixels=common.row.size, sigma_px=shift_sigma_m / grid.pixel_m,
                             search_px=search_px)
    fits = []
    for shift in candidates:
        fit = _refine(first, second, shift, grid, centre, length_m)
        if fit is not None:
            fits.append((shift, fit))
    if not fits:
        return None
    costs = [_cost(fit, common.row.size, shift_sigma_m) for _, fit in fits]
    order = np.argsort(costs)
    best = fits[order[0]][1]
    rivals = [fits[k][1] for k in order[1:] if costs[k] - costs[order[0]] < LEAST_LOG_ODDS
              and np.hypot(*(best.measured @ (fits[k][1].difference[:2] - best.difference[:2]))) > 1.5 * grid.pixel_m]
    if best.misfit > LEAST_MISFIT and (best.relief_differs or (best.relief and best.correlation < LEAST_CORRELATION)):
        evidence = Evidence.DIFFERS
    elif not best.measured.any():
        evidence = Evidence.FLAT
    else:
        evidence = Evidence.REPEATS if rivals else Evidence.SHIFT
    information = best.information.copy()
    if evidence is not Evidence.SHIFT:
        information[LATERAL], information[:, LATERAL] = 0, 0
    return Overlap(evidence, best.difference, information, best.pixels, best.correlation, best.noise_factor, best.shared_m,
                   best.residual_m,
                   tuple(Candidate(fit.difference, fit.information) for fit in (best, *rivals)) if evidence is Evidence.REPEATS else ())


def choose_candidate(overlap: Overlap, expected: np.ndarray, covariance: np.ndarray) -> Overlap | None:
    """Return an overlap that REPEATS with the one candidate that the other overlaps and the stage leave; None if they leave several.
    `expected`: [2] the difference of the shifts that is expected without this overlap, metres, with its covariance [2, 2]."""
    away = np.array([candidate.difference[:2] - expected for candidate in overlap.candidates])
    cost = np.einsum("ni,ni->n", away, np.linalg.solve(covariance, away.T).T) / 2
    order = np.argsort(cost)
    if cost[order[1]] - cost[order[0]] < LEAST_LOG_ODDS:
        return None
    chosen = overlap.candidates[order[0]]
    return overlap._replace(evidence=Evidence.SHIFT, difference=chosen.difference, information=chosen.information, candidates=())


class _Fit(NamedTuple):
    difference: np.ndarray
    information: np.ndarray
    pixels: int
    measured: np.ndarray  # [2, 2] projection onto the directions, x and y, in which slopes measure the shift
    correlation: float
    relief: bool
    relief_differs: bool
    noise_factor: float
    shared_m: float
    residual_m: float
    misfit: float
    """Root mean square of the residuals over their noise, none of which counts more than CAPPED σ."""


def _common(first: HeightPatch, second: HeightPatch, shift: tuple[int, int]) -> _Common | None:
    """Return the common pixels where the second patch is moved by `shift` rows and columns."""
    top, left = max(first.row, second.row + shift[0]), max(first.col, second.col + shift[1])
    bottom = min(first.row + first.height.shape[0], second.row + shift[0] + second.height.shape[0])
    right = min(first.col + first.height.shape[1], second.col + shift[1] + second.height.shape[1])
    if bottom - top < 2 or right - left < 2:
        return None
    a = slice(top - first.row, bottom - first.row), slice(left - first.col, right - first.col)
    b = (slice(top - second.row - shift[0], bottom - second.row - shift[0]),
         slice(left - second.col - shift[1], right - second.col - shift[1]))
    both = first.measured[a] & second.measured[b]
    if int(both.sum()) < LEAST_PIXELS:
        return None
    row, col = np.nonzero(both)
    return _Common(row + top, col + left, np.where(both, first.height[a], np.nan), np.where(both, second.height[b], np.nan),
                   first.variance[a] + second.variance[b], (slice(top, bottom), slice(left, right)))


def _refine(first: HeightPatch, second: HeightPatch, shift: tuple[int, int], grid: BoardGrid, centre: tuple[float, float],
            length_m: float) -> _Fit | None:
    """Fit the motion at a shift of whole pixels; the whole part follows the fit where it moves by more than half a pixel."""
    difference = np.zeros(UNKNOWNS)
    for _ in range(4):
        common = _common(first, second, shift)
        if common is None:
            return None
        fit = _fit(first, second, common, shift, grid, centre, length_m)
        moved = _pixels(fit.difference, grid)
        if max(abs(moved[0] - shift[0]), abs(moved[1] - shift[1])) <= 0.6:
            return fit
        difference = fit.difference
        shift = (int(np.clip(round(moved[0]), shift[0] - 2, shift[0] + 2)), int(np.clip(round(moved[1]), shift[1] - 2, shift[1] + 2)))
    return fit._replace(difference=difference)


def _pixels(difference: np.ndarray, grid: BoardGrid) -> tuple[float, float]:
    """Return the shift of the second patch in rows and columns that a difference of motions, first − second, stands for."""
    return float(difference[1] / grid.pixel_m), float(-difference[0] / grid.pixel_m)


def _fit(first: HeightPatch, second: HeightPatch, common: _Common, shift: tuple[int, int], grid: BoardGrid, centre: tuple[float, float],
         length_m: float) -> _Fit:
    both = np.isfinite(common.first)
    variance = common.variance[both]
    residual = common.first[both] - common.second[both]
    x, y = grid.coordinates(common.row, common.col)
    x, y = (x - centre[0]) / length_m, (y - centre[1]) / length_m
    across, down, gain = gradients((common.first + common.second) / 2)
    floor = CLEAR_SLOPE * gain * np.sqrt(np.median(variance) / 4)
    clear = np.hypot(across, down)[both] > floor
    slope_x, slope_y = np.where(clear, across[both], 0) / grid.pixel_m, np.where(clear, -down[both], 0) / grid.pixel_m
    rows = np.stack([-slope_x, -slope_y, slope_x * y - slope_y * x, np.ones_like(x), x, y])  # [6, n]
    bent = [maximum_filter(np.nan_to_num(bends(heights)), 3)[both] for heights in (common.first, common.second)]
    own, stated = variance * (first.noise_share + second.noise_share) / 2, float(np.sqrt(np.median(variance) / 2))
    noise, edges = np.sqrt(own), np.zeros_like(variance)
    solution, weight = np.zeros(UNKNOWNS), np.ones_like(residual)
    scale = 1.0
    for turn in range(ROUNDS):
        left = residual + solution @ rows
        if turn == 0:
            left = left - np.median(left)
        scale = max(robust_sigma(left / noise), 1e-9)
        edges = np.add(*(edge_variance(bend, stated * max(scale, 1.0)) for bend in bent))
        noise = np.sqrt(own + edges)
        weight = tukey_weights(left / noise, max(scale, 1.0)) / (variance + edges)
        normal = (rows * weight) @ rows.T
        if int(clear.sum()) < LEAST_CLEAR:
            normal[LATERAL], normal[:, LATERAL] = 0, 0
        size = np.sqrt(np.diag(normal))
        size = np.where(size > 0, size, 1)
        solution = -np.linalg.lstsq(normal / np.outer(size, size), (rows * weight) @ residual / size, rcond=1e-10)[0] / size
    left = residual + solution @ rows
    kept = weight > 0
    quiet = kept & (edges == 0)
    scale = robust_sigma((left / noise)[quiet if quiet.sum() >= LEAST_PIXELS / 2 else kept])
    field = np.full(common.first.shape, np.nan)
    field[both] = np.where(kept, left, np.nan)
    shared = _shared(field, float(np.median(variance)) * max(scale, 1.0) ** 2)
    normal, widened = (rows * weight) @ rows.T, max(scale, 1.0) ** 2
    spurious = float(weight[clear].sum()) * float(gain) ** 2 * float(np.median(variance)) / 4 / grid.pixel_m**2
    measured = _directions(normal, spurious if int(clear.sum()) >= LEAST_CLEAR else np.inf)
    keep = np.eye(UNKNOWNS)
    keep[:2, :2] = measured
    keep[2, 2] = float(measured.any())
    information = keep @ (normal / widened) @ keep
    moved = solution.copy()  # the whole shift belongs to the difference: first − second = fitted − the shift of the second
    moved[0] -= shift[1] * grid.pixel_m
    moved[1] += shift[0] * grid.pixel_m
    flat = [without_plane(values[both], x, y) for values in (common.first, common.second)]
    spread = [float(np.ptp(np.percentile(values, [2, 98]))) / 4.1 for values in flat]  # σ of a normal distribution within 3 %
    noises = [float(np.sqrt(np.median(patch.variance[patch.measured]) * patch.noise_share)) for patch in (first, second)]
    clipped = [np.clip(values, *np.percentile(values, [0.5, 99.5])) for values in flat]
    deviation = [float(values.std()) for values in clipped]
    product = deviation[0] * deviation[1]
    correlation = float(np.mean((clipped[0] - clipped[0].mean()) * (clipped[1] - clipped[1].mean())) / product) if product > 0 else 0.0
    reliefs = [value > SIGNAL * noise for value, noise in zip(spread, noises, strict=True)]
    return _Fit(moved, information, residual.size, measured, correlation, all(reliefs),
                reliefs[0] != reliefs[1] and max(spread) > 2 * SIGNAL * max(noises), scale, shared, robust_sigma(left),
                float(np.sqrt(np.mean(np.square(np.clip(left / np.sqrt(own), -CAPPED, CAPPED))))))


def _directions(information: np.ndarray, spurious: float) -> np.ndarray:
    """Return the projection onto the directions in which a shift is measured, [2, 2].

    Along a straight edge nothing measures the shift (the aperture problem), though the noise of slopes makes it look so: `spurious` is the
    information that this noise gives in every direction.
    """
    values, vectors = np.linalg.eigh(information[:2, :2])
    kept = vectors[:, values > CLEAR_DIRECTION * spurious]
    return np.asarray(kept @ kept.T)


def _shared(field: np.ndarray, variance: float) -> float:
    """Return σ of the error of one patch that the pixels of a block share, from the means of the residuals in blocks."""
    side = min(BLOCK_PX, max(4, min(field.shape) // 3))
    blocks = blocks_of(field, side)
    count = np.isfinite(blocks).sum(axis=(2, 3))
    full = count >= side * side // 2
    if int(full.sum()) < 6:
        return 0.0
    means = np.nansum(blocks, axis=(2, 3))[full] / count[full]
    excess = robust_sigma(means) ** 2 - variance / float(np.median(count[full]))
    return float(np.sqrt(max(excess, 0.0) / 2))


def _cost(fit: _Fit, pixels: int, shift_sigma_m: float) -> float:
    """Return minus the log posterior probability of a shift, but for a constant, from the pixels of the overlap as the stage tells it."""
    evidence = pixels / SHARED_PX * np.log(max(fit.misfit, 1e-12))
    return float(evidence + (fit.difference[0] ** 2 + fit.difference[1] ** 2) / (2 * shift_sigma_m**2))
