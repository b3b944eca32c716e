"""Objects of several parts in front of one another, ray cast in float64: ellipsoids and discs with Relit's BRDF."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from tests.reference.microfacet import diffuse, specular
from tests.scenes.captures import Scene, write_capture

FAR = 1e30
LIFT = 1e-9
"""How far along its normal a shadow ray starts, in units of the scene."""


class Part(NamedTuple):
    """An ellipsoid, or the disc in which it ends where a radius is 0: a disc of radius `radii[0]` and normal `normal`."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    normal: tuple[float, float, float] | None = None  # of a disc; None: an ellipsoid
    albedo: tuple[float, float, float] = (0.6, 0.5, 0.4)
    f0: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roughness: float = 0.5
    hole: float = 0.0  # radius of the hole of a disc

    def hit(self, origin: np.ndarray, way: np.ndarray) -> np.ndarray:
        """Distance along each ray [n, 3] + t [n, 3] or [3], FAR where it misses."""
        way = np.broadcast_to(way, origin.shape)
        towards = np.asarray(self.centre) - origin
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.normal is not None:
                across = way @ np.asarray(self.normal)
                t = (towards @ np.asarray(self.normal)) / across
                from_centre = ((origin + t[:, None] * way - self.centre) ** 2).sum(1)
                good = (np.abs(across) > 1e-12) & (from_centre < self.radii[0] ** 2) & (from_centre > self.hole**2)
            else:
                o, d = -towards / np.asarray(self.radii), way / np.asarray(self.radii)
                a, b, c = (d * d).sum(1), (o * d).sum(1), (o * o).sum(1) - 1
                root = np.sqrt(np.maximum(b * b - a * c, 0))
                near = (-b - root) / a
                t = np.where(near > 1e-9, near, (-b + root) / a)
                good = b * b > a * c
        return np.where(good & (t > 1e-9), t, FAR)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Unit outward normals [n, 3]."""
        if self.normal is not None:
            return np.broadcast_to(np.asarray(self.normal), points.shape)
        n = (points - self.centre) / np.asarray(self.radii) ** 2
        return n / np.linalg.norm(n, axis=1, keepdims=True)


class Shot(NamedTuple):
    """A ray-cast object."""

    scene: Scene
    z: np.ndarray  # [rows, cols] float64 camera-frame z; 0 outside
    part: np.ndarray  # [rows, cols] int, the number of the part; -1 outside
    camera: dict[str, Any]


def sphere_lights(count: int, *, least_z: float = -1.0) -> np.ndarray:
    """[count, 3] directions on a Fibonacci lattice above least_z."""
    z = 1 - (np.arange(count) + 0.5) / count * (1 - least_z)
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


def shoot(parts: list[Part], directions: np.ndarray, *, side: int, across: float, distance: float | None = None, inside: float = FAR,
          noise: float = 0.0, seed: int = 0) -> Shot:
    """Ray cast an object.

    Args:
        parts: of the object.
        directions: [lights, 3] to distant lights of irradiance π.
        side: pixels along each side of the image.
        across: what the image spans at z = 0.
        distance: of a perspective camera from z = 0; None: orthographic.
        inside: radius about the axis beyond which the mask ends.
        noise: relative standard deviation of the readings; a tenth of it, of the brightest percent, is added.
        seed: of the noise.
    """
    pixel = across / side
    u = (np.arange(side) + 0.5 - side / 2) * pixel
    x, y = (plane.ravel() for plane in np.meshgrid(u, -u))
    if distance is None:
        origin, way = np.stack([x, y, np.full_like(x, 100.0)], axis=1), np.tile([0.0, 0.0, -1.0], (x.size, 1))
        camera: dict[str, Any] = {"projection": "orthographic", "resolution": [side, side], "pixel_size_m": pixel}
        eye = 100.0
    else:
        origin, way = np.zeros((x.size, 3)), np.stack([x / distance, y / distance, -np.ones_like(x)], axis=1)
        parts = [part._replace(centre=(part.centre[0], part.centre[1], part.centre[2] - distance)) for part in parts]
        camera = {"projection": "perspective", "resolution": [side, side], "focal_px": [distance / pixel] * 2,
                  "principal_px": [side / 2, side / 2]}
        eye = 0.0
    t = np.stack([part.hit(origin, way) for part in parts])
    number = np.where((t.min(0) < FAR) & (np.hypot(x, y) < inside), t.argmin(0), -1)
    seen = np.flatnonzero(number >= 0)
    point = origin[seen] + t.min(0)[seen, None] * way[seen]
    normal, view = np.zeros_like(point), -way[seen] / np.linalg.norm(way[seen], axis=1, keepdims=True)
    for index, part in enumerate(parts):
        mine = number[seen] == index
        normal[mine] = part.normals(point[mine])
    normal *= np.sign((normal * view).sum(1))[:, None]
    images = np.zeros((len(directions), x.size, 3))
    material = [np.array([getattr(parts[i], name) for i in number[seen]]) for name in ("albedo", "f0", "roughness")]
    for light, toward in enumerate(directions):
        cosine = normal @ toward
        lit = np.flatnonzero(cosine > 0)
        free = np.min([part.hit(point[lit] + LIFT * normal[lit], toward) for part in parts], axis=0) >= FAR
        lit = lit[free]
        n, to_light, v = normal[lit], np.broadcast_to(toward, (lit.size, 3)), view[lit]
        value = material[0][lit] * diffuse(n, to_light, v)[:, None]
        for c in range(3):
            value[:, c] += specular(n, to_light, v, material[2][lit] ** 2, material[1][lit, c])
        images[light, seen[lit]] = np.pi * value
    if noise:
        rng = np.random.default_rng(seed)
        floor = 0.1 * noise * np.percentile(images[:, seen], 99)
        images = np.maximum(images + rng.normal(size=images.shape) * (noise * images + floor), 0)
    shape = (side, side)
    mask = (number >= 0).reshape(shape)
    full = np.zeros((x.size, 3))
    full[seen] = normal
    z = np.zeros(x.size)
    z[seen] = point[:, 2]
    camera["surface_z_m"] = float(z[seen].mean()) if eye == 0.0 else 0.0
    if eye:
        z[seen] -= z[seen].mean()
    albedo = np.zeros((x.size, 3))
    albedo[seen] = material[0]
    scene = Scene(full.reshape(*shape, 3), albedo.reshape(*shape, 3), mask, directions, np.full((len(directions), 3), np.pi),
                  images.reshape(-1, *shape, 3))
    return Shot(scene, z.reshape(shape), number.reshape(shape), camera)


def write_shot(folder: Path, shot: Shot) -> Path:
    """Write it as a capture."""
    return write_capture(folder, shot.scene, camera=shot.camera, name="parts")


def ball_before_body(*, gap: float = 0.3) -> list[Part]:
    """A small glossy ball `gap` in front of a broad body."""
    return [Part((0.1, 0.15, 0.5 + gap), (0.3, 0.3, 0.3), f0=(0.04,) * 3, roughness=0.35),
            Part((0.0, 0.0, -0.1), (1.0, 0.9, 0.5), albedo=(0.4, 0.45, 0.5))]


KINDS = ("ball", "egg", "disc", "hole", "touch", "rod", "two")


class Layout(NamedTuple):
    """A random object of parts, and what it is seen by."""

    parts: list[Part]  # the body last
    lights: np.ndarray  # [lights, 3]
    distance: float | None

    def shoot(self, *, side: int, seed: int = 0) -> Shot:
        """Ray cast it with 2 % noise."""
        return shoot(self.parts, self.lights, side=side, across=2.4, distance=self.distance, noise=0.02, seed=seed)


def random_layout(kind: str, seed: int) -> Layout:
    """A part or two before a body at a random place: a ball of radius .3 under 128 lights, an egg, a disc, a disc with a hole, a ball that
    touches, a rod or two eggs, under 33 to 128 lights."""
    rng = np.random.default_rng(1000 * seed + sum(map(ord, kind)))
    body = Part((0, 0, -0.3), tuple(rng.uniform([0.9, 0.85, 0.4], [1.05, 1.05, 0.7])), albedo=tuple(rng.uniform(0.3, 0.6, 3)))
    shine: dict[str, Any] = {"f0": (0.04,) * 3, "roughness": float(rng.uniform(0.25, 0.6))} if rng.random() < 0.5 else {}
    (x, y), gap = rng.uniform(-0.4, 0.4, 2), rng.uniform(0.1, 0.8) + 0.2
    normal = np.array([*rng.uniform(-0.7, 0.7, 2), 1])
    disc: dict[str, Any] = shine | {"normal": tuple(normal / np.linalg.norm(normal))}
    front = {"ball": lambda: [Part((x, y, 0.3 + gap), (0.3,) * 3, **shine)],
             "egg": lambda: [Part((x, y, 0.35 + gap), tuple(rng.uniform(0.15, 0.4, 3)), **shine)],
             "disc": lambda: [Part((x, y, 0.3 + gap), (rng.uniform(0.2, 0.45),) * 3, **disc)],
             "hole": lambda: [Part((0.6 * x, 0.6 * y, 0.3 + gap), (0.45,) * 3, hole=rng.uniform(0.18, 0.3), **disc)],
             "touch": lambda: [Part((x, y, 0.15 + rng.uniform(0, 0.15)), (0.3,) * 3, **shine)],
             "rod": lambda: [Part((x, y, 0.2 + gap), (0.55, *(rng.uniform(0.06, 0.12),) * 2), **shine)],
             "two": lambda: [Part((x - 0.4, y, 0.3 + gap), (0.24,) * 3, **shine),
                             Part((x + 0.4, -y, 0.4 + rng.uniform(0.1, 0.8)), (0.28, 0.2, 0.2))]}[kind]()
    count = 128 if kind == "ball" else int(rng.choice([33, 48, 96, 128]))
    distance, least = None if rng.random() < 0.7 else 4.0, float(rng.choice([-1, 0.1]))
    lights = sphere_lights(count, least_z=least)
    turned = Rotation.random(random_state=seed).as_matrix() if least < 0 else np.eye(3)
    return Layout([*front, body], lights @ turned.T, distance)


def disc_over_plane(*, slope: float = 0.58, gap: float = 0.5) -> list[Part]:
    """A disc that is tilted about x over a plane that is not."""
    n = np.array([0.0, slope, 1.0]) / np.hypot(1.0, slope)
    return [Part((0.0, 0.0, gap), (0.45,) * 3, normal=tuple(n)),
            Part((0.0, 0.0, 0.0), (1e9,) * 3, normal=(0.0, 0.0, 1.0), albedo=(0.5,) * 3)]
