"""Light that all images share and their lamps do not give, as light of the room: it reaches what is turned away from a lamp.

Lambert's law and a constant are fitted to the readings of each pixel, the constant alone to those under lamps behind its surface, which
read what other light there is. Light that bounces from other parts of the object reads otherwise under each lamp, and somewhere hardly at
all; light of the room reads alike, and nowhere nothing.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.lambertian import CAUCHY, LEAST_SPREAD, Fit, fit_lambertian, least_squares, median_of
from stage.spread import MAD_TO_SIGMA

EDGE = 0.1
"""Cosine to a lamp, or −cosine behind a surface, from which on a reading is compared: normals are wrong by some degrees."""
ROUNDS = 4
"""Rounds in which the readings that lie in shadow are found anew."""
LEAST_PIXELS = 30
"""Least count of pixels with readings in shadow."""
LOW, LEAST_LEVEL = 0.05, 0.04
"""Quantile of the least reading in shadow of each pixel, over what a lamp gives that it faces, and the least value from which on all images
share light: .017 at most on 126 right captures of matt, glossy and metal objects with folds and hollows, and .07 of a metal relief."""

ALIKE, MOST_PART = 0.5, 1.5
"""Least median of the constants of all pixels, over that of those in shadow: near lamps, declared distant, reach where a few pixels seem to
lie in shadow (.1). And the largest: brighter rooms hide the lamps, and images that a phone adapts in brightness look so (2.4)."""


class SteadyLight(NamedTuple):
    """Light that all images share."""

    fit: Fit
    """The fit without it."""
    part: np.ndarray  # [pixels] of what a lamp gives that the pixel faces
    in_shadow: bool | None
    """True if the readings in shadow show it; None where too few pixels have any."""


def fit_steady_light(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, shared: np.ndarray) -> SteadyLight:
    """Fit Lambert's law and a constant.

    Args:
        readings: [lights, pixels] radiance over irradiance.
        usable: [lights, pixels] bool, True for unsaturated readings.
        directions: [lights, 3] unit vectors to the lights.
        shared: [lights, 1] readings of the same radiance under each light, mean 1.
    """
    vector = fit_lambertian(readings, usable, np.hstack([directions, shared])).vector
    basis = np.vstack([np.hstack([directions, shared]), np.hstack([np.zeros_like(directions), shared])])  # of lit ones, of those in shadow
    twice = np.concatenate([readings, readings])
    for _ in range(ROUNDS):
        length = np.maximum(np.linalg.norm(vector[:3], axis=0), 1e-200)
        cosine = directions @ vector[:3] / length
        chosen = np.concatenate([usable & (cosine > EDGE), usable & (cosine < -EDGE)])
        residual = np.where(chosen, twice - basis @ vector, 0) / length
        spread = MAD_TO_SIGMA * median_of(np.abs(residual), chosen) + LEAST_SPREAD
        vector = least_squares(twice, chosen / (1 + (residual / (CAUCHY * spread)) ** 2), basis)
    length = np.maximum(np.linalg.norm(vector[:3], axis=0), 1e-200)
    cosine = directions @ vector[:3] / length
    lit, dark = usable & (cosine > EDGE), usable & (cosine < -EDGE)
    residual = np.where(lit, readings - basis[: len(readings)] @ vector, 0) / length
    level = readings / (shared * length)
    lowest, highest = np.where(dark, level, np.inf).min(axis=0), np.where(dark, level, -np.inf).max(axis=0)
    several = dark.sum(axis=0) > 1
    range_ = float(np.median((highest - lowest)[several])) if several.any() else 0.0
    told = dark.any(axis=0)
    part, in_shadow = vector[3] / length, None
    if told.sum() >= LEAST_PIXELS:
        least = float(np.quantile(lowest[told], LOW))
        in_shadow = least > max(LEAST_LEVEL, range_) and bool(ALIKE * least < np.median(part) < MOST_PART)
    return SteadyLight(Fit(vector[:3], residual, lit), part, in_shadow)
