"""The holes of a mesh: the closed chains of edges that have a face on one side alone."""

from typing import NamedTuple

import numpy as np


class Hole(NamedTuple):
    """One boundary of a mesh."""

    length_m: float
    area_m2: float
    """The area of the fan from its centre to its edges: how much surface is missing, if the hole is about flat."""
    edges: int
    centre: np.ndarray  # [3] metres
    closed: bool
    """False where the chain of edges ends at a vertex that several boundaries share."""


class Holes(NamedTuple):
    """The boundaries of a mesh, and what the whole of it is."""

    holes: list[Hole]  # the longest first
    area_m2: float
    open_edges: int
    open_length_m: float
    shared_edges: int
    """Edges with more than two faces."""


def face_areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area of each face, [F] float64."""
    return np.asarray(np.linalg.norm(area_vectors(points, faces), axis=1) / 2)


def area_vectors(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return for each face the vector along its normal that is twice as long as the face is large, [F, 3] float64."""
    first, second, third = (points.astype(np.float64, copy=False).T[:, corner] for corner in faces.T)
    (ax, ay, az), (bx, by, bz) = second - first, third - first
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def find_holes(points: np.ndarray, faces: np.ndarray) -> Holes:
    """Find the boundaries of a mesh.

    Args:
        points: [V, 3] metres.
        faces: [F, 3] vertex numbers, wound alike.
    """
    count = np.int64(max(len(points), 1))
    start, end = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel().astype(np.int64)
    # each edge as its two vertices, the smaller first, and whether they have changed places: sorted, those of one edge lie side by side
    keys = np.sort(2 * (np.minimum(start, end) * count + np.maximum(start, end)) + (start > end))
    first = np.flatnonzero(np.diff(keys >> 1, prepend=-1))
    number = np.diff(first, append=len(keys))
    border = keys[first[number == 1]]
    smaller, larger = (border >> 1) // count, (border >> 1) % count
    begin, finish = np.where(border & 1, larger, smaller), np.where(border & 1, smaller, larger)
    lengths = np.linalg.norm(points[finish].astype(np.float64) - points[begin], axis=1)
    holes = [_hole(points, begin[chain], finish[chain], closed) for chain, closed in _chains(begin, finish)]
    return Holes(sorted(holes, key=lambda hole: -hole.length_m), float(face_areas(points, faces).sum()), len(border), float(lengths.sum()),
                 int(np.count_nonzero(number > 2)))


def _chains(begin: np.ndarray, finish: np.ndarray) -> list[tuple[list[int], bool]]:
    """Return the edges of each chain one after another, and whether it closes; every edge is in one chain."""
    leaving: dict[int, list[int]] = {}
    for edge, vertex in enumerate(begin.tolist()):
        leaving.setdefault(vertex, []).append(edge)
    ends = finish.tolist()
    used = np.zeros(len(begin), dtype=bool)
    chains = []
    for first in range(len(begin)):
        if used[first]:
            continue
        chain, edge = [], first
        while True:
            used[edge] = True
            chain.append(edge)
            if ends[edge] == begin[first]:
                chains.append((chain, True))
                break
            options = [other for other in leaving.get(ends[edge], ()) if not used[other]]
            if not options:
                chains.append((chain, False))
                break
            edge = options[0]
    return chains


def _hole(points: np.ndarray, begin: np.ndarray, finish: np.ndarray, closed: bool) -> Hole:
    a, b = points[begin].astype(np.float64), points[finish].astype(np.float64)
    centre = a.mean(axis=0)
    fan = np.linalg.norm(np.cross(a - centre, b - centre), axis=1).sum() / 2
    return Hole(float(np.linalg.norm(b - a, axis=1).sum()), float(fan), len(begin), centre, closed)
