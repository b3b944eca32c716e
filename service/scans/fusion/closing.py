"""Closing of the holes of a mesh: pinholes by fans, others by membranes whose vertices are invented.

The chain of edges around a hole is spanned by the triangles of least area (Barequet and Sharir 1995); a long chain by those of every few of
its vertices, and each stretch between these likewise. Edges of the triangles are halved until none is longer than asked for, two triangles
take the diagonal that parts them better, and each new vertex comes to rest at the mean of its neighbours.

Source: Barequet and Sharir, "Filling gaps in the boundary of a polyhedron", CAGD 1995; Liepa, "Filling holes in meshes", SGP 2003: span,
refine, smooth. His thin plate would bulge out of the open underside of a scan, so that a membrane takes its place.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array
from scipy.sparse.linalg import SuperLU, splu

from service.scans.fusion.holes import simple_chains, vertex_vectors

SPANNED_WHOLE = 64
"""Vertices of a chain up to which all of its triangles are chosen together: the work grows with the third power of their number."""
FINEST_PART = 1 / 64
"""Part of the extent of a hole below which the edges of its membrane need not come."""
MOST_ROUNDS = 200
"""Rounds of halving after which a membrane is left as fine as it is."""


@dataclass(frozen=True)
class Closed:
    """What closes a mesh of V vertices: A further ones, and faces of both."""

    faces: np.ndarray  # [n, 3] int32, wound as those of the mesh; numbers from V on are those of the further vertices
    holes: int
    system: csc_array  # [A, A]: times values at the further vertices it is `around` times those at the vertices of the mesh
    around: csc_array  # [A, V]

    @cached_property
    def _factors(self) -> SuperLU:
        return splu(self.system)

    def extended(self, values: np.ndarray) -> np.ndarray:
        """Return values [V, …] at the vertices of the mesh, with those at the further ones behind them: as smooth as can be, [V + A, …]."""
        flat = values.reshape(len(values), -1).astype(np.float64)
        further = self._factors.solve(self.around @ flat) if self.system.shape[0] else np.zeros((0, flat.shape[1]))
        return np.concatenate([values, further.reshape(len(further), *values.shape[1:]).astype(values.dtype)])


def close_pinholes(points: np.ndarray, faces: np.ndarray, width_m: float) -> Closed:
    """Close the holes of a mesh of points [V, 3] and faces [F, 3] that are nowhere wider than `width_m`, each by a fan around its middle.
    A chain around a speck, whose faces lie inside of it, is no hole."""
    normals = vertex_vectors(points, faces)
    fans: list[np.ndarray] = [np.zeros((0, 3), dtype=np.int64)]
    middles: list[np.ndarray] = []
    holes = 0
    for chain in simple_chains(points, faces):
        corners = points[chain].astype(np.float64)
        inward = np.cross(np.roll(corners, -1, axis=0), corners).sum(axis=0)
        if np.ptp(corners, axis=0).max() > width_m or inward @ normals[chain].sum(axis=0) <= 0:
            continue
        holes += 1
        if len(chain) == 3:
            fans.append(chain[None, ::-1])
        else:
            fans.append(np.stack([np.roll(chain, -1), chain, np.full(len(chain), len(points) + len(middles))], axis=1))
            middles.append(chain)
    row = np.repeat(np.arange(len(middles)), [len(chain) for chain in middles])
    around = coo_array((np.ones(len(row)), (row, np.concatenate([[], *middles]).astype(int))), shape=(len(middles), len(points))).tocsc()
    return Closed(np.concatenate(fans).astype(np.int32), holes, diags_array(around.sum(axis=1), format="csc"), around)


def close_holes(points: np.ndarray, faces: np.ndarray, edge_m: float) -> Closed:
    """Close every hole of a mesh of points [V, 3] and faces [F, 3] by a membrane with edges of about `edge_m`."""
    chains = simple_chains(points, faces)
    first = np.cumsum([0, *map(len, chains)])
    rim = np.concatenate([[], *chains]).astype(np.int64)
    spans = [_span(points[chain].astype(np.float64)) for chain in chains]
    membrane = np.concatenate([np.zeros((0, 3), np.int64), *(span[:, ::-1] + begin for span, begin in zip(spans, first, strict=False))])
    finest = [max(edge_m, FINEST_PART * float(np.ptp(points[chain], axis=0).max())) for chain in chains]
    triangles, count = _refined(points[rim].astype(np.float64), membrane, np.repeat(finest, [len(span) for span in spans]))
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()  # inner edges stand here both ways
    further = start >= len(rim)
    rows, cols = start[further] - len(rim), end[further]
    size = count - len(rim)
    inner = cols >= len(rim)
    joined = coo_array((np.ones(inner.sum()), (rows[inner], cols[inner] - len(rim))), shape=(size, size))
    around = coo_array((np.ones((~inner).sum()), (rows[~inner], rim[cols[~inner]])), shape=(size, len(points))).tocsc()
    system = (diags_array(np.bincount(rows, minlength=size).astype(np.float64)) - joined).tocsc()
    numbers = np.concatenate([rim, len(points) + np.arange(size)])
    return Closed(numbers[triangles].astype(np.int32), len(chains), system, around)


def _span(corners: np.ndarray) -> np.ndarray:
    """Return the triangles of least area over a closed chain of corners [n, 3], as numbers [n - 2, 3] in its order."""
    count = len(corners)
    if count > SPANNED_WHOLE:
        ends = np.linspace(0, count, SPANNED_WHOLE + 1).astype(np.int64)
        stretches = [np.arange(begin, end + 1) % count for begin, end in pairwise(ends) if end - begin > 1]
        return np.concatenate([ends[_span(corners[ends[:-1]])], *(stretch[_span(corners[stretch])] for stretch in stretches)])
    least = np.zeros((count, count))
    apex = np.zeros((count, count), dtype=np.int64)
    for gap in range(2, count):
        begin = np.arange(count - gap)[:, None]
        between, end = begin + np.arange(1, gap), begin + gap
        area = np.linalg.norm(np.cross(corners[between] - corners[begin], corners[end] - corners[begin]), axis=2)
        total = least[begin, between] + least[between, end] + area
        chosen = total.argmin(axis=1)
        rows = np.arange(count - gap)
        least[rows, rows + gap], apex[rows, rows + gap] = total[rows, chosen], rows + 1 + chosen
    triangles, open_edges = [], [(0, count - 1)]
    while open_edges:
        begin_at, end_at = open_edges.pop()
        if end_at - begin_at > 1:
            middle = int(apex[begin_at, end_at])
            triangles.append((begin_at, middle, end_at))
            open_edges += [(begin_at, middle), (middle, end_at)]
    return np.array(triangles, dtype=np.int64)


def _refined(rim: np.ndarray, triangles: np.ndarray, finest: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the triangles [n, 3] over vertices rim [R, 3], on whose border these lie, with inner edges halved that lead from rim to rim or
    are longer than the finest [n] of their triangle, and the number of vertices, of which the new ones stand behind."""
    points = rim
    for _ in range(MOST_ROUNDS):
        edges = _inner_edges(triangles, len(points))
        a, b = triangles[edges.face, edges.corner], triangles[edges.face, (edges.corner + 1) % 3]
        length = np.linalg.norm(points[a] - points[b], axis=1)
        chosen = _apart(edges, np.where(((a < len(rim)) & (b < len(rim))) | (length > finest[edges.face]), length, 0), len(triangles))
        if not len(chosen):
            break
        middle = len(points) + np.arange(len(chosen))
        points = np.concatenate([points, (points[a[chosen]] + points[b[chosen]]) / 2])
        face = np.concatenate([edges.face[chosen], edges.other_face[chosen]])
        corner = np.concatenate([edges.corner[chosen], edges.other_corner[chosen]])
        halves = triangles[face]
        halves[np.arange(len(face)), corner] = np.tile(middle, 2)
        triangles[face, (corner + 1) % 3] = np.tile(middle, 2)
        triangles, finest = np.concatenate([triangles, halves]), np.concatenate([finest, finest[face]])
        triangles = _flipped(points, triangles, len(rim))
    return triangles, len(points)


