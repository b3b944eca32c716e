"""Parts that stand in front of each other, with a closed form, and range images and photometric normals of them.

Every scene is a relief some 30 cm wide that looks along +z, seen from a fan of places before it. Its surfaces are waved, so that a plane is
the right answer nowhere.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.scenes.statue import Shot, box, capsule, place, shoot

WAVE, DEEP = 90.0, 6e-4
"""Radians per metre and metres of the waves on all surfaces: slopes of up to 3°."""
LIPSCHITZ = 0.9
"""What distances to waved surfaces are multiplied by, so that they are never too large for sphere tracing."""

Field = Callable[[np.ndarray], np.ndarray]


def _waved(distance: np.ndarray, p: np.ndarray) -> np.ndarray:
    return distance - DEEP * np.sin(WAVE * p[..., 0]) * np.cos(WAVE * p[..., 1] + 1)


def _wall(p: np.ndarray) -> np.ndarray:
    return box(p, (0, 0, -0.02), (0.16, 0.16, 0.02))


def plates(p: np.ndarray) -> np.ndarray:
    """A plate of 10 mm that stands 6 mm before a larger one."""
    return _waved(np.minimum(_wall(p), box(p, (0.01, 0, 0.011), (0.07, 0.07, 0.005))), p)


def disc(p: np.ndarray) -> np.ndarray:
    """A disc of 4 mm, 14° tilted, 40 mm before a wall."""
    tilt = Rotation.from_rotvec(np.radians([9.0, 11.0, 0.0])).as_matrix()
    q = (p - [0, 0, 0.04]) @ tilt
    over = np.stack([np.hypot(q[..., 0], q[..., 1]) - 0.07, np.abs(q[..., 2]) - 2e-3], axis=-1)
    flat = np.linalg.norm(np.maximum(over, 0), axis=-1) + np.minimum(over.max(axis=-1), 0)
    return _waved(np.minimum(_wall(p), flat), p)


def step(p: np.ndarray) -> np.ndarray:
    """A step of 15 mm across a wall, at no angle to the lattice that would be special."""
    turn = Rotation.from_rotvec(np.radians([0.0, 0.0, 17.0])).as_matrix()
    block = np.maximum(box(p @ turn, (0.3, 0, 0), (0.3, 0.3, 0.015)), box(p, (0, 0, 0), (0.16, 0.16, 0.02)))
    return _waved(np.minimum(_wall(p), block), p)


def rod(p: np.ndarray) -> np.ndarray:
    """A rod of 12 mm, 20 mm before a wall."""
    return _waved(np.minimum(_wall(p), capsule(p, (-0.08, -0.12, 0.026), (0.09, 0.12, 0.03), 0.006)), p)


CHAIR = [((-0.05, -0.06, 0.02), (0.005, 0.05, 0.005)), ((0.05, -0.06, 0.02), (0.005, 0.05, 0.005)),
         ((-0.05, -0.06, -0.02), (0.005, 0.05, 0.005)), ((0.05, -0.06, -0.02), (0.005, 0.05, 0.005)),
         ((0.0, -0.01, 0.0), (0.06, 0.004, 0.03)), ((-0.05, 0.05, -0.025), (0.005, 0.06, 0.005)),
         ((0.05, 0.05, -0.025), (0.005, 0.06, 0.005)), ((0.0, 0.05, -0.025), (0.05, 0.005, 0.004)),
         ((0.0, 0.09, -0.025), (0.05, 0.006, 0.004))]
"""Middles and half sides of the bars of the chair, metres."""


def chair(p: np.ndarray) -> np.ndarray:
    """A chair of bars of 8 to 12 mm with a seat, turned, before a wall that is bent with a radius of 290 mm."""
    bent = np.maximum(0.29 - np.hypot(p[..., 0], p[..., 2] - 0.27), np.maximum(np.abs(p[..., 0]) - 0.16, np.abs(p[..., 1]) - 0.15))
    bent = np.maximum(bent, np.maximum(p[..., 2] - 0.12, -0.06 - p[..., 2]))
    q = (p - [0, 0, 0.07]) @ Rotation.from_rotvec(np.radians([14.0, -23.0, 6.0])).as_matrix()
    return _waved(np.min([bent, *(box(q, centre, half) for centre, half in CHAIR)], axis=0), p)


SCENES: dict[str, Field] = {"plates": plates, "disc": disc, "step": step, "rod": rod, "chair": chair}


def gradient(scene: Field, points: np.ndarray) -> np.ndarray:
    """The gradient [..., 3] of a scene at points, by central differences."""
    step = 1e-6
    return np.stack([scene(points + step * axis) - scene(points - step * axis) for axis in np.eye(3)], axis=-1) / (2 * step)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def fan(scene: Field, *, count: int = 7, side: tuple[int, int] = (128, 128), sigma: float, range_m: float = 0.8, wide: float = 0.36,
        seed: int = 0) -> list[Shot]:
    """Range images from places that look at the scene from up to 50° aside."""
    angles = np.radians(np.linspace(-50, 50, count))
    heights = 0.35 * np.array([(-1) ** k for k in range(count)])
    return [shoot(place(angle, height, range_m), side, side[0] * range_m / wide, sigma=sigma, seed=seed + k,
                  scene=lambda p: LIPSCHITZ * scene(p)) for k, (angle, height) in enumerate(zip(angles, heights, strict=True))]


def photometric(scene: Field, shot: Shot, *, seed: int, noise_degrees: float, drift_degrees: float) -> SurfaceMaps:
    """Normals that are turned by the drift about an axis of their own, and have noise."""
    rng = np.random.default_rng(100 + seed)
    camera = Camera(projection="perspective", resolution=shot.side[::-1], focal_px=(shot.focal, shot.focal))
    points = camera.points(-shot.true)[shot.mask] @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
    own = unit(gradient(scene, points)) @ shot.world_from_camera[:3, :3]
    turned = own @ Rotation.from_rotvec(np.radians(drift_degrees) * unit(rng.standard_normal(3))).as_matrix().T
    normal = np.zeros((*shot.side, 3), dtype=np.float32)
    normal[shot.mask] = unit(turned + np.radians(noise_degrees) * rng.standard_normal(own.shape))
    return SurfaceMaps(camera=camera, mask=shot.mask, normal=normal, sigma=np.full(shot.side, noise_degrees, dtype=np.float32))


def with_dead_pixels(shots: list[Shot], maps: list[SurfaceMaps], part: float, seed: int = 5) -> tuple[list[Shot], list[SurfaceMaps]]:
    """The same without a depth at some pixels, and without a normal at others."""
    rng = np.random.default_rng(seed)
    kept = [shot.mask & (rng.random(shot.mask.shape) >= part) for shot in shots]
    seen = [each.mask & (rng.random(each.mask.shape) >= part) for each in maps]
    return ([shot._replace(depth=np.where(mask, shot.depth, 0), mask=mask) for shot, mask in zip(shots, kept, strict=True)],
            [SurfaceMaps(camera=each.camera, mask=mask, normal=np.where(mask[..., None], each.normal, np.float32(0)), sigma=each.sigma)
             for each, mask in zip(maps, seen, strict=True)])


def face_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The unit normals [F, 3] of triangles; 0 of those without an area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    return area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-300)
