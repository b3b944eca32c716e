"""Tell a surface from its inverse: by whether it is convex towards its outline, and whether cast shadows agree with its height.

Lights that are turned by 180 degrees about the view axis give a surface that fits together as well, with its height inverted: a bump
becomes a hollow. At the outline of an object that stands free, normals point outwards. A hollow, a bowl or a mould, has normals
that point inwards there, but it also casts shadows on itself, which the images show or not.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter

EDGE = 40
"""The band along the outline is about a fortieth of the object's size wide."""
LEAST_EDGE = 20
"""Fewer pixels of the outline decide nothing."""
INSIDE = 0.75
"""The blurred mask is below this in the band."""
FIRST_STEPS, STEPS = 16, 40
"""Steps of one pixel along a ray, and all steps, which grow geometrically to the size of the map."""
LIFT, LIFT_SLOPE = 1.0, 0.05
"""A surface must stand above a ray by this many pixels, and by this part of the distance: less is the error of the height."""


class Outline(NamedTuple):
    """Directions of the normals along the outline of the mask, as far as it lies inside the image."""

    outward: float
    """Mean component of the unit normals along the outward direction, -1…1; 0 without an outline."""
    inward_part: float
    """The part of the outline where it is negative."""
    pixels: int


def outline(normal: np.ndarray, mask: np.ndarray) -> Outline:
    """Compare the normals along the outline of a mask with its outward direction.

    Free-standing objects have an `outward` of 0.8 to 0.98 (cut coins 0.7), bowls of -0.4 to -0.85.
    `normal`: [3, rows, cols] unit, x right, y up; 0 where there is none. `mask`: [rows, cols] bool."""
    width = max(1, round(np.sqrt(np.count_nonzero(mask)) / EDGE))
    if min(mask.shape) <= 6 * width:  # the border is all of the image
        return Outline(0.0, 0.0, 0)
    blurred = uniform_filter(uniform_filter(mask.astype(np.float64), 2 * width + 1, mode="nearest"), 2 * width + 1, mode="nearest")
    down, right = np.gradient(blurred)
    length = np.hypot(down, right)
    edge = mask & (blurred < INSIDE) & (length > 1e-6) & (np.linalg.norm(normal, axis=0) > 0.5)
    border = np.ones_like(mask)
    border[3 * width : -3 * width, 3 * width : -3 * width] = False  # the object may go on outside the image
    edge &= ~border
    if np.count_nonzero(edge) < LEAST_EDGE:
        return Outline(0.0, 0.0, 0)
    outward = ((normal[1] * down - normal[0] * right)[edge]) / length[edge]
    return Outline(float(outward.mean()), float((outward < 0).mean()), int(edge.sum()))


def cast_shadows(height: np.ndarray, mask: np.ndarray, pixels: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return which lights a surface hides from its pixels.

    Args:
        height: [rows, cols] towards the viewer, in pixels.
        mask: [rows, cols] bool: where there is surface.
        pixels: [n] row-major.
        directions: [lights, 3] unit, x right, y up.

    Returns:
        [lights, n] bool; False for lights behind the image plane, which attached shadows hide.
    """
    rows, cols = mask.shape
    row, col = np.divmod(pixels, cols)
    start = height.reshape(-1)[pixels]
    surface = np.where(mask, height, -np.inf)
    framed = np.pad(surface, 1, constant_values=-np.inf).reshape(-1)  # nothing stands outside the map
    most = surface.max() - start.min() - LIFT  # a ray that has risen by more is above all of the surface
    far = float(np.hypot(rows, cols))
    steps = np.unique(np.round(np.concatenate([
        np.arange(2, FIRST_STEPS), np.geomspace(FIRST_STEPS, max(far, FIRST_STEPS + 1.0), STEPS - FIRST_STEPS)])))[:, None]
    hidden = np.zeros((len(directions), len(pixels)), dtype=bool)
    for light, (x, y, z) in enumerate(directions):
        across = np.hypot(x, y)
        if z <= 0 or across < 1e-3:
            continue
        rise = z / across + LIFT_SLOPE
        near = steps[steps[:, 0] * rise <= most]
        at_col = np.clip(np.round(col + near * x / across), -1, cols)
        at_row = np.clip(np.round(row - near * y / across), -1, rows)
        met = framed.take(((at_row + 1) * (cols + 2) + at_col + 1).astype(int))
        hidden[light] = (met > start + near * rise + LIFT).any(axis=0)
    return hidden
