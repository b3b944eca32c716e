"""Samples of a lat-long map are located among the triangles of the lights, for smooth weighting: each is shared by the three around it.

A ray from the centre meets its triangle's plane in a point, and the shares are that point's barycentric coordinates: never negative, one in
sum, the whole at a light, and the same from both sides of an edge. A sun that moves fades from light to light and never jumps, where cell
weighting keeps it whole on one.

Source: barycentric weights of a direction as in vector base amplitude panning, Pulkki, JAES 1997, here with sum one.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.relight.directions.latlong import SampleGrid

RUN = 64
"""Number of neighbouring samples that one thread locates: it seeks the triangle of the first over the whole sphere, and that of each other
from the sample before."""
BESIDE_RADIANS = 1e-6
"""A direction this many radians beyond an edge counts as on it, because float32 resolves no less; the search can then not go in circles."""


class SphereTriangles(NamedTuple):
    """Triangles that cover the sphere."""

    vertex: np.ndarray  # [vertices, 3] the lights; middles of polygons, in their planes; unit vectors to the middles of holes
    corner: np.ndarray  # [faces, 3] index of a vertex, counterclockwise seen from outside
    neighbour: np.ndarray  # [faces, 3] the face beyond the edge that lies opposite to the corner
    share: np.ndarray  # [vertices, lights] part of a vertex's energy that a light gets; rows sum to one


class Located(NamedTuple):
    """The triangle of each sample of a grid."""

    face: np.ndarray  # [samples] int32
    share: np.ndarray  # [samples, 3] float64 of each of its corners; sums to one


def edge_planes(triangles: SphereTriangles) -> tuple[np.ndarray, np.ndarray]:
    """Return the planes through the centre and the edge opposite to each corner.

    Returns:
        inward: [faces, 3, 3] unit normals: a direction's sine of the angle from each edge is its product with them.
        length: [faces, 3] what that sine is multiplied by to be the corner's coordinate, but for a common factor.
    """
    corners = triangles.vertex[triangles.corner]
    plane = np.cross(np.roll(corners, -1, axis=1), np.roll(corners, -2, axis=1))
    length = np.linalg.norm(plane, axis=2)
    return plane / length[..., None], length


def locate(grid: SampleGrid, triangles: SphereTriangles, rotation: np.ndarray, *, device: str) -> Located:
    """Find the triangle that each sample of a grid lies in when the grid is turned, and where in it; waits for the device.

    The triangles cover the sphere.
    """
    planes, length = edge_planes(triangles)
    inward = (planes @ rotation).reshape(-1, 3)
    rows, cols = len(grid.polar), len(grid.azimuth)
    runs = -(-cols // RUN)
    on_rows = np.stack([np.sin(grid.polar), np.cos(grid.polar)], axis=1)
    on_columns = np.stack([np.sin(grid.azimuth), -np.cos(grid.azimuth)], axis=1)
    face = wp.empty((rows, cols), dtype=wp.int32, device=device)
    depth = wp.empty((rows, cols), dtype=wp.vec3, device=device)
    inputs = [wp.array(on_rows, dtype=wp.vec2, device=device), wp.array(on_columns, dtype=wp.vec2, device=device),
              wp.array(inward, dtype=wp.vec3, device=device), wp.array(triangles.neighbour.reshape(-1), dtype=wp.int32, device=device),
              runs]
    devices.launch(_walk_kernel, rows * runs, inputs, [face, depth], device=device)
    found = to_numpy(face).reshape(-1)
    share = np.maximum(to_numpy(depth).reshape(-1, 3), 0) * length[found]
    return Located(found, share / share.sum(axis=1, keepdims=True))


@wp.func
def walk(direction: wp.vec3, start: int, inward: wp.array(dtype=wp.vec3), neighbour: wp.array(dtype=int)):
    """Return the face that a direction lies in, sought from a face near it, and the sines of its angles from the three edges."""
    here = wp.int32(start)
    a, b, c = float(0.0), float(0.0), float(0.0)
    # across the edge that the direction lies beyond, again and again: on a convex hull every step leads to a face whose plane the
    # ray meets nearer to the centre, so that none comes twice
    for _ in range(inward.shape[0]):
        a = wp.dot(direction, inward[3 * here])
        b = wp.dot(direction, inward[3 * here + 1])
        c = wp.dot(direction, inward[3 * here + 2])
        least = wp.min(a, wp.min(b, c))
        if least >= -BESIDE_RADIANS:
            break
        if least == a:
            here = neighbour[3 * here]
        elif least == b:
            here = neighbour[3 * here + 1]
        else:
            here = neighbour[3 * here + 2]
    return here, wp.vec3(a, b, c)


@wp.kernel(enable_backward=False, module="unique")
def _walk_kernel(first: int,
                 polar: wp.array(dtype=wp.vec2),  # [rows] sine and cosine of the angle from +y
                 equator: wp.array(dtype=wp.vec2),  # [cols] x and z of a direction on the equator
                 inward: wp.array(dtype=wp.vec3),  # [3 · faces] unit normals of the planes of the edges opposite to the corners
                 neighbour: wp.array(dtype=int),  # [3 · faces] face beyond that edge
                 runs: int,  # of one row
                 # outputs
                 face: wp.array2d(dtype=int),  # [rows, cols]
                 depth: wp.array2d(dtype=wp.vec3)):  # [rows, cols] sine of the angle from each edge
    thread = first + wp.tid()
    row = thread / runs
    begin = (thread % runs) * RUN
    here = wp.int32(0)
    for col in range(begin, wp.min(begin + RUN, equator.shape[0])):
        direction = wp.vec3(polar[row][0] * equator[col][0], polar[row][1], polar[row][0] * equator[col][1])
        here, angles = walk(direction, here, inward, neighbour)
        face[row, col] = here
        depth[row, col] = angles
