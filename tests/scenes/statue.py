"""A statue-like object of 1 m with a closed form, and range images of it from a turntable.

It has round parts, a foot with sharp edges, a blade of 2 mm, an arm that hides the body behind it, and a slot of 6 mm.
"""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.formats.ply import PointCloud, write_ply
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from tests.reference.projector import look_at

SIGMA = 2.5e-4
"""Standard deviation of every depth, metres."""
BLADE, SLOT = 2e-3, 6e-3
"""Thickness of the blade and width of the slot between two plates, metres."""


def capsule(p: np.ndarray, a: tuple, b: tuple, radius: float) -> np.ndarray:
    start, along = np.array(a), np.array(b) - np.array(a)
    t = np.clip((p - start) @ along / (along @ along), 0, 1)
    return np.linalg.norm(p - start - t[..., None] * along, axis=-1) - radius


def ball(p: np.ndarray, centre: tuple, radius: float) -> np.ndarray:
    return np.linalg.norm(p - np.array(centre), axis=-1) - radius


def box(p: np.ndarray, centre: tuple, half: tuple, round_m: float = 0.0) -> np.ndarray:
    q = np.abs(p - np.array(centre)) - np.array(half)
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) - round_m


PARTS = {
    "foot": lambda p: box(p, (0, -0.44, 0), (0.16, 0.06, 0.16)),
    "body": lambda p: capsule(p, (0, -0.38, 0), (0, 0.12, 0), 0.11),
    "head": lambda p: ball(p, (0, 0.34, 0), 0.12),
    "neck": lambda p: capsule(p, (0, 0.12, 0), (0, 0.34, 0), 0.05),
    "arm": lambda p: capsule(p, (-0.1, 0.15, 0), (-0.2, -0.1, 0.2), 0.03),
    "shoulder": lambda p: capsule(p, (0, 0.15, 0), (0.2, 0.15, 0), 0.04),
    "blade": lambda p: box(p, (0.22, 0.0, 0.0), (0.06, 0.15, BLADE / 2)),
    "left plate": lambda p: box(p, (-0.24, 0.3, -(SLOT / 2 + 0.005)), (0.06, 0.06, 0.005)),
    "right plate": lambda p: box(p, (-0.24, 0.3, SLOT / 2 + 0.005), (0.06, 0.06, 0.005)),
    "bracket": lambda p: capsule(p, (-0.2, 0.3, 0), (0, 0.3, 0), 0.012),
}
"""Signed distances of the parts, metres; the statue is their union."""


def distance(points: np.ndarray) -> np.ndarray:
    """Signed distance to the statue [...] of points [..., 3]; exact outside of it, and near its surface inside but where parts meet."""
    return np.min([part(points) for part in PARTS.values()], axis=0)


def nearest_part(points: np.ndarray) -> np.ndarray:
    """Name of the part whose surface is nearest."""
    return np.array(list(PARTS))[np.abs([part(points) for part in PARTS.values()]).argmin(axis=0)]


class Shot(NamedTuple):
    """One range image."""

    depth: np.ndarray  # [rows, cols] metres, 0 where the ray misses
    true: np.ndarray  # [rows, cols] metres, without noise
    mask: np.ndarray  # [rows, cols] bool
    world_from_camera: np.ndarray  # [4, 4]
    focal: float
    side: tuple[int, int]  # rows, cols


