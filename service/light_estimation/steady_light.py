"""Light that all images share and their lamps do not give, as light of the room: it reaches what is turned away from a lamp.

Lambert's law and a constant are fitted to each pixel, the constant alone to readings under lamps behind its surface. Light that bounces
from other parts of the object differs there from lamp to lamp, and is somewhere hardly any; light of the room is alike, and nowhere none.
"""

import numpy as np

from service.light_estimation.lambertian import CAUCHY, LEAST_SPREAD, Fit, fit_lambertian, least_squares, median_of
from service.light_estimation.semi_calibrated import TINY
from stage.spread import MAD_TO_SIGMA

EDGE, ROUNDS, LEAST_PIXELS = 0.1, 4, 30
"""Cosine to a lamp, or −cosine behind a surface, from which on a reading is compared, as normals are wrong by some degrees; rounds in which
the readings in shadow are found anew; and least count of pixels that have any."""
LOW, LEAST_LEVEL = 0.05, 0.04
"""Quantile of the least reading in shadow of each pixel, over what a lamp gives that it faces, and the least value from which on all images
share light: .017 at most on 126 right captures of matt, glossy and metal objects with folds and hollows, and .07 of a metal relief."""
ALIKE, MOST_PART = 0.5, 1.5
"""Least median of the constants of all pixels, over that of those in shadow: near lamps, declared distant, reach where a few pixels seem to
lie in shadow (.1). And the largest: brighter rooms hide the lamps, and images that a phone adapts in brightness look so (2.4)."""


def fit_steady_light(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, irradiance: np.ndarray
                     ) -> tuple[Fit, np.ndarray, bool | None]:
    """Fit Lambert's law and a constant to readings [lights, pixels], as `fit_lambertian` does. `irradiance`: [lights, 3].
    Returns the fit without the constant; the constant over what a lamp gives that the pixel faces, [pixels]; and whether the readings in
    shadow show that all images share it, None where too few pixels have any."""
    shared = 1 / np.maximum(irradiance.mean(axis=1, keepdims=True), 1e-12 * irradiance.max())  # what the same radiance in all images reads
    shared /= np.median(shared)
    vector = fit_lambertian(readings, usable, np.hstack([directions, shared])).vector
    basis = np.vstack([np.hstack([directions, shared]), np.hstack([np.zeros_like(directions), shared])])  # of lit ones, of those in shadow
    twice = np.concatenate([readings, readings])
    for _ in range(ROUNDS):
        length = np.maximum(np.linalg.norm(vector[:3], axis=0), TINY)
        cosine = directions @ vector[:3] / length
        chosen = np.concatenate([usable & (cosine > EDGE), usable & (cosine < -EDGE)])
        residual = np.where(chosen, twice - basis @ vector, 0) / length
        spread = MAD_TO_SIGMA * median_of(np.abs(residual), chosen) + LEAST_SPREAD
        vector = least_squares(twice, chosen / (1 + (residual / (CAUCHY * spread)) ** 2), basis)
    length = np.maximum(np.linalg.norm(vector[:3], axis=0), TINY)
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
    return Fit(vector[:3], residual, lit), part, in_shadow
