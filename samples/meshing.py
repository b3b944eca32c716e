"""Meshes from signed distances and swept curves, in plain NumPy.

Everything here is in the units of its input; normals point outwards, faces are counter-clockwise from outside.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]  # [..., 3] points -> [...] signed distance, negative inside


class Surface(NamedTuple):
    """A triangle mesh with its material at the vertices."""

    points: np.ndarray  # [V, 3]
    faces: np.ndarray  # [F, 3] int
    normals: np.ndarray  # [V, 3] unit
    albedo: np.ndarray  # [V, 3] linear
    f0: np.ndarray  # [V]
    roughness: np.ndarray  # [V]


def surface_nets(distance: Distance, lower, upper, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the zero level of `distance` inside the box `lower`..`upper`, which it must not touch.

    Returns:
        points [V, 3] and faces [F, 3].

    Source: Gibson 1998, "Constrained elastic surface nets", without the relaxation: the caller projects.
    """
    axes = [np.arange(lo, hi + step, step) for lo, hi in zip(lower, upper, strict=True)]
    field = np.stack([distance(np.stack(np.meshgrid([x], *axes[1:], indexing="ij"), -1))[0] for x in axes[0]])
    shape = np.array(field.shape)
    cell_count = int(np.prod(shape))
    sums, hits, quads = np.zeros((cell_count, 3)), np.zeros(cell_count), []
    inside = field < 0
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        index = np.argwhere(inside[tuple(low)] != inside[tuple(high)])
        step_up = np.eye(3, dtype=int)[axis]
        a, b = field[tuple(index.T)], field[tuple((index + step_up).T)]
        crossing = index + (a / (a - b))[:, None] * step_up
        e1, e2 = np.eye(3, dtype=int)[(axis + 1) % 3], np.eye(3, dtype=int)[(axis + 2) % 3]
        ring = np.stack([np.ravel_multi_index((index + o).T, shape) for o in (-e1 - e2, -e2, 0 * e1, -e1)], axis=1)
        for cell in ring.T:
            np.add.at(sums, cell, crossing)
            np.add.at(hits, cell, 1)
        quads.append(np.where((a < 0)[:, None], ring, ring[:, ::-1]))
    used = np.flatnonzero(hits)
    number = np.zeros(cell_count, int)
    number[used] = np.arange(len(used))
    quad = number[np.concatenate(quads)]
    points = np.array([axis[0] for axis in axes]) + step * sums[used] / hits[used, None]
    return points, np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])


def subdivide(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split every triangle into four at its edge midpoints."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    key, inverse = np.unique(edges[:, 0] * len(points) + edges[:, 1], return_inverse=True)
    middle = 0.5 * (points[key // len(points)] + points[key % len(points)])
    ab, bc, ca = (inverse.reshape(-1, 3) + len(points)).T
    a, b, c = faces.T
    return np.concatenate([points, middle]), np.concatenate(
        [np.stack(t, axis=1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )


def gradient(distance: Distance, points: np.ndarray, *, step: float) -> np.ndarray:
    """Return the unit gradient of a distance by central differences."""
    slope = np.stack([distance(points + step * e) - distance(points - step * e) for e in np.eye(3)], axis=-1)
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)


def project(distance: Distance, points: np.ndarray, *, step: float, rounds: int = 4) -> np.ndarray:
    """Move points onto the zero level along the gradient."""
    for _ in range(rounds):
        points = points - distance(points)[:, None] * gradient(distance, points, step=step)
    return points


def vertex_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area-weighted mean of the face normals around each vertex."""
    a, b, c = (points[faces[:, i]] for i in range(3))
    face_normal = np.cross(b - a, c - a)
    total = np.stack([np.bincount(faces.ravel(), np.repeat(face_normal[:, i], 3), len(points)) for i in range(3)], axis=1)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


def mesh_of(distance: Distance, lower, upper, edge: float, *, step: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and faces of the zero level of `distance` inside a box, with edges of about `edge`; `step`: of the gradients."""
    points, faces = surface_nets(distance, lower, upper, 4 * edge)
    for _ in range(2):
        points, faces = subdivide(project(distance, points, step=step), faces)
    return project(distance, points, step=step, rounds=2), faces


def grid_faces(rows: int, columns: int) -> np.ndarray:
    """Return the faces of a rows x columns vertex grid that wraps in columns; outside is to the right of increasing rows."""
    r, c = np.mgrid[: rows - 1, :columns]
    a, b = r * columns + c, r * columns + (c + 1) % columns
    d, e = a + columns, b + columns
    return np.concatenate([np.stack([a, b, e], -1).reshape(-1, 3), np.stack([a, e, d], -1).reshape(-1, 3)])


def sphere(center, radius: float, *, rows: int = 160, columns: int = 240) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the points, faces and unit directions from the centre of a UV sphere with its pole along +z."""
    polar, azimuth = np.meshgrid(
        np.linspace(1e-3, np.pi - 1e-3, rows), np.linspace(0, 2 * np.pi, columns, endpoint=False), indexing="ij"
    )
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], -1)
    unit = unit.reshape(-1, 3)
    return np.asarray(center) + radius * unit, grid_faces(rows, columns)[:, ::-1], unit


def tube(path: np.ndarray, radius: np.ndarray, *, flatten: float = 1.0, columns: int = 72):
    """Sweep a circle along `path` [N, 3] with `radius` [N]; `flatten` scales it along the path's sideways axis.

    Returns:
        points, faces, and the parameters (along 0..1, around in radians, 0 on top) of every vertex.
    """
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    forward = (path[-1] - path[0]) * [1, 0, 1]  # the path lies near one upright plane, so one side serves it all
    side = np.broadcast_to(np.cross(forward, [0.0, 1.0, 0.0]), tangent.shape)
    side = side - tangent * np.sum(side * tangent, axis=1, keepdims=True)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    ring = up[:, None] * np.cos(around)[None, :, None] + flatten * side[:, None] * np.sin(around)[None, :, None]
    points = path[:, None] + radius[:, None, None] * ring
    along = np.repeat(np.linspace(0, 1, len(path)), columns)
    return points.reshape(-1, 3), grid_faces(len(path), columns), along, np.tile(around, len(path))


def bezier(control: np.ndarray, count: int) -> np.ndarray:  # [K, 3] -> [count, 3]
    """Return points of a Bezier curve, by de Casteljau's algorithm."""
    t = np.linspace(0, 1, count)[:, None, None]
    points = np.broadcast_to(np.asarray(control, float), (count, len(control), 3))
    while points.shape[1] > 1:
        points = (1 - t) * points[:, :-1] + t * points[:, 1:]
    return points[:, 0]