class _Edges(NamedTuple):
    """Edges with two faces, each as the corner of either face at which it begins."""

    face: np.ndarray  # [E] int64
    corner: np.ndarray
    other_face: np.ndarray
    other_corner: np.ndarray


def _inner_edges(triangles: np.ndarray, count: int) -> _Edges:
    start, end = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    keys = np.minimum(start, end) * count + np.maximum(start, end)
    order = np.argsort(keys, kind="stable")
    first = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    return _Edges(*np.divmod(order[first], 3), *np.divmod(order[first + 1], 3))


def _apart(edges: _Edges, worth: np.ndarray, faces: int) -> np.ndarray:
    """Return the edges of more than no worth that are worth most in both of their faces: no two of them have a face in common."""
    rank = np.empty(len(worth), dtype=np.int64)
    rank[np.argsort(worth, kind="stable")] = np.arange(len(worth))
    best = np.full(faces, -1)
    np.maximum.at(best, edges.face, rank)
    np.maximum.at(best, edges.other_face, rank)
    return np.flatnonzero((worth > 0) & (best[edges.face] == rank) & (best[edges.other_face] == rank))


def _flipped(points: np.ndarray, triangles: np.ndarray, rim: int) -> np.ndarray:
    """Return triangles with the other diagonal of two where the angles across from the edge are together more than half a turn. The other
    diagonal is no edge of the mesh, as it might be between two vertices of the rim."""
    edges = _inner_edges(triangles, len(points))
    a, b, c = (triangles[edges.face, (edges.corner + k) % 3] for k in range(3))
    d = triangles[edges.other_face, (edges.other_corner + 2) % 3]
    angles = _angle(points, c, a, b) + _angle(points, d, a, b)
    held = np.minimum(a, b) * len(points) + np.maximum(a, b)
    wide = np.flatnonzero((angles > np.pi * (1 + 1e-9)) & ((c >= rim) | (d >= rim)))
    edges, a, b, c, d = _Edges(*(each[wide] for each in edges)), a[wide], b[wide], c[wide], d[wide]
    new = np.minimum(c, d) * len(points) + np.maximum(c, d)
    one, other = (np.cross(points[second] - points[first], points[third] - points[first])
                  for first, second, third in ((a, d, c), (d, b, c)))
    sound = ~np.isin(new, held) & (np.einsum("ei,ei->e", one, other) > 0)
    chosen = _apart(edges, np.where(sound, angles[wide], 0), len(triangles))
    chosen = chosen[np.unique(new[chosen], return_index=True)[1]]
    turned = triangles.copy()
    turned[edges.face[chosen]] = np.stack([a, d, c], axis=1)[chosen]
    turned[edges.other_face[chosen]] = np.stack([d, b, c], axis=1)[chosen]
    return turned


def _angle(points: np.ndarray, at: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles [n] at vertices between two others each, radians."""
    first, second = points[one] - points[at], points[other] - points[at]
    return np.arctan2(np.linalg.norm(np.cross(first, second), axis=1), np.einsum("ei,ei->e", first, second))
