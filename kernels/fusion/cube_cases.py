"""The triangles of a cell of eight corners for each of the 256 ways in which these lie inside or outside of a surface.

Corner i has the coordinates (i & 1, i >> 1 & 1, i >> 2 & 1). Edge 4 a + k leads along axis a from the k-th of the four corners whose
coordinate a is 0. The table is derived, not typed: on each face of the cell, every run of inside corners is cut off by one segment from
where the boundary of the face leaves the inside to where it enters it. The rule depends on the signs of the face alone, so that two cells
agree on the face that they share and the surface has no cracks. The segments of a cell close to loops, which are cut into triangles by
diagonals that do not lie in a face of the cell where that is possible: a diagonal in a face could be one of the other cell too.

Source: Lorensen and Cline, "Marching Cubes: A High Resolution 3D Surface Construction Algorithm", SIGGRAPH 1987; Nielson and Hamann, "The
Asymptotic Decider", Visualization 1991 (the ambiguous faces, here decided by one rule).
"""

import itertools
from functools import cache

import numpy as np

MOST_TRIANGLES = 5
"""Most triangles of a cell; the derivation is checked against it."""

CORNERS = np.array([(i & 1, i >> 1 & 1, i >> 2 & 1) for i in range(8)])
"""[8, 3] coordinates of the corners."""


def _edge_start(axis: int) -> list[int]:
    return [i for i in range(8) if CORNERS[i, axis] == 0]

EDGE_CORNER = np.array([start for axis in range(3) for start in _edge_start(axis)])
"""[12] the corner from which each edge leads along its axis, edge // 4."""


def _edge_between(one: int, other: int) -> int:
    low, axis = min(one, other), (one ^ other).bit_length() - 1
    return 4 * axis + _edge_start(axis).index(low)


def _faces() -> list[list[int]]:
    """Return the corners of the six faces, counter-clockwise seen from outside."""
    faces = []
    for axis in range(3):
        along, up = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            corner = side << axis
            loop = [corner, corner | 1 << along, corner | 1 << along | 1 << up, corner | 1 << up]
            faces.append(loop if side else loop[::-1])
    return faces


def _loops(inside: list[bool]) -> list[list[int]]:
    """Return the loops of edges that the surface crosses, each counter-clockwise seen from outside of it."""
    follows: dict[int, int] = {}
    for face in _faces():
        state = [inside[c] for c in face]
        for k in range(4):
            if state[k] and not state[(k + 1) % 4]:  # the end of a run of inside corners
                start = k
                while state[start - 1]:
                    start -= 1
                follows[_edge_between(face[start], face[start - 1])] = _edge_between(face[k], face[(k + 1) % 4])
    loops = []
    while follows:
        first, at = next(iter(follows.items()))
        del follows[first]
        loop = [first]
        while at != first:
            loop.append(at)
            at = follows.pop(at)
        loops.append(loop)
    return loops


def _in_one_face(one: int, other: int) -> bool:
    ends = [{EDGE_CORNER[e], EDGE_CORNER[e] | 1 << e // 4} for e in (one, other)]
    return any(ends[0] | ends[1] <= set(face) for face in _faces())


def _triangulate(loop: list[int]) -> tuple[int, list[tuple[int, int, int]]]:
    """Return the triangles of a loop with the fewest diagonals in a face of the cell, and their number."""
    if len(loop) == 3:
        return 0, [(loop[0], loop[1], loop[2])]
    best: tuple[int, list[tuple[int, int, int]]] = (len(loop) ** 2, [])
    for k in range(2, len(loop)):  # the triangle on the edge from loop[0] to loop[1]
        cost, triangles = 0, [(loop[0], loop[1], loop[k])]
        for part in (loop[1:k + 1], [loop[0], *loop[k:]]):
            if len(part) > 2:
                more, others = _triangulate(part)
                cost += more + _in_one_face(part[0], part[-1] if part[0] == loop[1] else part[1])
                triangles += others
        if cost < best[0]:
            best = cost, triangles
    return best


@cache
def cube_table() -> tuple[np.ndarray, np.ndarray]:
    """Return the count of triangles of each case, [256] int32, and their edges, [256 × 3 MOST_TRIANGLES] int32, −1 beyond the last.

    Convention:
        Bit i of a case is set where corner i lies inside. Triangles are counter-clockwise seen from outside.
    """
    count, edges = np.zeros(256, dtype=np.int32), np.full((256, 3 * MOST_TRIANGLES), -1, dtype=np.int32)
    for case in range(256):
        inside = [bool(case >> i & 1) for i in range(8)]
        triangles = list(itertools.chain.from_iterable(_triangulate(loop)[1] for loop in _loops(inside)))
        assert len(triangles) <= MOST_TRIANGLES, case
        count[case] = len(triangles)
        edges[case, :3 * len(triangles)] = np.ravel(triangles) if triangles else []
    return count, edges.ravel()
