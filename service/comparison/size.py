"""Whether a scan is larger or smaller than its design as a whole: the error of a scanner's calibration or of the unit, not of the part.

A factor about the middle of the points is fitted to the mean deviations of patches together with a small motion, with Cauchy weights, so
that faults of the part do not decide; which patches it helps tells whether it is one. A part that is too thick, or whose design has flats
in place of curves, is larger too, but not along all axes alike: then there is no factor of the whole.
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
ALIKE = 0.5
"""Part of the growth by which that along an axis may differ from it: the part may be off as well."""
NOT_TOLD = 1e-9
"""Part of the largest eigenvalue of the normal equations, of columns of one length, that is rounding: nothing tells such a direction."""


class Size(NamedTuple):
    """The size of a scan in that of its design."""

    factor: float
    sigma: float


def size_of(patches: Patches, pivot: np.ndarray) -> Size | None:
    """Return by which factor a scan is larger than its design, about a pivot [3] metres; None where it is not known to differ from 1, or
    not along two axes of the design or more, or is not about the same along all that are known."""
    if len(patches.deviation) < LEAST_PATCHES:
        return None
    motion = gradient(patches.middle, patches.normal, pivot)
    growth = patches.normal * (patches.middle - pivot)
    without, _, _ = _robust(motion, patches.deviation)
    left, values, errors = _robust(np.column_stack([motion, growth.sum(axis=1)]), patches.deviation)
    factor, error = float(values[-1]), float(errors[-1])
    if abs(factor) <= SURE * error or np.median(np.abs(left)) >= HELPS * np.median(np.abs(without)):
        return None
    _, values, errors = _robust(np.column_stack([motion, growth]), patches.deviation)
    told = SURE * errors[-3:] < abs(factor)  # axes along which the surface tells a growth of that size
    alike = np.abs(values[-3:] - factor)[told] < ALIKE * abs(factor)
    return Size(1 + factor, error) if told.sum() > 1 and alike.all() else None


def _robust(design: np.ndarray, deviation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what a fit with Cauchy weights leaves of deviations [p], its values, and their standard errors, inf of those that nothing
    tells."""
    weight = np.ones(len(deviation))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)
        values = np.linalg.lstsq(design * root[:, None], deviation * root)[0]
        left = deviation - design @ values
        scale = max(MAD_TO_SIGMA * float(np.median(np.abs(left))), 1e-12)
        weight = 1 / (1 + (left / scale) ** 2)
    lengths = np.maximum(np.sqrt((design**2 * weight[:, None]).sum(axis=0)), 1e-300)
    scaled = design / lengths
    powers, axes = np.linalg.eigh(scaled.T @ (scaled * weight[:, None]))
    told = powers > NOT_TOLD * powers[-1]
    inverse = (axes[:, told] / powers[told]) @ axes[:, told].T
    scores = inverse @ (scaled * (weight * left)[:, None]).T
    unknown = (axes[:, ~told] ** 2).sum(axis=1) > NOT_TOLD
    return left, values, np.where(unknown, np.inf, np.sqrt((scores**2).sum(axis=1)) / lengths)
