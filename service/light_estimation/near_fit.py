"""A robust Lambertian fit of the readings of a few pixels under near lights, wherever their points are thought to be.

What it leaves is relative to the bright readings of the pixel, which do not depend on where the point is thought to be, so that places can
be compared by it.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.lambertian import CAUCHY, LEAST_SPREAD, SHADOW, bright_readings, median_of
from stage.spread import MAD_TO_SIGMA

ROUNDS = 3
"""Rounds of re-weighting."""
LARGEST = 1e6
"""Residuals are cut here: where all lights are in one line of sight, normals that cannot be found leave anything."""


class NearLamps(NamedTuple):
    """Lights as `stage.capture.point_lights.PlacedLights` has them, of one strength for all channels."""

    place: np.ndarray  # [lights, 4] metres and 1, or unit direction and 0
    strength: np.ndarray  # [lights] intensity, or irradiance
    lobe: np.ndarray  # [lights, 4] axis and exponent


class NearFit(NamedTuple):
    """The normals of pixels, and what they leave."""

    normal: np.ndarray  # [3, pixels] float64, unit
    residual: np.ndarray  # [lights, pixels] float64, over the bright readings of the pixel; 0 where not lit
    lit: np.ndarray  # [lights, pixels] bool: readings that are compared, the same wherever the points are


def fit_near(readings: np.ndarray, usable: np.ndarray, lamps: NearLamps, points: np.ndarray) -> NearFit:
    """Fit E b·l to the readings of each pixel, where E is the irradiance that each light has at its point.

    Args:
        readings: [lights, pixels] radiance.
        usable: [lights, pixels] bool, True for unsaturated readings.
        points: [pixels, 3] metres, camera frame.
    """
    way = lamps.place[:, None, :3] - lamps.place[:, None, 3:] * points  # [lights, pixels, 3]
    distance = np.maximum(np.linalg.norm(way, axis=2), 1e-12)
    direction = way / distance[..., None]
    shining = np.maximum(-np.einsum("lc,lpc->lp", lamps.lobe[:, :3], direction), 0) ** lamps.lobe[:, 3:]
    irradiance = lamps.strength[:, None] * shining / np.where(lamps.place[:, 3:] == 1, distance**2, 1.0)
    # one factor a pixel: only the ratios of the lights count
    lit_by = direction * (irradiance / np.maximum(irradiance.mean(axis=0), 1e-300))[..., None]
    bright = np.maximum(bright_readings(readings, usable), 1e-300)
    relative = readings / bright
    lit = usable & (relative > SHADOW)
    weight = lit.astype(np.float64)
    for _ in range(ROUNDS):
        weighted = lit_by * weight[..., None]
        gram = np.einsum("lpa,lpb->pab", weighted, lit_by)
        gram += (1e-9 * np.trace(gram, axis1=1, axis2=2) + 1e-200)[:, None, None] * np.eye(3)
        vector = np.linalg.solve(gram, np.einsum("lpa,lp->pa", weighted, relative)[:, :, None])[:, :, 0]
        residual = np.where(lit, np.clip(relative - np.einsum("lpa,pa->lp", lit_by, vector), -LARGEST, LARGEST), 0)
        spread = MAD_TO_SIGMA * median_of(np.abs(residual), lit) + LEAST_SPREAD
        weight = lit / (1 + (residual / (CAUCHY * spread)) ** 2)
    return NearFit((vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-300)).T, residual, lit)
