"""The zero surface in the voxels of a brick as triangles, whose vertices lie one on each edge of the lattice that the surface crosses.

A vertex is shared by all triangles around its edge, and known by that edge, so that those of two bricks are the same where these meet. A
cell has triangles if all of its eight corners are measured surface: the surface ends where the data does.
"""

import itertools
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.fusion.bricks import BLOCK, VOXELS
from kernels.fusion.integrate import SURFACE, Volume, Voxels, voxel_number, voxel_position

# The triangles of a cell of eight corners for each of the 256 ways in which these lie inside or outside of a surface.
#
# Corner i has the coordinates (i & 1, i >> 1 & 1, i >> 2 & 1). Edge 4 a + k leads along axis a from the k-th of the four corners whose
# coordinate a is 0. The table is derived, not typed: on each face of the cell, every run of inside corners is cut off by one segment from
# where the boundary of the face leaves the inside to where it enters it. The rule depends on the signs of the face alone, so that two cells
# agree on the face that they share and the surface has no cracks. The segments of a cell close to loops, which are cut into triangles by
# diagonals that do not lie in a face of the cell where that is possible: a diagonal in a face could be one of the other cell too.
#
# Source: Lorensen and Cline, "Marching Cubes: A High Resolution 3D Surface Construction Algorithm", SIGGRAPH 1987; Nielson and Hamann, "The
# Asymptotic Decider", Visualization 1991 (the ambiguous faces, here decided by one rule).
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


SMALLEST = 1.0e-4
"""Least distance of a vertex from the ends of its edge, as a part of its length: triangles keep an area in single precision."""


class Triangles(NamedTuple):
    """The surface in one brick."""

    points: np.ndarray  # [V, 3] float32 metres, in the coordinates of the views
    sigma: np.ndarray  # [V] float32 metres, standard deviation along the normal
    edge: np.ndarray  # [V, 4] int32, lattice coordinates and axis of the edge on which each vertex lies
    faces: np.ndarray  # [F, 3] int32, counter-clockwise seen from outside


@wp.func
def _known(x: int, y: int, z: int, voxels: Voxels) -> int:
    """Return the number of a voxel that is measured surface, else −1."""
    number = voxel_number(x, y, z, voxels.index)
    if number < 0:
        return -1
    if int(voxels.state[number]) != SURFACE:
        return -1
    return number


@wp.kernel(enable_backward=False)
def _count_kernel(first: int, voxels: Voxels, triangles: wp.array(dtype=int),
                  # outputs
                  crossed: wp.array(dtype=wp.uint8), vertices: wp.array(dtype=int), cases: wp.array(dtype=wp.uint8),
                  faces: wp.array(dtype=int)):
    i = first + wp.tid()
    at = voxel_position(i, voxels.place)
    here = _known(at[0], at[1], at[2], voxels)
    bits = wp.int32(0)
    count = wp.int32(0)
    case = wp.int32(0)
    if here >= 0:
        inside = voxels.value[here] < 0.0
        for axis in range(3):
            there = _known(at[0] + wp.where(axis == 0, 1, 0), at[1] + wp.where(axis == 1, 1, 0), at[2] + wp.where(axis == 2, 1, 0),
                           voxels)
            if there >= 0:
                flips = wp.where((voxels.value[there] < 0.0) != inside, 1, 0)
                bits = bits | (flips << axis)
                count += flips
        if wp.max(wp.max(at[0], at[1]), at[2]) < (voxels.index.shape[0] - 1) * BLOCK:
            for corner in range(8):
                if case >= 0:
                    number = _known(at[0] + (corner & 1), at[1] + ((corner >> 1) & 1), at[2] + ((corner >> 2) & 1), voxels)
                    if number < 0:
                        case = wp.int32(-1)
                    elif voxels.value[number] < 0.0:
                        case = case | (1 << corner)
    case = wp.max(case, 0)
    crossed[i] = wp.uint8(bits)
    vertices[i] = count
    cases[i] = wp.uint8(case)
    faces[i] = triangles[case]


