"""What the fine relief of a depth says of that of the normals of the same view: by which factor theirs is lower, and whether one of the two
is shifted against the other.

Heights are compared without what is wider than some thirty pixels, where drift is. Normals whose model does not hold are too flat, or too
steep, everywhere alike; a depth from another place of the camera shows the same relief some pixels aside; one that was smoothed lacks what
the curvature has, which is fitted beside both.
"""

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


class Relief(NamedTuple):
    """The fine relief of a depth beside that of normals."""

    factor: float
    """By which the heights of the normals are to be multiplied; 1 where it is not sure to be another."""
    shift_px: tuple[float, float]
    """By how much the depth lies to the right and down against the normals; 0 where it is not sure."""


def compare_relief(height: np.ndarray, sigma: np.ndarray, base: np.ndarray, known: np.ndarray, part: np.ndarray) -> Relief:
    """Compare heights of a depth with those of normals, [rows, cols] each in units of the pixels' distance.
    `sigma`: standard deviations of the depth's. `known`: where there is a depth. `part`: number of the part of each pixel, -1 outside."""
    slope = [np.gradient(base, axis=axis) if base.shape[axis] > 1 else np.zeros(base.shape) for axis in (1, 0)]
    inside = known.copy()
    for axis in (0, 1):  # slopes across a step are none
        for way in (1, -1):
            inside &= np.roll(part, way, axis) == part
    rows, cols = np.nonzero(inside)
    if len(rows) < (1 << 2 * WIDE):
        return Relief(1.0, (0.0, 0.0))
    chosen = evenly(len(rows), MOST_PIXELS)
    rows, cols = rows[chosen], cols[chosen]
    bend = sum(np.gradient(each, axis=axis) for each, axis in zip(slope, (1, 0), strict=True))  # of a depth that was smoothed
    fine = [_fine(plane, inside)[rows, cols] for plane in (height - base, base, -slope[0], -slope[1], np.asarray(bend))]
    design, left = np.stack(fine[1:], axis=1), fine[0]
    weight = 1 / sigma[rows, cols] ** 2
    trust = np.ones(len(left))
    for _ in range(ROUNDS):
        used = weight * trust
        inverse = np.linalg.pinv(design.T @ (design * used[:, None]), hermitian=True)
        values = inverse @ (design.T @ (used * fine[0]))
        left = fine[0] - design @ values
        spread = max(MAD_TO_SIGMA * float(np.median(np.abs(left) * np.sqrt(weight))), 1e-12)
        trust = 1 / (1 + weight * (left / (2 * spread)) ** 2)
    error = np.sqrt(np.diag(between_blocks(inverse, design * (used * left)[:, None], cols, rows)))
    sure = np.abs(values[:3]) > np.maximum(SURE * error[:3], (LEAST_FACTOR, LEAST_SHIFT_PX, LEAST_SHIFT_PX))
    factor, shift = 1 + float(values[0]), (float(values[1]), float(values[2]))
    return Relief(factor if sure[0] and 1 / MOST_FACTOR < factor < MOST_FACTOR else 1.0,
                  shift if sure[1:].any() and np.hypot(*shift) < MOST_SHIFT_PX else (0.0, 0.0))


def _fine(plane: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return a map without what is wider than the cells of the scale."""
    held = inside.astype(np.float64)
    count = sum_cells(held, WIDE)
    mean = sum_cells(np.where(inside, plane, 0), WIDE) / np.where(count > 0, count, 1)
    return np.asarray(plane - interpolated(mean, count, plane.shape, WIDE))
