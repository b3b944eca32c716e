"""Surfaces with a closed form as a depth and as normals, each with the errors of its kind."""

from typing import NamedTuple

import numpy as np

MM = 1e-3


class View(NamedTuple):
    """What one camera sees of a surface."""

    x: np.ndarray  # [rows, cols] plane coordinates
    y: np.ndarray
    z: np.ndarray  # [rows, cols] camera-frame z, metres
    normal: np.ndarray  # [3, rows, cols]
    perspective: bool


def see(shape: str, *, size: int = 192, perspective: bool = False) -> View:
    """A surface half a metre away, about a millimetre a pixel: `wave`, or a tilted `disc` 35 mm and more before a plane."""
    u, v = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    x, y = ((u - size / 2) * MM, (size / 2 - v) * MM)
    if not perspective:
        z, slope = _surface(shape, x, y)
        normal = np.stack([-slope[0], -slope[1], np.ones_like(x)])
        return View(x, y, z - 0.5, normal / np.linalg.norm(normal, axis=0), False)
    x, y = x / 0.5, y / 0.5
    depth = np.full(x.shape, 0.5)
    for _ in range(200):  # the ray meets the surface: a fixed point, since slopes are below one
        depth = 0.5 - _surface(shape, depth * x, depth * y)[0]
    slope = _surface(shape, depth * x, depth * y)[1]
    normal = np.stack([-slope[0], -slope[1], np.ones_like(x)])
    return View(x, y, -depth, normal / np.linalg.norm(normal, axis=0), True)


def _surface(shape: str, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if shape == "wave":
        z = 10 * MM * np.sin(40 * x) * np.cos(30 * y) + 1 * MM * np.sin(400 * x)
        return z, np.stack([0.4 * np.cos(40 * x) * np.cos(30 * y) + 0.4 * np.cos(400 * x), -0.3 * np.sin(40 * x) * np.sin(30 * y)])
    assert shape == "disc"
    on = np.hypot(x + 10 * MM, y) < 50 * MM
    return np.where(on, 40 * MM + 0.1 * x + 0.05 * y, 0), np.stack([np.where(on, 0.1, 0), np.where(on, 0.05, 0)])


def drifting(normal: np.ndarray, *, noise: float, drift: float, seed: int = 0) -> np.ndarray:
    """Normals with white noise and with a smooth error of this many degrees, as lights that are not quite known make it."""
    rows, cols = normal.shape[1:]
    down, across = np.meshgrid(np.linspace(0, 2 * np.pi, rows), np.linspace(0, 2 * np.pi, cols), indexing="ij")
    smooth = np.radians(drift) * np.stack([np.sin(across) * np.cos(down), np.cos(across / 2), np.zeros((rows, cols))])
    found = normal + smooth + np.radians(noise) * np.random.default_rng(seed).standard_normal(normal.shape)
    return found / np.linalg.norm(found, axis=0)
