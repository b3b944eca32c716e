"""Which directions light any of many normals: the responses of pixels to all others are 0."""

import numpy as np

ROUNDING = 1e-4
"""A direction whose cosine to every normal is below minus this lights none of their pixels, in float32 neither."""
BOXES = 32
"""Boxes along half a side of the cube that normals lie in: the cosine of a direction to a normal is that to the middle of its box, but for
a thirtieth."""
NORMALS_AT_ONCE = 4096
"""Number of normals that directions are tried on at one time."""


def facing_directions(towards: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the numbers, ascending, of the directions that light any of the normals.

    Args:
        towards: [directions, 3] unit directions.
        normals: [n, 3] unit normals, one or more.
    """
    lights, unsure = np.ones(len(towards), dtype=bool), np.arange(len(towards))
    if len(normals) > len(towards):  # for all directions but a few, the boxes tell that the normals lie in
        boxes = np.zeros((2 * BOXES + 1,) * 3, dtype=bool)
        boxes[tuple((np.rint(normals * BOXES).astype(np.int32) + BOXES).T)] = True
        most = (towards @ (np.argwhere(boxes) / BOXES - 1).T).max(axis=1)
        slack = np.abs(towards).sum(axis=1) / (2 * BOXES) + ROUNDING
        lights, unsure = most > -slack, np.flatnonzero(np.abs(most) <= slack)
    for first in range(0, len(normals), NORMALS_AT_ONCE):
        some = normals[first : first + NORMALS_AT_ONCE]
        unsure = unsure[(towards[unsure] @ some.T).max(axis=1) <= -ROUNDING]
    lights[unsure] = False
    return np.flatnonzero(lights)
