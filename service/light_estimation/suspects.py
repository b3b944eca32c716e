"""Lights whose direction or strength in the manifest the images contradict, while the other lights agree with each other."""

from typing import NamedTuple

import numpy as np

LEAST_COSINE = 0.25
"""Least n·l of a reading that is compared: below it, shadows and grazing reflection cause misfits that are not the light's fault."""
LEAST_TOWARDS = 0.4
"""Least cosine between a light and the view axis at which the light is judged: lights further round are mirrored by rims and hidden from
most pixels."""
LEAST_PIXELS = 20
"""Least number of these pixels that must see a light for it to be judged."""
SUSPECT_OFF, SUSPECT_TIMES = 0.1, 4.0
"""A light is suspect when its median relative misfit is above the first number, and above the second number times the median of all
lights."""


class Suspect(NamedTuple):
    """A light that disagrees with the others."""

    light: int
    """Index of the light."""
    misfit: float
    """Median over pixels of |reading / (level · n·l) - 1|, the level being the pixel's own median over its lights."""


def suspects(readings: np.ndarray, directions: np.ndarray, normal: np.ndarray) -> list[Suspect]:
    """Return the lights that disagree with the others, worst first.
    `readings`: [lights, pixels] grey radiance over irradiance. `normal`: [3, pixels] unit normals that were found under these lights."""
    cosine = directions @ normal
    seen = (cosine > LEAST_COSINE) & (directions[:, 2:] > LEAST_TOWARDS)
    ratio = np.where(seen, readings / np.maximum(cosine, LEAST_COSINE), np.nan)
    lit = seen.any(axis=0)
    judged = np.flatnonzero(seen[:, lit].sum(axis=1) >= LEAST_PIXELS)
    if not len(judged):
        return []
    level = np.maximum(np.nanmedian(ratio[:, lit], axis=0), 1e-12)
    misfit = np.nanmedian(np.abs(ratio[np.ix_(judged, lit)] / level - 1), axis=1)
    limit = max(SUSPECT_OFF, SUSPECT_TIMES * float(np.median(misfit)))
    return [Suspect(int(judged[i]), float(misfit[i])) for i in np.argsort(-misfit) if misfit[i] > limit]
