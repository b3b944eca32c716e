"""What the fine relief of a depth says of that of the normals of the same view: by which factor theirs is lower, and whether one of the two
is shifted against the other.

Heights are compared without what is wider than some thirty pixels, where drift is; for a shift, without a polynomial over the part. Normals
whose model does not hold are too flat, or too steep, everywhere alike; a depth from another place of the camera shows the same relief some
pixels aside; one that was smoothed lacks what the curvature has, which is fitted beside both.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.joining.cells import interpolated, sum_cells
from stage.spread import MAD_TO_SIGMA, between_blocks

WIDE = 5
"""Scale of what is taken away, cells of 2^5 pixels."""
MOST_PIXELS = 300_000
"""Pixels that are compared."""
ROUNDS = 10
"""Fits, each with the Cauchy weights of the one before."""
SURE = 6.0
"""Standard errors beyond which the factor or the shift is one."""
LEAST_FACTOR, LEAST_SHIFT_PX = 0.05, 0.3
MOST_FACTOR, MOST_SHIFT_PX = 2.0, 8.0
"""Beyond these there is no common relief: that of the normals of a flat surface is their noise."""
DEGREE, GENTLE = 4, 0.6
"""Degree in rows and columns of the polynomial that is taken for drift, and slope up to which a shift is looked for: one of 160 depths that
are not shifted, beside normals with drift of up to 15°, is said to be; 10 of 24 shifted by 2 pixels are, others are too round or flat."""


class _Pixels(NamedTuple):
    """Pixels at which heights and slopes of one part are compared."""

    rows: np.ndarray  # [n]
    cols: np.ndarray
    terms: list[np.ndarray]  # [rows, cols] each: the height, both slopes with the sign of a shift, and what smoothing takes away
    inside: np.ndarray  # [rows, cols] bool


def relief_factor(height: np.ndarray, sigma: np.ndarray, base: np.ndarray, known: np.ndarray, part: np.ndarray) -> float:
    """Return by which factor the relief of a depth exceeds that of normals; 1 where it is not sure to be another.

    Args:
        height, base: [rows, cols] heights of the depth and of the normals, in units of the pixels' distance.
        sigma: [rows, cols] standard deviations of the depth's.
        known: [rows, cols] bool, where there is a depth.
        part: [rows, cols] number of the part of each pixel, -1 outside.
    """
    at = _pixels(base, known, part)
    if at is None:
        return 1.0
    design = np.stack([fine_relief(plane, at.inside)[at.rows, at.cols] for plane in at.terms], axis=1)
    values, error = _fitted(design, fine_relief(height - base, at.inside)[at.rows, at.cols], sigma, at)
    factor = 1 + float(values[0])
    return factor if abs(values[0]) > max(SURE * error[0], LEAST_FACTOR) and 1 / MOST_FACTOR < factor < MOST_FACTOR else 1.0


def relief_shift_px(height: np.ndarray, sigma: np.ndarray, base: np.ndarray, known: np.ndarray, part: np.ndarray,
                    drifts: Sequence[np.ndarray] = ()) -> tuple[float, float]:
    """Return by how many pixels a depth lies to the right and down against normals; 0 where it is not sure. What a polynomial over the part
    explains is drift, and so is any of `drifts`, [rows, cols] each; the other arguments are those of `relief_factor`."""
    at = _pixels(base, known & (np.hypot(*_slopes(base)) < GENTLE), part)
    if at is None:
        return 0.0, 0.0
    x, y = (2 * (place - place.min()) / max(np.ptp(place), 1) - 1 for place in (at.cols, at.rows))
    drift = np.polynomial.legendre.legvander2d(x, y, [DEGREE, DEGREE])
    design = np.concatenate([np.stack([plane[at.rows, at.cols] for plane in (*at.terms, *drifts)], axis=1), drift], axis=1)
    values, error = _fitted(design, (height - base)[at.rows, at.cols], sigma, at)
    shift = float(values[1]), float(values[2])
    sure = (np.abs(values[1:3]) > np.maximum(SURE * error[1:3], LEAST_SHIFT_PX)).any()
    return shift if sure and np.hypot(*shift) < MOST_SHIFT_PX else (0.0, 0.0)


def _slopes(base: np.ndarray) -> list[np.ndarray]:
    """Return by how much heights rise from pixel to pixel to the right, and down."""
    return [np.gradient(base, axis=axis) if base.shape[axis] > 1 else np.zeros(base.shape) for axis in (1, 0)]


def _pixels(base: np.ndarray, known: np.ndarray, part: np.ndarray) -> _Pixels | None:
    """Return the pixels that are compared; None where there are too few."""
    slope = _slopes(base)
    inside = known.copy()
    for axis in (0, 1):  # slopes across a step are none
        for way in (1, -1):
            inside &= np.roll(part, way, axis) == part
    rows, cols = np.nonzero(inside)
    if len(rows) < (1 << 2 * WIDE):
        return None
    chosen = evenly(len(rows), MOST_PIXELS)
    bend = np.asarray(sum(np.gradient(each, axis=axis) for each, axis in zip(slope, (1, 0), strict=True)))  # of a depth that was smoothed
    return _Pixels(rows[chosen], cols[chosen], [base, -slope[0], -slope[1], bend], inside)


def _fitted(design: np.ndarray, wanted: np.ndarray, sigma: np.ndarray, at: _Pixels) -> tuple[np.ndarray, np.ndarray]:
    """Return the factors of the columns of a design that explain values best, and their standard errors."""
    weight = 1 / sigma[at.rows, at.cols] ** 2
    trust, left = np.ones(len(wanted)), wanted
    for _ in range(ROUNDS):
        used = weight * trust
        inverse = np.linalg.pinv(design.T @ (design * used[:, None]), hermitian=True)
        values = inverse @ (design.T @ (used * wanted))
        left = wanted - design @ values
        spread = max(MAD_TO_SIGMA * float(np.median(np.abs(left) * np.sqrt(weight))), 1e-12)
        trust = 1 / (1 + weight * (left / (2 * spread)) ** 2)
    return values, np.sqrt(np.diag(between_blocks(inverse, design * (used * left)[:, None], at.cols, at.rows)))


def fine_relief(plane: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return a map without what is wider than the cells of the scale, [rows, cols], where it is `inside`."""
    held = inside.astype(np.float64)
    count = sum_cells(held, WIDE)
    mean = sum_cells(np.where(inside, plane, 0), WIDE) / np.where(count > 0, count, 1)
    return np.asarray(plane - interpolated(mean, count, plane.shape, WIDE))
