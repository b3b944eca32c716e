"""A bumpy dome under lamps close to it, rendered in float64 from heights in closed form, and written as a capture.

The dome is a cap of the unit sphere, times `radius`, with ripples. Nothing here leans on the code that it judges.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tests.reference.sampling import lattice
from tests.scenes.captures import distant, write_lit

CAP = 0.8
"""Radius of the visible cap in sphere radii."""
RIPPLE, WAVES = 0.02, 9.0
"""Height and angular frequency of the ripples, in sphere radii: slopes of up to 10 degrees more."""


class Lamp(NamedTuple):
    """A point light, or a distant one when it has a direction."""

    position: np.ndarray | None  # [3] metres
    strength: np.ndarray  # [3] intensity, or irradiance
    axis: np.ndarray | None = None
    exponent: float = 0.0
    direction: np.ndarray | None = None

    def manifest(self) -> dict[str, Any]:
        if self.direction is not None:
            return distant(self.direction, self.strength)
        given = {"type": "point", "position_m": self.position.tolist(), "intensity": self.strength.tolist()}
        return given if self.axis is None else {**given, "axis": self.axis.tolist(), "anisotropy": self.exponent}


class Dome(NamedTuple):
    """What a camera sees of it, at pixel centres."""

    camera: dict[str, Any]
    points: np.ndarray  # [rows, cols, 3] float64, metres
    normal: np.ndarray  # [rows, cols, 3]
    albedo: np.ndarray  # [rows, cols, 3]
    mask: np.ndarray  # [rows, cols]
    centre: np.ndarray  # [3] of the sphere
    radius: float

    @property
    def relief(self) -> float:
        return float(np.ptp(self.points[..., 2][self.mask]))


def surface(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Height of the unit dome above the sphere's centre, and its slopes along x and y."""
    ball = np.sqrt(np.maximum(1 - x**2 - y**2, 0.05))
    sx, cx, sy, cy = np.sin(WAVES * x), np.cos(WAVES * x), np.sin(WAVES * y), np.cos(WAVES * y)
    return ball + RIPPLE * sx * cy, -x / ball + RIPPLE * WAVES * cx * cy, -y / ball - RIPPLE * WAVES * sx * sy


def dome(size: int = 48, *, perspective: bool = False, radius: float = 0.1) -> Dome:
    """The dome, seen from +z; perspective: from six radii away, so that rays lean by up to 8 degrees."""
    u = (np.arange(size) + 0.5 - size / 2) / (size / 2) * CAP * 1.03
    x, y = np.meshgrid(u, -u)
    camera: dict[str, Any] = {"projection": "perspective" if perspective else "orthographic", "resolution": [size, size]}
    centre = np.array([0, 0, 0.25 * radius])
    if perspective:
        away = 6.0  # radii from the camera to the sphere's centre
        right, up = x / away, y / away  # slopes of the rays
        near, beyond = np.full_like(x, away - 1.1), np.full_like(x, away)
        for _ in range(60):  # where a ray meets the surface, by bisection: it leans less than the surface is steep
            depth = (near + beyond) / 2
            above = away - depth > surface(right * depth, up * depth)[0]
            near, beyond = np.where(above, depth, near), np.where(above, beyond, depth)
        x, y = right * depth, up * depth
        assert np.abs(away - depth - surface(x, y)[0])[x**2 + y**2 < CAP**2].max() < 1e-12
        centre = np.array([0, 0, -away * radius])
    z, zx, zy = surface(x, y)
    mask = x**2 + y**2 < CAP**2
    points = radius * np.stack([x, y, z], axis=-1) + centre
    normal = np.stack([-zx, -zy, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * y, np.full_like(x, 0.4)], axis=-1)
    camera["surface_z_m"] = float(points[..., 2][mask].mean())
    if perspective:
        camera["focal_px"] = [1 / (right[0, 1] - right[0, 0])] * 2
    else:
        camera["pixel_size_m"] = float(radius * (u[1] - u[0]))
    return Dome(camera, points, normal, albedo, mask, centre, radius)


def lamps(scene: Dome, count: int, radii: float, *, widest: float = 75.0, exponent: float = 0.0) -> list[Lamp]:
    """Lamps on a cap of a sphere about the dome's, of different colours; with an exponent they look beside the centre."""
    index = np.arange(count) + 0.5
    strength = (1 + 0.1 * np.arange(3 * count).reshape(count, 3) % 0.7) * (radii * scene.radius) ** 2
    positions = scene.centre + radii * scene.radius * lattice(count, widest)
    looked_at = 0.4 * scene.radius * np.stack([np.sin(5 * index), np.cos(3 * index), np.ones(count)], axis=-1) + scene.centre
    aim = looked_at - positions
    aim /= np.linalg.norm(aim, axis=1, keepdims=True)
    return [Lamp(p, s, a if exponent else None, exponent) for p, s, a in zip(positions, strength, aim, strict=True)]


def far(lamp: Lamp, scene: Dome) -> Lamp:
    """The lamp as a distant light that gives the sphere's centre the same."""
    way = lamp.position - scene.centre
    return Lamp(None, lamp.strength / (way @ way), direction=way / np.linalg.norm(way))


def render(scene: Dome, lamp: Lamp, *, cast_steps: int = 0) -> np.ndarray:
    """[rows, cols, 3] radiance ρ/π E max(0, n·l), E = I cos^μ / d²; cast_steps: march towards the lamp for cast shadow."""
    if lamp.direction is not None:
        way, falloff = np.broadcast_to(lamp.direction, scene.points.shape), np.ones(scene.mask.shape)
        length = np.full(scene.mask.shape, 3 * scene.radius)
    else:
        way = lamp.position - scene.points
        length = np.linalg.norm(way, axis=-1)
        way = way / length[..., None]
        falloff = 1 / length**2
        if lamp.axis is not None:
            falloff = falloff * np.maximum(-(way @ lamp.axis), 0) ** lamp.exponent
    cosine = np.maximum((scene.normal * way).sum(axis=-1), 0)
    for step in (np.arange(cast_steps) + 0.5) / max(cast_steps, 1):
        at = (scene.points + way * (step * length)[..., None] - scene.centre) / scene.radius
        over = (at[..., 0] ** 2 + at[..., 1] ** 2 < CAP**2) & (surface(at[..., 0], at[..., 1])[0] > at[..., 2] + 1e-9)
        cosine = np.where(over, 0, cosine)
    return scene.albedo / np.pi * lamp.strength * (cosine * falloff)[..., None]


def write(folder: Path, scene: Dome, lights: list[Lamp], *, told: list[Lamp] | None = None, cast_steps: int = 0) -> Path:
    """A capture of the dome under these lamps; told: what the manifest says of them, if not the truth."""
    images = (render(scene, lamp, cast_steps=cast_steps) * scene.mask[..., None] for lamp in lights)
    return write_lit(folder, images, [said.manifest() for said in told or lights], camera=scene.camera, mask=scene.mask, name="dome")
