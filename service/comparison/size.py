"""Whether a scan is larger or smaller than its design as a whole: the error of a scanner's calibration or of the unit, not of the part.

A factor about the middle of the points is fitted to the mean deviations of patches together with a small motion, with Cauchy weights, so
that faults of the part do not decide; which patches it helps tells whether it is one.
"""

from typing import NamedTuple

import numpy as np

from service.comparison.deviations import Patches
from service.comparison.placing import gradient
from stage.spread import MAD_TO_SIGMA

ROUNDS = 15
SURE = 6.0
"""Standard errors by which the factor differs from 1 to be one."""
HELPS = 0.8
"""Median deviation of the patches with the factor, over that without it, above which it explains too little."""
LEAST_PATCHES = 40


class Size(NamedTuple):
    """The size of a scan in that of its design."""

    factor: float
    sigma: float


def size_of(patches: Patches, pivot: np.ndarray) -> Size | None:
    """Return by which factor a scan is larger than its design, about a pivot [3] metres; None where it is not known to differ from 1."""
    if len(patches.deviation) < LEAST_PATCHES:
        return None
    motion = gradient(patches.middle, patches.normal, pivot)
    growth = np.einsum("pi,pi->p", patches.normal, patches.middle - pivot)[:, None]
    without, _, _ = _robust(motion, patches.deviation)
    left, values, spread = _robust(np.column_stack([motion, growth]), patches.deviation)
    factor = float(values[-1])
    sure = abs(factor) > SURE * spread and np.median(np.abs(left)) < HELPS * np.median(np.abs(without))
    return Size(1 + factor, spread) if sure else None


def _robust(design: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return what a fit with Cauchy weights leaves of deviations [p], its values, and the standard error of the last one."""
    weight = np.ones(len(deviation))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        values = np.linalg.lstsq(design * root[:, None], deviation * root)[0]
        left = deviation - design @ values
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-12)
        weight = 1 / (1 + (left / scale) ** 2)
    inverse = np.linalg.pinv(design.T @ (design * weight[:, None]), hermitian=True)
    scores = inverse @ (design * (weight * left)[:, None]).T
    return left, values, float(np.sqrt((scores[-1] ** 2).sum()))
