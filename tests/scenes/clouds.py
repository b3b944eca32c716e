"""Scans of the statue as sets of points: rays in random directions, in a frame of a file that is not that of the scanner."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from service.scans.points.rigid import inverse
from stage.formats.ply import PointCloud, write_ply
from tests.scenes.statue import SIGMA, colour_of, distance, place, trace

MM = 1e3
RANGE_M = 2.0
HALF_ACROSS, HALF_UP = 0.23, 0.31
"""Tangents of half of the field of view, which the statue fills."""


class Cloud(NamedTuple):
    """One scan."""

    points: np.ndarray  # [n, 3] metres, frame of the file
    colours: np.ndarray  # [n, 3] uint8
    world_from_file: np.ndarray  # [4, 4]
    viewpoint: np.ndarray  # [3] metres, frame of the file


def scatter(pose: np.ndarray, rays: int, *, sigma: float = SIGMA, seed: int = 0, scene=distance) -> Cloud:
    """What a scanner at a pose measures along rays that are uniform in the image, with Gaussian noise along each."""
    rng = np.random.default_rng([7, seed])
    ray = np.stack([rng.uniform(-HALF_ACROSS, HALF_ACROSS, rays), rng.uniform(-HALF_UP, HALF_UP, rays), np.full(rays, -1.0)], axis=1)
    direction = ray / np.linalg.norm(ray, axis=1, keepdims=True) @ pose[:3, :3].T
    along, hit = trace(pose[:3, 3], direction, scene)
    world = pose[:3, 3] + (along + sigma * rng.standard_normal(rays))[hit, None] * direction[hit]
    world_from_file = np.eye(4)
    world_from_file[:3, :3], world_from_file[:3, 3] = Rotation.from_rotvec(rng.normal(0, 1, 3)).as_matrix(), rng.normal(0, 0.5, 3)
    file = inverse(world_from_file)
    return Cloud(world @ file[:3, :3].T + file[:3, 3], colour_of(world), world_from_file, file[:3, :3] @ pose[:3, 3] + file[:3, 3])


def all_around(count: int, rays: int, *, sigma: float = SIGMA, scene=distance) -> list[Cloud]:
    """Scans from all sides, from three heights in turn."""
    heights = (0.1, 1.1, -0.5)
    return [scatter(place(2 * np.pi * k / count, heights[k % 3], RANGE_M), rays, sigma=sigma, seed=k, scene=scene) for k in range(count)]


def entry(cloud: Cloud, folder: Path, number: int, *, sigma: float = SIGMA, **changes: object) -> dict:
    """Write a scan as a PLY file in millimetres, and return what the scan set says of it."""
    write_ply(PointCloud((MM * cloud.points).astype(np.float32), cloud.colours), folder / f"cloud{number}.ply")
    made = {"name": f"cloud {number}", "path": f"cloud{number}.ply", "unit": "mm", "sigma_m": sigma,
            "viewpoint_m": cloud.viewpoint.tolist(), "scan_to_world": cloud.world_from_file.tolist()} | changes
    return {name: value for name, value in made.items() if value is not None}
