"""A matt ball that lies on matt ground, which lights it from below: each pixel by a sum over directions, in float64.

The ground's light on the ball is traced; what the ball throws back on the ground is left out of both. Nothing here leans on the code that
it judges.
"""

from typing import NamedTuple

import numpy as np

from tests.reference.sampling import lattice

RADIUS = 0.55
"""Radius of the ball, where the image is 2 wide: a ring of ground is around it."""
ALBEDO = 0.6
WAYS = lattice(4000)
"""[directions, 3] spread evenly over the sphere."""


class Grounded(NamedTuple):
    """What an orthographic camera sees along -z."""

    normal: np.ndarray  # [rows, cols, 3] of the ball
    mask: np.ndarray  # [rows, cols] bool, the ball
    images: np.ndarray  # [lights, rows, cols] radiance under lights of irradiance 1


def ball_on_ground(size: int, lights: np.ndarray, *, ground: float, tilt_degrees: float = 0.0) -> Grounded:
    """Render the ball under distant lights [n, 3]. `ground`: its albedo; it touches the ball where the ball lies on it, and its normal is
    turned from the camera's direction towards +y by `tilt_degrees`."""
    u = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(u, -u)
    inside = x**2 + y**2 < RADIUS**2
    z = np.sqrt(np.maximum(RADIUS**2 - x**2 - y**2, 0))
    normal = np.stack([x, y, z], axis=-1) / RADIUS
    up = np.array([0.0, np.sin(np.radians(tilt_degrees)), np.cos(np.radians(tilt_degrees))])
    floor = np.stack([x, y, (-RADIUS - up[0] * x - up[1] * y) / up[2]], axis=-1)
    images = np.where(inside, 0.0, _lit(floor, up, lights, ground))
    for at in np.argwhere(inside):
        images[:, *at] = _of_ball(normal[*at], up, lights, ground)
    return Grounded(normal, inside, images)


def _lit(points: np.ndarray, up: np.ndarray, lights: np.ndarray, albedo: float) -> np.ndarray:
    """Return the radiance of points [..., 3] of the ground, [lights, ...]: the ball's shadow lies on it."""
    along = np.einsum("...k,lk->l...", points, lights)
    shadowed = (along < 0) & ((points**2).sum(axis=-1) - along**2 < RADIUS**2)
    return albedo / np.pi * np.where(shadowed, 0, np.maximum(lights @ up, 0)[(slice(None), *[None] * (points.ndim - 1))])


def _of_ball(normal: np.ndarray, up: np.ndarray, lights: np.ndarray, ground: float) -> np.ndarray:
    """Return the radiance of a point of the ball, [lights]."""
    facing = WAYS @ normal
    down = WAYS @ up
    ways = (facing > 0) & (down < 0)
    hit = RADIUS * normal + WAYS[ways] * ((-RADIUS - RADIUS * normal @ up) / down[ways])[:, None]
    from_ground = (facing[ways] * _lit(hit, up, lights, ground)).sum(axis=1) * 4 * np.pi / len(WAYS)
    return ALBEDO / np.pi * (np.maximum(lights @ normal, 0) + from_ground)
