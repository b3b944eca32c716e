"""Waves of a body that scatters light below its surface, under distant lights with cast shadows.

The light that a place gives back is that which falls around it, weighted by exp(-r / length) / r over the surface, the far field of a
dipole (Jensen and others, "A Practical Model for Subsurface Light Transport", SIGGRAPH 2001), with a length for each colour.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.sparse import coo_matrix
from scipy.spatial import cKDTree

from tests.scenes.captures import Scene, write_capture

REACH = 4.5
"""Lengths after which nothing is scattered."""


class Body(NamedTuple):
    """What a body does with light."""

    albedo: tuple[float, float, float] = (0.6, 0.5, 0.4)
    lengths: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Of scattering in each colour, pixels; 0: opaque."""
    lens_px: float = 0.0
    """Standard deviation of the blur of the lens."""
    bounced: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Part of the light that falls within twelve pixels that comes back from beside."""


def waves(side: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Heights [rows, cols] in pixels, up towards the camera, and normals [rows, cols, 3]."""
    rng = np.random.default_rng(seed)
    row, col = np.indices((side, side)) - (side - 1) / 2
    height, slope = np.zeros((side, side)), np.zeros((2, side, side))
    for _ in range(5):
        along, phase = rng.normal(0, 0.17, 2), rng.uniform(0, 6)
        high = 0.45 / np.hypot(*along)
        height += high * np.sin(along[0] * col - along[1] * row + phase)
        slope += high * along[:, None, None] * np.cos(along[0] * col - along[1] * row + phase)
    normal = np.stack([-slope[0], -slope[1], np.ones((side, side))], axis=-1)
    return height, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def lit(height: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Which places a distant light reaches, by marching along the rows and columns towards it."""
    side = len(height)
    step = direction[:2] / np.abs(direction[:2]).max()
    rise = direction[2] / np.hypot(*direction[:2]) * np.hypot(*step)
    row, col = np.indices(height.shape)
    free = np.ones(height.shape, dtype=bool)
    for far in range(1, side):
        if far * rise > np.ptp(height):
            break
        at = np.rint([row - far * step[1], col + far * step[0]]).astype(int)
        inside = ((at >= 0) & (at < side)).all(axis=0)
        free &= ~inside | (height[tuple(np.clip(at, 0, side - 1))] < height + far * rise + 0.15)
    return free


def scattered(height: np.ndarray, normal: np.ndarray, length: float) -> coo_matrix:
    """The matrix that takes the light that falls on each pixel to that which it gives back."""
    row, col = np.indices(height.shape)
    points, area = np.stack([col, row, height], axis=-1).reshape(-1, 3), 1 / normal[..., 2].reshape(-1)
    pairs = cKDTree(points).query_pairs(REACH * length, output_type="ndarray")
    here, there = np.concatenate([pairs, pairs[:, ::-1], np.arange(len(points))[:, None].repeat(2, axis=1)]).T
    r = np.linalg.norm(points[here] - points[there], axis=1)
    weights = np.exp(-r / length) / (r + 0.3 * length + 0.3) * area[there]
    matrix = coo_matrix((weights, (here, there)), shape=(len(points),) * 2).tocsr()
    return matrix.multiply(1 / matrix.sum(axis=1)).tocsr()


def write(folder: Path, body: Body, *, side: int = 64, lights: int = 24, noise: float = 1e-3, seed: int = 0) -> np.ndarray:
    """Write a capture of a body, and return its normals."""
    height, normal = waves(side, seed)
    up, turn = 1 - 0.7 * (np.arange(lights) + 0.5) / lights, np.pi * (1 + 5**0.5) * np.arange(lights)
    across = np.sqrt(1 - up**2)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=1)
    spread = [scattered(height, normal, length) if length else None for length in body.lengths]
    rng = np.random.default_rng(seed + 1)
    images = np.empty((lights, side, side, 3))
    for image, direction in zip(images, directions, strict=True):
        falls = np.maximum(normal @ direction, 0) * lit(height, direction)
        for channel, matrix in enumerate(spread):
            back = falls if matrix is None else (matrix @ falls.reshape(-1)).reshape(falls.shape)
            back = back + body.bounced[channel] * gaussian_filter(falls, 12)
            image[..., channel] = body.albedo[channel] * (gaussian_filter(back, body.lens_px) if body.lens_px else back)
    images = np.maximum(images + noise * rng.standard_normal(images.shape), 0)
    full = np.ones((side, side), dtype=bool)
    albedo = np.broadcast_to(body.albedo, (side, side, 3))
    write_capture(folder, Scene(normal, albedo, full, directions, np.full((lights, 3), np.pi), images))
    return normal
