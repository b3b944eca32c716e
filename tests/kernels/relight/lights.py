"""Sets of lights with a closed form, and suns."""

import numpy as np

from tests.reference.relight import rotation_about

STILL = np.eye(3)[None]
AXES = np.concatenate([np.eye(3), -np.eye(3)])  # +x +y +z -x -y -z
CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3)
SUM = 1e-12
"""Relative: float64 sums of up to a million samples."""


def icosahedron():
    g = (1 + np.sqrt(5)) / 2
    corners = np.array([[0, s, t * g] for s in (-1, 1) for t in (-1, 1)])
    return np.concatenate([np.roll(corners, k, axis=1) for k in range(3)]) / np.hypot(1, g)


def dodecahedron():
    g = (1 + np.sqrt(5)) / 2
    corners = np.array([[0, s / g, t * g] for s in (-1, 1) for t in (-1, 1)])
    return np.concatenate([CUBE, *(np.roll(corners, k, axis=1) / np.sqrt(3) for k in range(3))])


def ring(count, elevation_degrees):
    azimuth, elevation = 2 * np.pi * np.arange(count) / count, np.radians(elevation_degrees)
    flat = np.cos(elevation)
    return np.stack([flat * np.sin(azimuth), np.full(count, np.sin(elevation)), flat * np.cos(azimuth)], axis=1)


def scattered(count, seed):
    direction = np.random.default_rng(seed).normal(size=(count, 3))
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def turn(seed):
    """About any axis by any angle."""
    rng = np.random.default_rng(seed)
    return rotation_about(rng.normal(size=3), rng.uniform(-180, 180))


def sun(rows, cols, row, col, radiance=1.0):
    environment = np.zeros((rows, cols, 3))
    environment[row, col] = radiance
    return environment
