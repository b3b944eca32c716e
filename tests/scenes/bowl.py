"""A white bowl with all bounces of light in closed form: the inside of a sphere, seen along its axis.

Between any two places inside a sphere the form factor is the same, so that a cap sends every place the same bounced light: with albedo ρ,
the part a of the sphere that the cap covers and the mean direct irradiance Ē on it, ρ a Ē / (1 - ρ a). Nothing here leans on the code that
it judges.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.reference.sampling import lattice
from tests.scenes.captures import write_lit

ALBEDO = np.array([0.8, 0.64, 0.48])
HALF_DEGREES = 70.0
"""Half of the angle under which the sphere's centre sees the bowl; its rim is steep."""
RIM = np.sin(np.radians(HALF_DEGREES))
"""Radius of the rim in sphere radii."""
PART = (1 - np.cos(np.radians(HALF_DEGREES))) / 2
"""The part of the sphere that the bowl covers."""


class Bowl(NamedTuple):
    """What an orthographic camera sees of a bowl of radius 1 m about the origin."""

    points: np.ndarray  # [rows, cols, 3] float64, metres; they are the outward side of the sphere: the normals are their opposites
    mask: np.ndarray  # [rows, cols] bool
    camera: dict[str, Any]

    @property
    def normal(self) -> np.ndarray:
        return -self.points


def bowl(size: int) -> Bowl:
    u = (np.arange(size) + 0.5 - size / 2) / (size / 2) * RIM * 1.03
    x, y = np.meshgrid(u, -u)
    mask = x**2 + y**2 < RIM**2
    points = np.stack([x, y, -np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)
    return Bowl(points, mask, {"projection": "orthographic", "resolution": [size, size], "pixel_size_m": float(u[1] - u[0]),
                               "surface_z_m": float(points[..., 2][mask].mean())})


WALL = lattice(4000, HALF_DEGREES) * [1, 1, -1]
"""[places, 3] spread evenly over the bowl, for means."""


def cosine(points: np.ndarray, way: np.ndarray, length: np.ndarray | float) -> np.ndarray:
    """n·l of each point, 0 where the bowl's other side stands before the light; points [..., 3], way unit."""
    facing = -(points * way).sum(axis=-1)
    opposite = points + 2 * facing[..., None] * way  # where the line meets the sphere again
    hidden = (2 * facing < length) & (-opposite[..., 2] > np.cos(np.radians(HALF_DEGREES)))
    return np.where(hidden, 0, np.maximum(facing, 0))


def with_bounces(direct: np.ndarray, mean: float) -> np.ndarray:
    """[..., 3] radiance from the direct irradiance [...] and its mean over the bowl."""
    return ALBEDO / np.pi * (direct[..., None] + PART * ALBEDO * mean / (1 - PART * ALBEDO))


def under_lamp(points: np.ndarray, lamp: np.ndarray, intensity: float) -> np.ndarray:
    """[...] direct irradiance of a point light."""
    way = lamp - points
    length = np.linalg.norm(way, axis=-1)
    return intensity * cosine(points, way / length[..., None], length) / length**2


def write_near(folder: Path, scene: Bowl, count: int, radii: float, *, bounced: bool = True) -> Path:
    """A capture under point lights on a cap around the bowl's centre, with all bounces of light or none."""
    images, lights = [], []
    for lamp in radii * lattice(count, 75.0):
        arriving = under_lamp(WALL, lamp, radii**2).mean() if bounced else 0.0
        images.append(with_bounces(under_lamp(scene.points, lamp, radii**2), arriving) * scene.mask[..., None])
        lights.append({"type": "point", "position_m": lamp.tolist(), "intensity": [radii**2] * 3})
    return write_lit(folder, images, lights, camera=scene.camera, mask=scene.mask, name="bowl")
