"""A V-groove of two planes at right angles, and a round one, along y, seen from +z, with all bounces of light: radiosity in float64.

Imports nothing of ours.
"""

import numpy as np


class Groove:
    """side x side pixels of unit size; x from left to right, both faces rise at 45 degrees from the middle."""

    def __init__(self, side: int):
        self.side = side
        v, u = np.mgrid[0:side, 0:side]
        x, y = u + 0.5 - side / 2, side / 2 - (v + 0.5)
        self.points = np.stack([x, y, np.abs(x)], axis=-1).reshape(-1, 3)
        s = np.sqrt(0.5)
        self.normals = np.stack([-np.sign(x) * s, np.zeros_like(x), np.full_like(x, s)], axis=-1).reshape(-1, 3)
        self.areas = np.full(side * side, 1 / s)

    def factors(self) -> np.ndarray:
        """[n, n] form factors; the two faces see each other wholly, each face not itself."""
        way = self.points[None] - self.points[:, None]
        squared = (way**2).sum(-1) + np.eye(len(way))
        here = np.maximum((way * self.normals[:, None]).sum(-1), 0)
        there = np.maximum(-(way * self.normals[None]).sum(-1), 0)
        return here * there / squared * self.areas[None] / (np.pi * squared + self.areas[None])

    def shadowed(self, lights: np.ndarray) -> np.ndarray:
        """[light, pixel] whether the other face stands before the light, as no light within 45 degrees of +z finds it."""
        x, y = self.points[:, 0], self.points[:, 1]
        lx, ly, lz = (part[:, None] for part in np.asarray(lights).T)
        away = np.where(x * lx < 0, np.abs(lx) - lz, 0)  # how fast the way to the light comes nearer to the other face
        length = 2 * np.abs(x) / np.where(away > 0, away, 1)
        edge = self.side / 2
        return (away > 0) & (np.abs(x + length * lx) < edge) & (np.abs(y + length * ly) < edge)

    def radiance(self, lights: np.ndarray, albedo: float) -> tuple[np.ndarray, np.ndarray]:
        """[light, pixel] radiance with all bounces, and the direct part, for unit irradiance."""
        direct = albedo / np.pi * np.where(self.shadowed(lights), 0, np.maximum(lights @ self.normals.T, 0))
        whole = np.linalg.solve(np.eye(self.side**2) - albedo * self.factors(), direct.T).T
        return whole, direct


class Trough(Groove):
    """The same with a round floor, a parabola whose sides rise with a slope of `steepest` at the edge."""

    def __init__(self, side: int, steepest: float):
        super().__init__(side)
        x, y, _ = self.points.T
        self.bend = steepest / side
        slope = 2 * self.bend * x
        self.points = np.stack([x, y, self.bend * x**2], axis=-1)
        self.areas = np.sqrt(1 + slope**2)
        self.normals = np.stack([-slope, np.zeros_like(x), np.ones_like(x)], axis=-1) / self.areas[:, None]

    def shadowed(self, lights: np.ndarray) -> np.ndarray:
        x, y = self.points[:, 0], self.points[:, 1]
        lx, ly, lz = (part[:, None] for part in np.asarray(lights).T)
        length = (lz - 2 * self.bend * x * lx) / np.maximum(self.bend * lx**2, 1e-12)  # to where the way meets the parabola again
        edge = self.side / 2
        return (length > 0) & (np.abs(x + length * lx) < edge) & (np.abs(y + length * ly) < edge)
