"""Whether few lights support the general solver: what it predicts of left-out lights is compared with what Lambert's law predicts."""

import numpy as np

from kernels.photometric.left_out import LeftOut, leave_out
from kernels.photometric.samples import Samples
from service.solve.solution import Solution

FEW_LIGHTS = 32
"""Fewer lights than this, four for each of the eight unknowns of a pixel, must show that they support the general solver."""
TESTED_LIGHTS = 6
"""With fewer lights than this none can be left out: those that remain would not determine what is tested."""
SUPPORTED_RATIO = 0.7
"""Largest misfit of left-out readings, over that of Lambert's law, at which the general solver is supported: 0.28 to 0.5 on objects where
its normals are better, real and path-traced, 0.9 and above where they follow errors of the lights."""


def supports_lobes(result: Solution, samples: Samples, start: np.ndarray) -> bool:
    """Return whether few lights support the general solver, and say in the solution what speaks against it.

    Args:
        result: whose facts and warnings are added to.
        samples: some hundreds of pixels, spread over the object.
        start: [n, 3] unit normals to begin from.
    """
    count = samples.light_count
    fallback = ("normals are drawn to those of lambert and no specular lobe is estimated; capture 32 lights or more, "
                "spread over the hemisphere, or take --method robust")
    if count < TESTED_LIGHTS:
        result.warnings.append(f"method svbrdf: {count} lights are fewer than the unknowns of a pixel: {fallback}.")
        return False
    left: LeftOut = leave_out(samples, start)
    result.facts |= {"left_out_misfit": round(left.general, 4), "left_out_misfit_lambert": round(left.lambert, 4)}
    if left.ratio > SUPPORTED_RATIO:
        result.warnings.append(f"method svbrdf: the images of left-out lights are predicted hardly better with specular lobes than without "
                               f"(misfit {left.general:.2g} against {left.lambert:.2g}): {fallback}.")
    return left.ratio <= SUPPORTED_RATIO
