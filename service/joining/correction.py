"""Correct a smooth map by a noisy one, scale by scale, as far as what they differ by is error of the smooth one.

The difference of the two maps is averaged over cells of 2^l pixels, from the largest scale to the smallest. What cells differ by beyond
the noise of the noisy map, which is known, is the error of the other at that scale; each cell is corrected by the part of its
difference that is error and not noise, S / (S + N), and the next smaller scale sees what is left. Errors of the smooth map are smooth: what
is more than a drift makes over so few pixels is an error that neighbours of the noisy map share, and counts as noise there.

Source: Nehab, Rusinkiewicz, Davis and Ramamoorthi, "Efficiently combining positions and normals for precise 3D geometry", SIGGRAPH 2005,
which filters with one fixed scale in place of the noise and error of each; the shrinkage is that of Wiener (1949), with the variance of
the error estimated from the data at each scale (empirical Bayes, Efron and Morris, "Stein's estimation rule and its competitors", 1973).
"""

from typing import NamedTuple

import numpy as np

from service.joining.cells import interpolated, sum_cells
from stage.spread import MAD_TO_SIGMA

PASSES = 2
"""Number of times each scale is looked at: cells are interpolated, which leaves part of a correction undone."""
REJECTED = 5.0
"""Difference from its surroundings, in robust standard deviations, beyond which a reading is left out."""
PULLED = 5.0
"""Standard errors of the distance between the mean and the median of Gaussian values beyond which the values are of no symmetric noise."""
SURROUNDINGS = 3
"""Scale of these surroundings, cells of 2^3 pixels."""
DRIFT = np.radians(15.0)
"""Largest drift of normals over half of a part; over fewer pixels it falls with their square, because drift is smooth: light that is a few
degrees off, or near lamps, bend all of it."""


class Correction(NamedTuple):
    """The correction of the smooth map."""

    value: np.ndarray  # [rows, cols]
    variance: np.ndarray  # [rows, cols] of the error that is left
    rejected: np.ndarray  # [rows, cols] bool, readings that disagree with their surroundings
    shared: float
    """Standard deviation of errors that neighbours of the noisy map share, beyond any drift of the smooth one."""
    one_sided: float
    """By how much the errors of the noisy map pull to one side; 0 where it is not sure that they do."""


def correct(
    difference: np.ndarray,  # [rows, cols] noisy minus smooth
    sigma: np.ndarray,  # [rows, cols] standard deviation of the noise, independent between pixels
    known: np.ndarray,  # [rows, cols] bool, where there is a difference; one pixel or more
    inside: np.ndarray,  # [rows, cols] bool, where the correction is wanted
    slope_error: float,  # error of the slopes of the smooth map that cells of any size may share
) -> Correction:
    """Estimate the error of a smooth map from its difference to a noisy one.

    What the cells of a scale differ by beyond the noise and beyond what drift makes over so many pixels is an error that neighbours of the
    noisy map share, and counts as its noise there. Means follow readings that are off to one side and too near to be rejected, which the
    median of what is left tells: the variance holds that.
    """
    rejected = _outliers(difference, sigma, known)
    weight = np.where(known & ~rejected, 1 / sigma**2, 0)
    cover = inside.astype(np.float64)
    levels = max(1, int(np.ceil(np.log2(max(difference.shape)))))
    sides = 2.0 ** np.arange(levels)
    drift = (np.hypot(slope_error, DRIFT * np.minimum(2 * sides / max(difference.shape), 1) ** 2) * sides) ** 2
    shared, finer = np.zeros(levels), np.zeros(levels)
    for _ in range(PASSES):
        value = np.full(difference.shape, (weight * np.where(known, difference, 0)).sum() / weight.sum())
        variance = np.full(difference.shape, 1 / weight.sum())
        for level in range(levels - 1, -1, -1):
            for again in range(PASSES):
                weights = sum_cells(weight, level)
                left = sum_cells(weight * np.where(known, difference - value, 0), level) / np.where(weights > 0, weights, 1)
                weights = weights / (1 + finer[level] * weights)
                whole = weights.sum()
                cells = (weights > 0).sum()
                noise = cells / whole  # mean of 1 / weights, weighted like the differences
                found = max((weights * left**2).sum() / whole - noise, 0.0)
                error = min(found, drift[level])
                told = weights / (1 + (found - error) * weights)
                if again == 0:  # as much error as the noise may hide
                    hidden = error + noise * np.sqrt(2 / cells)
                    variance += _spread(hidden / (1 + hidden * told), cover, level)
                    shared[level] = found - error
                if error == 0:
                    break
                value += _spread(error * told / (error * told + 1) * left, cover, level)
        for level in range(1, levels):  # what neighbours share over cells of one scale is left in the mean of the four of the next
            finer[level] = max(shared[level - 1], finer[level - 1]) / 4
    used = known & ~rejected
    one_sided = _one_sided(((difference - value) / sigma)[used]) * float(np.median(sigma[used]))
    return Correction(value, variance + one_sided**2, rejected, float(np.sqrt(shared.max())), one_sided)


def _one_sided(left: np.ndarray) -> float:
    """Return the distance of the mean of what is left from its median, in standard deviations, where noise does not explain it; else 0."""
    found = abs(float(left.mean() - np.median(left)))
    return found if found > PULLED * float(left.std()) * np.sqrt((np.pi / 2 - 1) / len(left)) else 0.0


def _outliers(difference: np.ndarray, sigma: np.ndarray, known: np.ndarray) -> np.ndarray:
    weight = np.where(known, 1 / sigma**2, 0)
    weights = sum_cells(weight, SURROUNDINGS)
    mean = sum_cells(weight * np.where(known, difference, 0), SURROUNDINGS) / np.where(weights > 0, weights, 1)
    off = (difference - interpolated(mean, weights, difference.shape, SURROUNDINGS)) / sigma
    spread = max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(off[known]))))
    return known & (np.abs(off) > REJECTED * spread)


def _spread(cells: np.ndarray, cover: np.ndarray, level: int) -> np.ndarray:
    """Return the pixels between the middles of cells; cells without a pixel inside do not count."""
    return interpolated(cells, (sum_cells(cover, level) > 0).astype(np.float64), cover.shape, level)
