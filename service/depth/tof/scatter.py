"""Whether ranges scatter from pixel to pixel by more than their standard deviations, as where each pixel's timer has a zero of its own.

Over a surface a range lies between those of its neighbours, but for its own error. What it is off by grows with the distance of the
neighbours where the surface bends, and does not where each pixel errs by itself.
"""

from typing import NamedTuple

import numpy as np

from stage.spread import MAD_TO_SIGMA

TIMES = 2.0
"""Least ratio of the scatter to the standard deviations from which it is remarked on: noise leaves 1 within a tenth."""
OF_PIXELS = 1.25
"""Largest ratio of the scatter between second neighbours and between next ones that is of pixels: a surface that bends has 4."""
ENOUGH = 500
"""Places that tell it."""


class Scatter(NamedTuple):
    """Errors that every pixel has of its own beyond its standard deviation."""

    own_m: float
    """Their standard deviation, metres."""
    times: float
    """Standard deviation of what ranges are off from their neighbours by, in that which theirs say."""


def find_scatter(range_m: np.ndarray, sigma_m: np.ndarray, sure: np.ndarray) -> Scatter | None:
    """Return by how much the ranges of pixels scatter, None where their standard deviations hold it, or the surface bends.
    `range_m`, `sigma_m`: [rows, cols] metres. `sure`: [rows, cols] bool, pixels whose ranges count."""
    (off, told), (farther, _) = (_beside(range_m, sigma_m, sure, lag) for lag in (1, 2))
    if min(len(off), len(farther)) < ENOUGH:
        return None
    spread, second = (MAD_TO_SIGMA * float(np.median(np.abs(values))) / np.sqrt(6) for values in (off, farther))
    times = MAD_TO_SIGMA * float(np.median(np.abs(off) / np.maximum(told, 1e-12)))
    if times < TIMES or second > OF_PIXELS * spread:
        return None
    return Scatter(spread * float(np.sqrt(1 - 1 / times**2)), times)


def _beside(range_m: np.ndarray, sigma_m: np.ndarray, sure: np.ndarray, lag: int) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much ranges are off from twice the mean of their neighbours `lag` pixels away, along columns and rows, and the standard
    deviations of that."""
    off, told = [], []
    for axis in (0, 1):
        (before, here, after), (first, middle, last), kept = (
            (lines[: -2 * lag], lines[lag:-lag], lines[2 * lag :])
            for lines in (np.moveaxis(values, axis, 0) for values in (range_m, sigma_m, sure)))
        known = np.logical_and.reduce(kept)
        off.append((before - 2 * here + after)[known].astype(np.float64))
        told.append(np.sqrt(first**2 + 4 * middle**2 + last**2)[known].astype(np.float64))
    return np.concatenate(off), np.concatenate(told)
