"""The error of a smooth map, estimated scale by scale from a noisy one.

The difference of the two maps is averaged over cells of 2^l pixels, from the largest scale to the smallest. What cells differ by beyond
the noise of the noisy map, which is known, is the error of the other at that scale; each cell is corrected by the part of its
difference that is error and not noise, S / (S + N), and the next smaller scale sees what is left.

Source: the shrinkage is that of Wiener (1949), with the variance of the error estimated from the data at each scale (empirical Bayes,
Efron and Morris, "Stein's estimation rule and its competitors", 1973); that depth tells low and normals tell high frequencies is from
Nehab, Rusinkiewicz, Davis and Ramamoorthi, "Efficiently combining positions and normals for precise 3D geometry", SIGGRAPH 2005.
"""

from typing import NamedTuple

import numpy as np

from stage.spread import MAD_TO_SIGMA

PASSES = 2
"""Number of times each scale is looked at: cells are interpolated, which leaves part of a correction undone."""
REJECTED = 5.0
"""Difference from its surroundings, in robust standard deviations, beyond which a reading is left out."""
SURROUNDINGS = 3
"""Scale of these surroundings, cells of 2^3 pixels."""


class Correction(NamedTuple):
    """The correction of the smooth map."""

    value: np.ndarray  # [rows, cols]
    variance: np.ndarray  # [rows, cols] of the error that is left
    rejected: np.ndarray  # [rows, cols] bool, readings that disagree with their surroundings


def correct(difference: np.ndarray, sigma: np.ndarray, known: np.ndarray, inside: np.ndarray) -> Correction:
    """Estimate the error of a smooth map from its difference to a noisy one.

    Args:
        difference: [rows, cols] noisy minus smooth.
        sigma: [rows, cols] standard deviation of the noise, independent between pixels.
        known: [rows, cols] bool, where there is a difference; one pixel or more.
        inside: [rows, cols] bool, where the correction is wanted.
    """
    rejected = _outliers(difference, sigma, known)
    weight = np.where(known & ~rejected, 1 / sigma**2, 0)
    value = np.full(difference.shape, (weight * np.where(known, difference, 0)).sum() / weight.sum())
    variance = np.full(difference.shape, 1 / weight.sum())
    cover = inside.astype(np.float64)
    levels = max(1, int(np.ceil(np.log2(max(difference.shape)))))
    for level in range(levels - 1, -1, -1):
        for again in range(PASSES):
            weights = _sum_cells(weight, level)
            left = _sum_cells(weight * np.where(known, difference - value, 0), level) / np.where(weights > 0, weights, 1)
            whole = weights.sum()
            cells = (weights > 0).sum()
            noise = cells / whole  # mean of 1 / weights, weighted like the differences
            error = max((weights * left**2).sum() / whole - noise, 0.0)
            if again == 0:  # as much error as the noise may hide
                hidden = error + noise * np.sqrt(2 / cells)
                variance += _spread(hidden / (1 + hidden * weights), cover, level)
            if error == 0:
                break
            value += _spread(error * weights / (error * weights + 1) * left, cover, level)
    return Correction(value, variance, rejected)


def _outliers(difference: np.ndarray, sigma: np.ndarray, known: np.ndarray) -> np.ndarray:
    weight = np.where(known, 1 / sigma**2, 0)
    weights = _sum_cells(weight, SURROUNDINGS)
    mean = _sum_cells(weight * np.where(known, difference, 0), SURROUNDINGS) / np.where(weights > 0, weights, 1)
    off = (difference - _interpolated(mean, weights, difference.shape, SURROUNDINGS)) / sigma
    spread = max(1.0, MAD_TO_SIGMA * float(np.median(np.abs(off[known]))))
    return known & (np.abs(off) > REJECTED * spread)


def _sum_cells(plane: np.ndarray, level: int) -> np.ndarray:
    """Return the sums over cells of 2^level pixels."""
    side = 1 << level
    rows, cols = (-(-count // side) for count in plane.shape)
    framed = np.pad(plane, ((0, rows * side - plane.shape[0]), (0, cols * side - plane.shape[1])))
    return framed.reshape(rows, side, cols, side).sum(axis=(1, 3))


def _spread(cells: np.ndarray, cover: np.ndarray, level: int) -> np.ndarray:
    """Return the pixels between the middles of cells; cells without a pixel inside do not count."""
    return _interpolated(cells, (_sum_cells(cover, level) > 0).astype(np.float64), cover.shape, level)


def _interpolated(cells: np.ndarray, weight: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    """Return bilinear interpolation of cells by their weights; 0 where all are 0."""
    held = (weight > 0).astype(np.float64)
    total, norm = (_bilinear(plane, shape, level) for plane in (cells * held, held))
    return total / np.where(norm > 0, norm, 1)


def _bilinear(cells: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    for axis, count in enumerate(shape):
        place = np.clip((np.arange(count) + 0.5) / (1 << level) - 0.5, 0, cells.shape[axis] - 1)
        low = np.minimum(place.astype(np.int64), max(cells.shape[axis] - 2, 0))
        part = (place - low).reshape((-1, 1) if axis == 0 else (1, -1))
        cells = np.take(cells, low, axis) * (1 - part) + np.take(cells, np.minimum(low + 1, cells.shape[axis] - 1), axis) * part
    return cells
