"""Per-pixel status codes of every solver: bad pixels are data, not exceptions."""

from enum import IntEnum

import numpy as np


class Status(IntEnum):
    """The reason why a pixel has a result or none. Only the codes of ESTIMATED carry values; an unwritten pixel is never among them."""

    UNSOLVED = 0
    """Never reached by a solver (outside the mask)."""
    OK = 1
    """Solved."""
    TOO_FEW_LIGHTS = 2
    """Fewer usable lights than the unknowns need (shadow, saturation or rejection took the rest)."""
    DARK = 3
    """No light gave a reading above the noise."""
    ILL_POSED = 4
    """The usable lights lie close to one plane, or the readings are the same from every side: the normal is not determined."""
    NOT_FACING = 5
    """The best normal points away from the camera."""
    SATURATED = 6
    """Too few usable lights, and it was saturation that took the others."""
    SHADOWED = 7
    """Too few usable lights: the others are in shadow."""
    AMBIGUOUS = 8
    """Solved, but the readings leave the normal open by more than five degrees (standard error)."""
    NOT_CONVERGED = 9
    """Solved, but normals and depth under near lights still moved each other in the last round."""
    LOW_MODULATION = 10
    """Depth: the projected or emitted signal is too weak to be decoded."""
    OUT_OF_RANGE = 11
    """Depth: decoded, but to a place that the projector or laser cannot have lit, or outside the measured range."""
    UNDECIDED = 12
    """Depth: the readings fit several places about equally well."""
    FLYING = 13
    """Depth: a mixture of two surfaces, taken out by a filter that was asked for."""
    MULTIPATH = 14
    """Depth: frequencies or codes disagree: light came over several ways."""
    UNSURE = 15
    """Estimated, but less surely than was asked for: the value and its standard deviation are kept, outside the mask of the result."""
    OCCLUDED = 16
    """Depth: the place is hidden from the other camera, or lies outside its image."""


SOLVED = (Status.OK, Status.AMBIGUOUS, Status.NOT_CONVERGED)
"""Codes of pixels that count as solved: the mask of a result."""
ESTIMATED = (*SOLVED, Status.UNSURE, Status.UNDECIDED, Status.MULTIPATH, Status.FLYING)
"""Codes of pixels that may carry values. A solver that has no estimate at a pixel of the last three leaves it 0."""

UNSOLVED = int(Status.UNSOLVED)
OK = int(Status.OK)
TOO_FEW_LIGHTS = int(Status.TOO_FEW_LIGHTS)
DARK = int(Status.DARK)
ILL_POSED = int(Status.ILL_POSED)
NOT_FACING = int(Status.NOT_FACING)


def refuse_unsure(status: np.ndarray, sigma: np.ndarray | None, confidence: np.ndarray | None, *, max_sigma: float | None,
                  least_confidence: float) -> None:
    """Set the status UNSURE, in place, where a solved pixel is less sure than was asked for.

    Args:
        status: codes of this module, of any shape.
        sigma: standard deviation of each pixel's value; None: not known, and nothing is refused for it.
        confidence: 0…1 of each pixel; None: not known, and nothing is refused for it.
        max_sigma: largest standard deviation of a solved pixel, in the unit of `sigma`; None: any.
        least_confidence: least confidence of a solved pixel.
    """
    unsure = np.zeros(status.shape, dtype=bool)
    if sigma is not None and max_sigma is not None:
        unsure |= ~(sigma.astype(np.float32) <= max_sigma)
    if confidence is not None:
        unsure |= ~(confidence.astype(np.float32) >= least_confidence)
    status[unsure & np.isin(status, SOLVED)] = Status.UNSURE
