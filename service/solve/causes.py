"""What the solvers leave open, said per pixel: whether shadow or saturation took the lights, and whether a normal is loose."""

import numpy as np

from kernels.status import Status
from service.solve.solution import Solution
from stage.stack import Stack

LOOSE_CONFIDENCE = 1.0 / (1.0 + 5.0)
"""Confidence of a normal whose standard error is five degrees."""
PIXELS_AT_ONCE = 1 << 16
"""Whose saturation bits are counted together."""


def name_causes(solution: Solution, stack: Stack) -> None:
    """Refine the status of a solution in place.

    Pixels with too few lights become SATURATED where at least as many readings saturate as are missing to three, else SHADOWED;
    solved pixels with a confidence under 1/6 become AMBIGUOUS and keep their values.

    Args:
        solution: of any solver.
        stack: its images.
    """
    few = np.flatnonzero(solution.status == Status.TOO_FEW_LIGHTS)
    for first in range(0, len(few), PIXELS_AT_ONCE):
        part = few[first : first + PIXELS_AT_ONCE]
        bits = stack.pick_saturated(part)
        saturated = np.unpackbits(bits, axis=0, bitorder="little")[: stack.light_count].sum(axis=0)
        solution.status[part] = np.where(saturated >= 1, int(Status.SATURATED), int(Status.SHADOWED))
    loose = (solution.status == Status.OK) & (solution.confidence.astype(np.float32) < LOOSE_CONFIDENCE)
    solution.status[loose] = Status.AMBIGUOUS
