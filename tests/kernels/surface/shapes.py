"""Surfaces whose normals and heights are known in closed form, on pixel grids."""

from typing import NamedTuple

import numpy as np


class Shape(NamedTuple):
    normal: np.ndarray  # [3, rows, cols] float32
    mask: np.ndarray  # [rows, cols] bool
    x: np.ndarray  # [rows, cols] float32
    y: np.ndarray
    z: np.ndarray  # [rows, cols] float64, the truth


def plane_coordinates(rows, cols, size=1.0):
    """x right, y up, `size` across the longer side, the origin in the middle."""
    pixel = size / max(rows, cols)
    return np.meshgrid((np.arange(cols) + 0.5 - cols / 2) * pixel, (rows / 2 - np.arange(rows) - 0.5) * pixel)


def from_gradient(x, y, z, zx, zy, mask=None):
    normal = np.stack([-zx, -zy, np.ones_like(z)])
    normal /= np.linalg.norm(normal, axis=0)
    mask = np.ones(z.shape, dtype=bool) if mask is None else mask
    return Shape(*(a.astype(np.float32) for a in (normal,)), mask, x.astype(np.float32), y.astype(np.float32), z)


def plane(rows, cols, slope_x=0.3, slope_y=-0.7, size=1.0):
    x, y = plane_coordinates(rows, cols, size)
    return from_gradient(x, y, slope_x * x + slope_y * y, np.full_like(x, slope_x), np.full_like(x, slope_y))


def cap(n, radius=0.5, reach=0.48):
    """The front of a sphere."""
    x, y = plane_coordinates(n, n)
    z = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 1e-6))
    return from_gradient(x, y, z, -x / z, -y / z, np.hypot(x, y) < reach)


def cap_in_perspective(n, radius=0.5, centre=-3.0):
    """A sphere seen by a pinhole, without the last grazing degrees."""
    x, y = plane_coordinates(n, n, size=0.36)
    ray = np.stack([x, y, -np.ones_like(x)])
    a, b = (ray**2).sum(0), ray[2] * centre
    under = b**2 - a * (centre**2 - radius**2)
    point = ray * (b - np.sqrt(np.maximum(under, 0.0))) / a
    normal = (point - np.array([0.0, 0.0, centre])[:, None, None]) / radius
    facing = -(normal * ray).sum(0) / np.sqrt(a)
    mask = (under > 0) & (facing > 0.15)
    return Shape(normal.astype(np.float32), mask, x.astype(np.float32), y.astype(np.float32), point[2])


def bumps(n, mask=None):
    """Three sine waves in each direction."""
    x, y = plane_coordinates(n, n)
    k = 6 * np.pi
    z = 0.03 * np.sin(k * x + 0.5) * np.cos(k * y)
    zx, zy = 0.03 * k * np.cos(k * x + 0.5) * np.cos(k * y), -0.03 * k * np.sin(k * x + 0.5) * np.sin(k * y)
    return from_gradient(x, y, z, zx, zy, mask)


def ragged_mask(rows, cols, seed=0):
    """A round blob with a wavy rim, round holes and a few single pixels missing."""
    x, y = plane_coordinates(rows, cols)
    angle = np.arctan2(y, x)
    mask = np.hypot(x, y) < 0.42 + 0.03 * np.sin(9 * angle) + 0.02 * np.sin(31 * angle)
    for cx, cy, radius in ((0.1, 0.12, 0.05), (-0.2, 0.05, 0.03), (0.0, -0.22, 0.08)):
        mask &= np.hypot(x - cx, y - cy) > radius
    return mask & (np.random.default_rng(seed).random(mask.shape) > 0.02)


def torn_sheet(n):
    """A sheet torn along y = 0 from x = −0.1 to the right, its lips bent up and down: normals tell the whole height."""
    x, y = plane_coordinates(n, n)
    run, side = np.maximum(x + 0.1, 0.0), np.where(y > 0, 0.5, -0.5)
    return from_gradient(x, y, side * run**2, 2 * side * run, np.zeros_like(x))


def ball_before_wall(n):
    """An occluding step all around a ball. Normals cannot tell how far the ball is from the wall."""
    x, y = plane_coordinates(n, n)
    radius = 0.25
    ball = np.hypot(x, y) < radius
    wall = from_gradient(x, y, 0.05 * (np.sin(8 * x) + np.cos(6 * y)), 0.4 * np.cos(8 * x), -0.3 * np.sin(6 * y))
    front = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0.0))
    normal = np.where(ball, np.stack([x, y, front]) / radius, wall.normal)
    return wall._replace(normal=normal.astype(np.float32), z=np.where(ball, front + 0.1, wall.z)), ball
