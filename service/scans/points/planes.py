"""Local planes of a set of points, from the moments of the points in cells of a grid."""

from typing import NamedTuple

import numpy as np

POINTS_PER_CELL = 4.0
"""The mean number of points of an occupied cell. A plane is fitted to the 27 cells around a point; a surface crosses about nine of them."""
LEAST_POINTS = 6
"""The fewest points that a plane is fitted to; three of them determine it, the others show the noise."""
LEAST_SPREAD = 1e-3
"""The least ratio of the variances of the points along their second and first direction: points on one line determine no plane."""


class LocalPlanes(NamedTuple):
    """The plane through the neighbours of each point."""

    normals: np.ndarray  # [n, 3] float32, unit, towards the origin; 0 where the neighbours determine none
    scatter: np.ndarray  # [n] float32 metres: RMS distance of the neighbours from the plane; NaN where there is none
    cell_m: float
    """Side of the cells, metres."""


def local_planes(points: np.ndarray, *, origin: np.ndarray) -> LocalPlanes:
    """Return the plane that fits the points of the 27 cells around each of [n, 3] points; normals point towards an origin [3]."""
    middle = np.median(points, axis=0).astype(np.float64) if len(points) else np.zeros(3)
    local = points.astype(np.float64) - middle
    cell = _cell_of(local)
    keys, steps = _cells(local, cell)
    occupied, of_point = np.unique(keys, return_inverse=True)
    moments = _moments(local, of_point, len(occupied))
    around = np.zeros_like(moments)
    for offset in np.ndindex(3, 3, 3):
        there = occupied + int((np.array(offset) - 1) @ steps)
        place = np.minimum(np.searchsorted(occupied, there), max(len(occupied) - 1, 0))
        found = occupied[place] == there
        around[found] += moments[place[found]]
    normals, scatter = _planes(around)
    normals, scatter = normals[of_point], scatter[of_point]
    away = np.einsum("ij,ij->i", normals, points - origin) > 0
    normals[away] *= -1
    return LocalPlanes(normals.astype(np.float32), scatter.astype(np.float32), cell)


def robust_scatter(planes: LocalPlanes) -> float:
    """Return the noise across the surface, metres: the median of the scatter, which the bend of the surface adds to; NaN without planes."""
    known = planes.scatter[np.isfinite(planes.scatter)]
    return float(np.median(known)) if known.size else float("nan")


def _cell_of(local: np.ndarray) -> float:
    """Return the side of the cells, metres, at which occupied cells hold `POINTS_PER_CELL` points."""
    extent = float(np.ptp(local, axis=0).max()) if len(local) else 0.0
    cell = max(2 * extent / np.sqrt(max(len(local), 1)), 1e-9 * extent, np.finfo(np.float64).tiny)
    for _ in range(4):
        held = len(local) / max(len(np.unique(_cells(local, cell)[0])), 1)
        cell *= float(np.clip(np.sqrt(POINTS_PER_CELL / max(held, 1.0)), 0.25, 4.0)) if held > 1.01 else 2.0
    return float(cell)


def _cells(local: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of the cell of each point, [n] int64, in a grid with an empty border, and by how much it grows along each axis."""
    index = np.floor((local - local.min(axis=0)) / cell).astype(np.int64) + 1 if len(local) else np.zeros((0, 3), dtype=np.int64)
    size = index.max(axis=0) + 3 if len(index) else np.ones(3, dtype=np.int64)
    steps = np.array([1, size[0], size[0] * size[1]])
    return index @ steps, steps


def _moments(local: np.ndarray, of_point: np.ndarray, count: int) -> np.ndarray:
    """Return the number of points of each cell, the sums of x, y, z and of their six products: [cell, 10]."""
    x, y, z = local.T
    columns = (np.ones(len(local)), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
    return np.stack([np.bincount(of_point, column, minlength=count) for column in columns], axis=1)


def _planes(moments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the normal [cell, 3] and the RMS distance [cell] of the plane through the points of moments [cell, 10]."""
    count = np.maximum(moments[:, 0], 1)
    mean = moments[:, 1:4] / count[:, None]
    products = moments[:, [4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(-1, 3, 3) / count[:, None, None]
    spread, axes = np.linalg.eigh(products - mean[:, :, None] * mean[:, None, :])
    good = (moments[:, 0] >= LEAST_POINTS) & (spread[:, 1] > LEAST_SPREAD * spread[:, 2])
    unbiased = np.maximum(spread[:, 0], 0) * count / np.maximum(count - 3, 1)
    return np.where(good[:, None], axes[:, :, 0], 0), np.where(good, np.sqrt(unbiased), np.nan)
