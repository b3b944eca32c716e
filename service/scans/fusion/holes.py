"""The holes of a mesh: the closed chains of edges that have a face on one side alone."""

from typing import NamedTuple

import numpy as np

BATCH = 1 << 22
"""The number of faces or edges that are looked at together, which bounds the memory."""


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
    face_areas_m2: np.ndarray  # [F] float64
    open_edges: int
    open_length_m: float
    shared_edges: int
    """Edges with more than two faces."""

    @property
    def area_m2(self) -> float:
        """The area of the mesh."""
        return float(self.face_areas_m2.sum())


def find_holes(points: np.ndarray, faces: np.ndarray) -> Holes:
    """Find the boundaries of a mesh of points [V, 3], metres, and faces [F, 3] that are wound alike."""
    begin, finish, shared = _border(len(points), faces)
    chains = _chains(begin, finish)
    order = np.concatenate([chain for chain, _ in chains] or [[]]).astype(np.int64)
    holes = _measured(points[begin[order]].astype(np.float64), points[finish[order]].astype(np.float64),
                      np.array([len(chain) for chain, _ in chains], dtype=np.int64), [closed for _, closed in chains])
    return Holes(sorted(holes, key=lambda hole: -hole.length_m), _face_areas(points, faces), len(begin),
                 float(sum(hole.length_m for hole in holes)), shared)


def simple_chains(points: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """Return the vertices of each chain around a hole, in the order of the edges of the mesh; a chain that meets itself at a vertex is cut
    there, and one that does not close is left out."""
    begin, finish, _ = _border(len(points), faces)
    found = []
    for chain, closed in _chains(begin, finish):
        walked: list[int] = []
        place: dict[int, int] = {}
        for vertex in begin[chain].tolist() if closed else ():
            if vertex in place:
                loop = walked[place[vertex]:]
                found.append(np.array(loop, dtype=np.int64))
                for other in loop:
                    del place[other]
                del walked[-len(loop):]
            place[vertex] = len(walked)
            walked.append(vertex)
        if walked:
            found.append(np.array(walked, dtype=np.int64))
    return found


def area_vectors(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return for each face the vector along its normal that is twice as long as the face is large, [F, 3] float64."""
    first, second, third = (points[corner].astype(np.float64) for corner in faces.T)
    return np.cross(second - first, third - first)


def vertex_vectors(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return for each vertex the sum of the area vectors of the faces around it, [V, 3] float64; 0 of a vertex without faces."""
    return np.stack([np.bincount(faces.ravel(), np.repeat(column, 3), minlength=len(points)) for column in area_vectors(points, faces).T],
                    axis=1)


def _face_areas(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the area of each face, [F] float64."""
    areas = np.empty(len(faces))
    for start in range(0, len(faces), BATCH):
        areas[start:start + BATCH] = np.linalg.norm(area_vectors(points, faces[start:start + BATCH]), axis=1) / 2
    return areas


def _border(count: int, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the first and last vertices of the edges with one face, and how many edges have more than two."""
    keys = np.empty((3, len(faces)), dtype=np.int64)  # the smaller vertex, the larger, and whether they have changed places
    for edge in range(3):
        start, end = faces[:, edge], faces[:, (edge + 1) % 3]
        keys[edge] = np.minimum(start, end)
        keys[edge] *= count
        keys[edge] += np.maximum(start, end)
        keys[edge] *= 2
        keys[edge] += start > end
    sorted_keys = keys.reshape(-1)
    sorted_keys.sort()  # those of one edge lie side by side
    single, shared = [], 0
    first = 0
    while first < len(sorted_keys):
        last = min(first + BATCH, len(sorted_keys))
        while last < len(sorted_keys) and sorted_keys[last] >> 1 == sorted_keys[last - 1] >> 1:
            last += 1  # no edge is cut
        part = sorted_keys[first:last]
        runs = np.flatnonzero(np.diff(part >> 1, prepend=-1))
        number = np.diff(runs, append=len(part))
        single.append(part[runs[number == 1]])
        shared += int(np.count_nonzero(number > 2))
        first = last
    border = np.concatenate(single) if single else np.zeros(0, dtype=np.int64)
    smaller, larger = (border >> 1) // max(count, 1), (border >> 1) % max(count, 1)
    return np.where(border & 1, larger, smaller), np.where(border & 1, smaller, larger), shared


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


def _measured(a: np.ndarray, b: np.ndarray, edges: np.ndarray, closed: list[bool]) -> list[Hole]:
    """Return the holes whose edges lead from a to b, [n, 3] metres, those of one hole side by side; `edges` [holes] counts them."""
    if len(edges) == 0:
        return []
    first = np.cumsum(edges) - edges
    centre = np.add.reduceat(a, first) / edges[:, None]
    middle = np.repeat(centre, edges, axis=0)
    fan = np.add.reduceat(np.linalg.norm(np.cross(a - middle, b - middle), axis=1), first) / 2
    length = np.add.reduceat(np.linalg.norm(b - a, axis=1), first)
    return [Hole(float(length[k]), float(fan[k]), int(edges[k]), centre[k], closed[k]) for k in range(len(edges))]
