"""What the directions of a table are if its vectors are those of something else, as programs and people write them at times.

The spot of a lamp on a mirror ball lies where the normal of the ball is half way between the lamp and the viewer: these normals, taken for
directions, are all too near to the viewer. The angle of a lamp above the table, taken for that from the axis of the camera, exchanges high
lamps and low ones.
"""

import numpy as np

LEAST_ACROSS = 1e-9


def from_ball_normals(vectors: np.ndarray) -> np.ndarray:
    """Return the directions of lights, [lights, 3] unit, whose spots on a mirror ball lie at these normals: 2 (n·v) n - v, v along z."""
    return np.asarray(2 * vectors[:, 2:] * vectors - np.array([0.0, 0.0, 1.0]))


def from_other_elevations(vectors: np.ndarray) -> np.ndarray:
    """Return the directions of lights, [lights, 3] unit, whose elevation is the angle of these vectors from the z axis, and conversely."""
    across = np.hypot(vectors[:, 0], vectors[:, 1])
    turned = vectors[:, :2] * (vectors[:, 2:] / np.maximum(across[:, None], LEAST_ACROSS))
    return np.column_stack([turned, across])