def place(angle: float, height: float, range_m: float, *, target: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """World from camera of a camera that looks at the target from an angle about +y."""
    eye = np.array(target) + [range_m * np.sin(angle), height, range_m * np.cos(angle)]
    return look_at(eye, target)


def shoot(pose: np.ndarray, side: tuple[int, int], focal: float, *, sigma: float = SIGMA, seed: int = 0, scene=distance,
          **march: float) -> Shot:
    """A range image by sphere tracing, with Gaussian noise on the depth; `march`: options of `trace`."""
    rows, cols = side
    u, v = np.meshgrid(np.arange(cols) + 0.5 - cols / 2, np.arange(rows) + 0.5 - rows / 2)
    ray = np.stack([u / focal, -v / focal, -np.ones(side)], axis=-1).reshape(-1, 3)
    length = np.linalg.norm(ray, axis=-1)
    along, hit = trace(pose[:3, 3], (ray / length[:, None]) @ pose[:3, :3].T, scene, **march)
    true = np.where(hit, along / length, 0).reshape(side)
    noise = sigma * np.random.default_rng(seed).standard_normal(side)
    mask = hit.reshape(side)
    return Shot(np.where(mask, true + noise, 0), true, mask, pose, focal, side)


def trace(start: np.ndarray, direction: np.ndarray, scene=distance, *, near: float = 0.0, far: float = 10.0, hit_m: float = 1e-7,
          steps: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """How far rays [n, 3] from a point, or from [n, 3], reach, metres, and whether they hit: sphere tracing."""
    start = np.broadcast_to(start, direction.shape)
    along, alive = np.full(len(direction), near), np.arange(len(direction))
    hit = np.zeros(len(direction), dtype=bool)
    for _ in range(steps):
        d = scene(start[alive] + along[alive, None] * direction[alive])
        along[alive] += d
        close = np.abs(d) < hit_m
        hit[alive[close]] = True
        alive = alive[~close & (along[alive] < far)]
        if len(alive) == 0:
            break
    return along, hit


def turntable(count: int = 18, side: tuple[int, int] = (240, 180), *, sigma: float = SIGMA, range_m: float = 2.0,
              seed: int = 0, scene=distance) -> list[Shot]:
    """Range images all around, from three heights in turn; the statue fills the image."""
    focal = 0.83 * side[0] * range_m
    heights = (0.1, 1.1, -0.5)
    return [shoot(place(2 * np.pi * k / count, heights[k % 3], range_m), side, focal, sigma=sigma, seed=seed + k, scene=scene)
            for k in range(count)]


def write_scans(folder: Path, shots: list[Shot], *, sigma: float = SIGMA, poses: list[np.ndarray | None] | None = None,
                coloured: bool = False, maps: list[SurfaceMaps] | None = None) -> Path:
    """Write range images as results of `relit depth` with a scan-set.json, and return the file; a pose of None is left out."""
    entries = []
    for number, shot in enumerate(shots):
        rows, cols = shot.side
        camera = Camera(projection="perspective", resolution=(cols, rows), focal_px=(shot.focal, shot.focal))
        depth = DepthMaps(camera=camera, mask=shot.mask, depth=shot.depth.astype(np.float32),
                         sigma=np.full(shot.side, sigma, dtype=np.float32))
        place = folder / f"scan{number}"
        depth.write(place / "depth.exr")
        if coloured:
            points = camera.points(-shot.depth)[shot.mask]
            world = points @ shot.world_from_camera[:3, :3].T + shot.world_from_camera[:3, 3]
            write_ply(PointCloud(points, colour_of(world)), place / "points.ply")
        entry = {"name": f"view {number}", "path": place.name}
        if maps is not None:
            maps[number].write(place / "maps.exr")
            entry["maps"] = f"{place.name}/maps.exr"
        pose = shot.world_from_camera if poses is None else poses[number]
        if pose is not None:
            entry["scan_to_world"] = pose.tolist()
        entries.append(entry)
    return write_set(folder, entries)


def write_set(folder: Path, entries: list[dict]) -> Path:
    """Write a scan-set.json of entries."""
    folder.mkdir(exist_ok=True)
    file = folder / "scan-set.json"
    file.write_text(json.dumps({"schema": "relit.scan-set/1", "name": "statue", "scans": entries}))
    return file


def colour_of(points: np.ndarray) -> np.ndarray:
    """Display-encoded colours that vary slowly over space."""
    return np.rint(127.5 + 100 * np.sin(9 * points + [0, 1, 2])).astype(np.uint8)


def shoot_parallel(pose: np.ndarray, side: tuple[int, int], pixel_m: float, *, sigma: float = SIGMA, seed: int = 0, scene=distance,
                   start_m: float = 1.0) -> Shot:
    """A range image by parallel lines of sight, which start `start_m` before the frame of the camera: depths may be below 0."""
    rows, cols = side
    u, v = np.meshgrid(np.arange(cols) + 0.5 - cols / 2, np.arange(rows) + 0.5 - rows / 2)
    points = np.stack([u * pixel_m, -v * pixel_m, np.full(side, start_m)], axis=-1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    along, hit = trace(points, np.broadcast_to(-pose[:3, 2], points.shape), scene, far=start_m + 5)
    mask = hit.reshape(side)
    true = np.where(mask, along.reshape(side) - start_m, 0)
    noise = sigma * np.random.default_rng(seed).standard_normal(side)
    return Shot(np.where(mask, true + noise, 0), true, mask, pose, 0.0, side)
