"""The picture that a lamp should give, predicted from the pictures of the lamps around it.

Per pixel, the light of a distant lamp is linear in the unit vector towards it where a matte surface faces it; near the borders of shadows
it is so over small angles only. So the prediction at a direction is a fit, linear in the vector, to the pictures of the lamps, weighted by
their distance on the sphere (local linear regression, Cleveland 1979). It is linear in the pictures, and the weights follow from directions
alone.
"""

import numpy as np

LEAST_LAMPS = 8
"""The fewest lamps from which a picture is predicted."""
WIDTH_SPACINGS = 1.2
"""The standard deviation of the weights over the distance to the fourth nearest lamp."""
NEIGHBOUR = 4
MOST_CONDITION = 1e6
MOST_GAIN = 2.0
"""The largest sum of the sizes of weights: beyond it the direction lies outside of those of the lamps, an extrapolation."""
FAR_DEGREES = 45.0
"""The largest angle to the fourth nearest lamp at which the lamps on one side say roughly what a picture should be."""


def prediction_weights(wanted: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Return the weight of the picture of each lamp in the prediction at a direction.

    Args:
        wanted: [3] unit vector.
        directions: [lamps, 3] unit vectors of the lamps whose pictures there are.

    Returns:
        [lamps] float64, or None where there are too few, or all lie on one side of the direction.
    """
    if len(directions) < LEAST_LAMPS:
        return None
    angle = np.arccos(np.clip(directions @ wanted, -1, 1))
    width = WIDTH_SPACINGS * np.sort(angle)[NEIGHBOUR - 1]
    weight = np.exp(-0.5 * (angle / max(width, 1e-3)) ** 2)
    basis = directions @ np.column_stack([wanted, _tangents(wanted)])
    normal = basis.T @ (weight[:, None] * basis)
    if np.linalg.cond(normal) > MOST_CONDITION:
        return None
    found: np.ndarray = np.linalg.solve(normal, (weight[:, None] * basis).T)[0]
    return found if np.abs(found).sum() <= MOST_GAIN else None


def _tangents(direction: np.ndarray) -> np.ndarray:
    """Return two unit vectors across a direction, [3, 2]."""
    other = np.eye(3)[np.abs(direction).argmin()]
    first = np.cross(direction, other)
    first /= np.linalg.norm(first)
    return np.column_stack([first, np.cross(direction, first)])


def rough_weights(wanted: np.ndarray, directions: np.ndarray) -> np.ndarray | None:
    """Return weights as `prediction_weights` does, of a weighted mean, which also stands for lamps on one side; None where all are far."""
    if len(directions) < NEIGHBOUR:
        return None
    angle = np.arccos(np.clip(directions @ wanted, -1, 1))
    spacing = np.sort(angle)[NEIGHBOUR - 1]
    if spacing > np.radians(FAR_DEGREES):
        return None
    weight = np.exp(-0.5 * (angle / max(spacing, 1e-3)) ** 2)
    found: np.ndarray = weight / weight.sum()
    return found
