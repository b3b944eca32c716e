"""Whether images look adapted in brightness from place to place, as HDR modes of phones and controls of local contrast make them.

An image that was dimmed where it was bright, and brightened where it was dark, is mended by a power of its own brightness around each
pixel. Lights of other strengths mend such images too, by other normals: where both explain them, nobody knows which it is.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.explanations import Sample, fit_manifest, grey_readings
from service.light_estimation.lambertian import Fit, fit_lambertian

POWERS = (0.15, 0.3, 0.5, 0.75, 1.0, 1.4, 2.0)
"""Powers of the brightness around a pixel that are tried."""
AROUND = 0.12
"""Standard deviation of the surroundings of a pixel, as a part of the extent of the object."""
LEAST_MISFIT, LEAST_GAIN = 0.02, 1.3
"""Least misfit without the power; and least misfit without over that with it: of 120 right captures, matt ones to metal and velvet, with
flicker, bounced light and a fall towards the corners, none reaches it."""


class Adapted(NamedTuple):
    """Images that a power of their local brightness explains."""

    power: float
    fit: Fit


def find_adapted(sample: Sample, places: np.ndarray) -> Adapted | None:
    """Return the power of the local brightness that explains images much better than none, or None.
    `places`: [pixels, 2] of the sample, in any unit."""
    readings = grey_readings(sample.radiance, sample.irradiance)
    extent = float(np.ptp(places, axis=0).max())
    squares = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    near = np.exp(-squares / (2 * (AROUND * max(extent, 1e-12)) ** 2))
    bright = readings @ (near / near.sum(axis=1, keepdims=True)).T
    floor = 1e-4 * float(bright.max())
    if floor <= 0:
        return None
    tried = ((power, fit_lambertian(readings * np.maximum(bright, floor) ** power, sample.usable, sample.directions)) for power in POWERS)
    best = min((Adapted(*each) for each in tried), key=lambda each: each.fit.misfit())
    return best if fit_manifest(sample).misfit() > max(LEAST_MISFIT, LEAST_GAIN * best.fit.misfit()) else None