@wp.kernel(enable_backward=False)
def _vertex_kernel(first: int, voxels: Voxels, crossed: wp.array(dtype=wp.uint8), start: wp.array(dtype=int),
                   # outputs
                   points: wp.array(dtype=wp.vec3), sigma: wp.array(dtype=float), edge: wp.array(dtype=wp.vec4i)):
    i = first + wp.tid()
    bits = int(crossed[i])
    corner = voxels.corner
    if bits != 0:
        at = voxel_position(i, voxels.place)
        out = start[i]
        for axis in range(3):
            if (bits & (1 << axis)) != 0:
                dx = wp.where(axis == 0, 1, 0)
                dy = wp.where(axis == 1, 1, 0)
                dz = wp.where(axis == 2, 1, 0)
                there = voxel_number(at[0] + dx, at[1] + dy, at[2] + dz, voxels.index)
                t = wp.clamp(voxels.value[i] / (voxels.value[i] - voxels.value[there]), SMALLEST, 1.0 - SMALLEST)
                points[out] = voxels.size * wp.vec3(float(at[0] + corner[0]) + t * float(dx), float(at[1] + corner[1]) + t * float(dy),
                                              float(at[2] + corner[2]) + t * float(dz))
                sigma[out] = (1.0 - t) * wp.sqrt(voxels.variance[i]) + t * wp.sqrt(voxels.variance[there])
                edge[out] = wp.vec4i(at[0] + corner[0], at[1] + corner[1], at[2] + corner[2], axis)
                out += 1


@wp.kernel(enable_backward=False)
def _face_kernel(first: int, voxels: Voxels, crossed: wp.array(dtype=wp.uint8), vertex_start: wp.array(dtype=int),
                 cases: wp.array(dtype=wp.uint8), face_start: wp.array(dtype=int), triangles: wp.array(dtype=int),
                 edges: wp.array(dtype=int), corners: wp.array(dtype=int),
                 # outputs
                 faces: wp.array(dtype=int)):
    i = first + wp.tid()
    case = int(cases[i])
    count = triangles[case]
    if count > 0:
        at = voxel_position(i, voxels.place)
        out = 3 * face_start[i]
        for k in range(3 * count):
            edge = edges[case * 3 * MOST_TRIANGLES + k]
            axis = edge // 4
            corner = corners[edge]
            number = voxel_number(at[0] + (corner & 1), at[1] + ((corner >> 1) & 1), at[2] + ((corner >> 2) & 1), voxels.index)
            bits = int(crossed[number])
            before = bits & ((1 << axis) - 1)
            faces[out + k] = vertex_start[number] + (before & 1) + ((before >> 1) & 1)


def extract(volume: Volume) -> Triangles:
    """Return the zero surface of a brick.

    Convention:
        Waits for the device. Vertices that no triangle has are left out. The cells are those of the brick itself; their vertices on the
        layer behind its last voxel belong to the neighbouring brick, which has them too.
    """
    blocks, voxels = volume.blocks, volume.voxels()
    device, count = blocks.device, blocks.count * VOXELS
    none = Triangles(np.zeros((0, 3), np.float32), np.zeros(0, np.float32), np.zeros((0, 4), np.int32), np.zeros((0, 3), np.int32))
    if count == 0:
        return none
    triangles, edges = (wp.array(table, dtype=int, device=device) for table in cube_table())
    crossed, cases = (wp.empty(count, dtype=wp.uint8, device=device) for _ in range(2))
    vertices, faces = (wp.empty(count, dtype=int, device=device) for _ in range(2))
    devices.launch(_count_kernel, count, [voxels, triangles], [crossed, vertices, cases, faces], device=device)
    vertex_start, vertex_count = _starts(vertices)
    face_start, face_count = _starts(faces)
    if face_count == 0:
        return none
    points = wp.empty(vertex_count, dtype=wp.vec3, device=device)
    sigma = wp.empty(vertex_count, dtype=float, device=device)
    edge = wp.empty(vertex_count, dtype=wp.vec4i, device=device)
    corner_numbers = wp.empty(3 * face_count, dtype=int, device=device)
    devices.launch(_vertex_kernel, count, [voxels, crossed, vertex_start], [points, sigma, edge], device=device)
    devices.launch(_face_kernel, count, [voxels, crossed, vertex_start, cases, face_start, triangles, edges,
                                         wp.array(EDGE_CORNER, dtype=int, device=device)], [corner_numbers], device=device)
    corners = to_numpy(corner_numbers)
    used = np.zeros(vertex_count, dtype=bool)
    used[corners] = True
    renumbered = np.cumsum(used, dtype=np.int32) - 1
    return Triangles(to_numpy(points)[used], to_numpy(sigma)[used], to_numpy(edge)[used], renumbered[corners].reshape(-1, 3))


def _starts(counts: Any) -> tuple[Any, int]:
    """Return the sums of the counts before each, in place, and the sum of all."""
    last = int(to_numpy(counts[-1:])[0])
    starts = wp.empty_like(counts)
    wp.utils.array_scan(counts, starts, inclusive=False)
    return starts, int(to_numpy(starts[-1:])[0]) + last
