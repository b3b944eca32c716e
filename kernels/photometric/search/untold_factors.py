"""Factors of lights that no object tells: a common one, which is albedo, and, roughly, one that is linear in the direction of the light."""

import numpy as np

from kernels.spread import MAD_TO_SIGMA

FIT_ROUNDS, GROSS = 5, 4.0
"""Rounds in which lights off by more than this many standard deviations are left out of the fit of the part that no object can tell: one
wrong light must not bend all others."""
LARGEST_LINEAR = 4.0
"""Largest part of the factors that is linear across the view, in standard deviations of what independent errors of the lights give."""


def untold(logarithm: np.ndarray, directions: np.ndarray, *, falling: bool) -> np.ndarray:
    """Return the part of the logarithms of the factors that the object cannot tell, or that independent errors of lights do not have.

    A factor that is linear in the direction across the view turns all normals, which shading tells only weakly; it is kept as far as
    errors of the size of the others would give it.

    Args:
        logarithm: [lights] of the factors.
        directions: [lights, 3] unit, in the camera frame.
        falling: whether a part that falls with the angle to the viewer cannot be told at all, because the shape of the diffuse lobe is
            free; else it is kept like those across the view.
    """
    design = np.stack([np.ones(len(directions)), directions[:, 2], directions[:, 0], directions[:, 1]], axis=1)
    found, spread = _robust_fit(design, logarithm)
    centred = design - design.mean(axis=0)
    kept = np.zeros(4)
    for column in range(2 if falling else 1, 4):
        extent = (design if column > 1 else centred)[:, column]
        most = LARGEST_LINEAR * spread / max(float(np.linalg.norm(extent)), 1e-9)
        kept[column] = np.clip(found[column], -most, most)
    return design @ (found - kept)


def _robust_fit(design: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the coefficients of a fit without the lights that are grossly wrong, and the robust standard deviation of the rest."""
    used = np.ones(len(values), dtype=bool)
    for _ in range(FIT_ROUNDS):
        found = np.linalg.lstsq(design[used], values[used], rcond=None)[0]
        residual = values - design @ found
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-9
        used = np.abs(residual) <= GROSS * spread
    return found, spread
