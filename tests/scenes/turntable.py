"""Range scans of a simulated figure of one metre on a turntable: ray marching of a signed distance function, with known poses and noise."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.transforms import rotation_about_y
from tests.scenes.statue import Shot, ball, box, capsule, shoot

MM = 1e-3
DISTANCE_M = 2.0
STEPS = 120
HIT_M = 2e-6
"""Distance from the surface at which a ray has arrived: a hundredth of the noise."""

Distance = Callable[[np.ndarray], np.ndarray]
"""The signed distance, or less, from each of [n, 3] points to a surface, metres."""


class View(NamedTuple):
    """What a camera measures, and the truth."""

    camera: Camera
    depth: np.ndarray  # [rows, cols] float32 metres, with noise
    mask: np.ndarray  # [rows, cols] bool
    sigma: np.ndarray  # [rows, cols] float32 metres, true
    world_from_scan: np.ndarray  # [4, 4]
    true_depth: np.ndarray  # [rows, cols] without noise


def joined(parts: list[np.ndarray], soft: float) -> np.ndarray:
    """The union of bodies with a rounded seam. Source: Quilez, "Smooth minimum"."""
    out = parts[0]
    for part in parts[1:]:
        h = np.maximum(soft - np.abs(out - part), 0) / soft
        out = np.minimum(out, part) - h * h * soft / 4
    return out


def figure(p: np.ndarray) -> np.ndarray:
    """A standing figure with a plinth, folds in its dress and a staff; 1 m tall, nothing of it symmetric. y is up, 0 the middle."""
    x, y, z = p.T
    trunk = capsule(p, (0.0, -0.28, 0.0), (0.02, 0.18, 0.02), 0.105)
    skirt = capsule(p, (0.01, -0.36, 0.01), (0.0, -0.2, 0.0), 0.15)
    parts = [trunk, skirt, capsule(p, (0.02, 0.2, 0.02), (0.03, 0.3, 0.04), 0.045), ball(p, (0.035, 0.38, 0.05), 0.085),
             capsule(p, (0.11, 0.19, 0.0), (0.19, 0.02, 0.1), 0.04), capsule(p, (0.19, 0.02, 0.1), (0.16, 0.1, 0.23), 0.032),
             capsule(p, (-0.09, 0.18, 0.0), (-0.19, 0.05, -0.07), 0.043), capsule(p, (-0.19, 0.05, -0.07), (-0.2, -0.14, 0.03), 0.033),
             ball(p, (0.06, 0.41, -0.04), 0.05), capsule(p, (-0.05, -0.1, -0.11), (0.06, 0.12, -0.13), 0.04)]
    body = joined(parts, 0.05)
    folds = 0.006 * np.sin(38 * x + 9 * y) * np.sin(31 * z - 14 * y) + 0.004 * np.sin(70 * y + 25 * x - 12 * z)
    plinth = box(p, (0.0, -0.455, 0.0), (0.19, 0.03, 0.15), 0.012)
    staff = capsule(p, (-0.2, -0.44, 0.06), (-0.2, 0.3, 0.03), 0.016)
    return np.minimum(np.minimum(0.75 * (body + folds), plinth), staff)


def vase(p: np.ndarray) -> np.ndarray:
    """A body of revolution about y, 1 m tall."""
    r, y = np.hypot(p[:, 0], p[:, 2]), p[:, 1]
    profile = 0.16 + 0.07 * np.sin(5 * y + 0.6) + 0.02 * np.sin(13 * y)
    side = 0.7 * (r - profile)
    return np.maximum(side, np.abs(y) - 0.5)


def urn(p: np.ndarray) -> np.ndarray:
    """A vase on a square foot, with an arm."""
    foot = box(p, (0, -0.53, 0), (0.2, 0.03, 0.2), 0.005)
    return np.minimum(np.minimum(vase(p), foot), 0.8 * capsule(p, (0.2, 0.2, 0), (0.36, 0.05, 0.0), 0.03))


def pillar(p: np.ndarray) -> np.ndarray:
    """A square pillar: a quarter turn leaves it as it is."""
    return box(p, (0.0, 0.0, 0.0), (0.17, 0.46, 0.17), 0.02)


def camera_of(rows: int) -> Camera:
    """A camera of 3:4 format that sees a metre and a little at `DISTANCE_M`."""
    return Camera(projection="perspective", resolution=(rows * 3 // 4, rows), focal_px=(rows * DISTANCE_M / 1.25, rows * DISTANCE_M / 1.25))


def pose(angle_deg: float, *, raise_m: float = 0.25) -> np.ndarray:
    """world_from_scan of a camera before the middle of the world that looks at it; the object had turned by the angle about +y."""
    tilt = np.arctan2(raise_m, DISTANCE_M)
    c, s = np.cos(tilt), np.sin(tilt)
    world = np.eye(4)
    world[:3, :3] = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
    world[:3, 3] = DISTANCE_M * world[:3, 2]
    turned = np.eye(4)
    turned[:3, :3] = rotation_about_y(-angle_deg)
    return turned @ world


def see(surface: Distance, world_from_scan: np.ndarray, *, rows: int, sigma: float, seed: int) -> View:
    """A range image with independent noise of the z-depth."""
    shot = _true(surface, tuple(map(tuple, world_from_scan)), rows)
    noisy = shot.true + sigma * np.random.default_rng(seed).standard_normal(shot.side)
    return View(camera_of(rows), np.where(shot.mask, noisy, 0).astype(np.float32), shot.mask, np.full(shot.side, sigma, dtype=np.float32),
                world_from_scan, shot.true)


@cache
def _true(surface: Distance, pose_rows: tuple, rows: int) -> Shot:
    camera = camera_of(rows)
    return shoot(np.array(pose_rows), (camera.height, camera.width), camera.focal_px[0], scene=surface, sigma=0.0,
                 near=DISTANCE_M - 0.75, far=DISTANCE_M + 0.75, hit_m=HIT_M, steps=STEPS)


def turntable(surface: Distance, angles: list[float], *, rows: int = 160, sigma: float = 0.25 * MM, seed: int = 1,
              raise_m: float = 0.25) -> list[View]:
    """Scans of an object that a table turned about +y of the world, by these angles in degrees."""
    return [see(surface, pose(angle, raise_m=raise_m), rows=rows, sigma=sigma, seed=1000 * seed + k) for k, angle in enumerate(angles)]
