"""A room with posts, and the shots of a scanner that drives through it, with declarations that may be wrong."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

HALF = np.array([6.0, 3.0, 8.0])
POSTS = ((3.0, -4.0, 0.4), (-3.5, 2.0, 0.3), (1.5, 5.0, 0.5), (-1.0, -6.0, 0.25), (4.5, 1.0, 0.35))
"""Middle x and z, and radius."""
DURATION_S, SPIN_HZ, POSES_HZ = 40.0, 5.0, 20
MOUNT, LEVER = Rotation.from_euler("YX", (0.3, 0.1)), np.array([0.1, 0.4, 0.05])
"""How the scanner is mounted on the platform: its rotation, and its place in metres."""


def distances(origin: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """[n] along rays to the walls and posts."""
    with np.errstate(divide="ignore"):
        nearest = np.where(ray > 0, (HALF - origin) / ray, (-HALF - origin) / ray).min(axis=1)
    for x, z, radius in POSTS:
        flat = (ray[:, [0, 2]] ** 2).sum(axis=1)
        off = origin[:, [0, 2]] - (x, z)
        along = (off * ray[:, [0, 2]]).sum(axis=1)
        root = along**2 - flat * ((off**2).sum(axis=1) - radius**2)
        hit = np.where(root > 0, (-along - np.sqrt(np.maximum(root, 0))) / flat, np.inf)
        nearest = np.minimum(nearest, np.where(hit > 0.05, hit, np.inf))
    return nearest


def platform(time_s: np.ndarray) -> tuple[np.ndarray, Rotation]:
    """To and fro through the room, turning."""
    part = 2 * np.pi * time_s / DURATION_S
    place = np.stack([-2 + 4 * np.abs((time_s / DURATION_S * 2) % 2 - 1), 0 * part, np.sin(part)], axis=-1)
    return place, Rotation.from_euler("YX", np.stack([0.8 * np.sin(2 * part), 0.05 * np.sin(5 * part)], axis=-1))


def write_scan(folder: Path, *, seed: int = 0, count: int = 60_000, noise: float = 0.01, late_s: float = 0.0, turned: float = 0.0,
               inverted: bool = False, factors: tuple[float, ...] = (1, 1, 1, 1, 1), still: bool = False) -> Path:
    """Write a scan.
    `late_s`: by how much the clock of the track is late. `turned`: degrees about x by which the mounting is declared turned. `inverted`:
    whether poses are platform_from_world. `factors`: of the columns of the shots."""
    random = np.random.default_rng(seed)
    time_s = np.sort(random.uniform(0.2, DURATION_S - 0.2, count))
    azimuth, elevation = (2 * np.pi * SPIN_HZ * time_s) % (2 * np.pi) - np.pi, random.uniform(-0.5, 0.5, count)
    place, pose = platform(np.zeros(count) if still else time_s)
    local = np.stack([np.sin(azimuth) * np.cos(elevation), np.sin(elevation), -np.cos(azimuth) * np.cos(elevation)], axis=-1)
    range_m = distances(place + pose.apply(LEVER), pose.apply(MOUNT.apply(local))) + random.normal(0, noise, count)
    np.save(folder / "shots.npy", np.stack([time_s, azimuth, elevation, range_m, np.ones(count)], axis=1) * factors)
    track: list[dict[str, Any]] = []
    known = np.arange(0, DURATION_S + 1e-9, 1 / POSES_HZ)
    for moment, middle, rotation in zip(known, *platform(known), strict=True):
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), middle
        track.append({"time_s": moment + late_s, "world_from_platform": (np.linalg.inv(matrix) if inverted else matrix).tolist()})
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = (Rotation.from_euler("x", turned, degrees=True) * MOUNT).as_matrix(), LEVER
    (folder / "scan.json").write_text(json.dumps({"schema": "relit.scan/1", "name": "room", "shots": "shots.npy",
                                                  "platform_from_scanner": mount.tolist(), "track": track[:1] if still else track}))
    return folder
