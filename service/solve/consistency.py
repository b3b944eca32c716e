"""Lights that disagree with the others: a direction or a strength in the manifest that the images contradict."""

from typing import NamedTuple

import numpy as np

from kernels.photometric.readings import Lights, channel_weights
from kernels.photometric.samples import evenly
from kernels.status import Status
from service.solve.solution import Solution
from stage.colour import GREY_WEIGHTS
from stage.stack import Stack

PIXELS = 512
"""Of the surest, spread over the object."""
LEAST_COSINE = 0.25
"""Lights lower over the surface are not compared: shadows and grazing reflection are no fault of theirs."""
LEAST_TOWARDS = 0.4
"""Lights further round than this cosine to the view axis are not judged: rims reflect them like mirrors, and most pixels are hidden."""
LEAST_PIXELS = 20
"""A light that fewer of them see is not judged."""
SUSPECT_OFF, SUSPECT_TIMES = 0.1, 4.0
"""A light is suspect when its median relative misfit is above the first, and above the second times that of the lights together."""


class Suspect(NamedTuple):
    """A light that disagrees."""

    image: str
    misfit: float
    """Median over pixels of |reading / (level · n·l) - 1|, the level being the pixel's own median over its lights."""


def suspect_lights(solution: Solution, stack: Stack, lights: Lights) -> list[Suspect]:
    """Compare each light's readings with what the solved normals say of it.

    Args:
        solution: solved under these lights.
        stack: its images.
        lights: distant, padded.

    Returns:
        The lights that disagree, worst first.
    """
    solved = np.flatnonzero(solution.status == Status.OK)
    if len(solved) < 2 * LEAST_PIXELS:
        return []
    confidence = solution.confidence[solved].astype(np.float32)
    sure = solved[confidence >= np.median(confidence)]
    chosen = sure[evenly(len(sure), PIXELS)]
    values, _ = stack.pick(chosen)
    count = stack.light_count
    weights = channel_weights(lights, GREY_WEIGHTS)
    factor = np.divide(weights * lights.scale[:count, None], lights.irradiance[:count],
                       out=np.zeros((count, 3)), where=lights.irradiance[:count] > 0)
    readings = np.einsum("lc,clp->lp", factor, values[:, :count].astype(np.float64))
    cosine = lights.direction[:count].astype(np.float64) @ solution.normal[:, chosen]
    seen = (cosine > LEAST_COSINE) & (lights.direction[:count, 2:] > LEAST_TOWARDS)
    ratio = np.where(seen, readings / np.maximum(cosine, LEAST_COSINE), np.nan)
    lit = seen.any(axis=0)
    judged = np.flatnonzero(seen[:, lit].sum(axis=1) >= LEAST_PIXELS)
    if not len(judged):
        return []
    level = np.maximum(np.nanmedian(ratio[:, lit], axis=0), 1e-12)
    misfit = np.nanmedian(np.abs(ratio[np.ix_(judged, lit)] / level - 1), axis=1)
    limit = max(SUSPECT_OFF, SUSPECT_TIMES * float(np.median(misfit)))
    return [Suspect(stack.frames[judged[i]], round(float(misfit[i]), 3)) for i in np.argsort(-misfit) if misfit[i] > limit]
