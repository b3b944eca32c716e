"""The nearest points of a mesh of triangles to points in space, and on which side of the mesh these lie.

Source: Baerentzen and Aanaes, "Signed distance computation using the angle weighted pseudonormal", IEEE TVCG 11(3), 2005, as in Warp's mesh
queries.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError


class Nearest(NamedTuple):
    """The nearest point of a mesh to each of n points, on the host."""

    face: np.ndarray  # [n] int32; -1 where no face is near enough
    share: np.ndarray  # [n, 3] float64: the weights of the corners of that face, whose sum is 1
    outside: np.ndarray  # [n] bool: the point lies on the side to which the faces turn their front


@wp.kernel
def _nearest(first: int,
             mesh: wp.uint64,
             points: wp.array(dtype=wp.vec3),
             within: wp.float32,
             # outputs
             face: wp.array(dtype=wp.int32),
             share: wp.array(dtype=wp.vec2),
             side: wp.array(dtype=wp.float32)):
    n = first + wp.tid()
    found = wp.mesh_query_point_sign_normal(mesh, points[n], within)
    face[n] = -1
    share[n] = wp.vec2(0.0, 0.0)
    side[n] = 0.0
    if found.result:
        face[n] = found.face
        share[n] = wp.vec2(found.u, found.v)
        side[n] = found.sign


class NearestOnMesh:
    """A mesh of triangles in which nearest points are searched, within 1e-7 of its size."""

    def __init__(self, points: np.ndarray, faces: np.ndarray, *, device: str) -> None:
        """Build the tree of its faces.
        `points`: [V, 3] float64 of any unit. `faces`: [F, 3] int, counter-clockwise seen from outside; each has an area. Raises ArrayError
        if there is no face, or a face names a point that is not there."""
        if not len(faces) or faces.min() < 0 or faces.max() >= len(points):
            raise ArrayError(f"{len(faces)} faces of {len(points)} points: each needs three of the points")
        self._device = device
        self._middle = (points.min(axis=0) + points.max(axis=0)) / 2
        self._size = float(np.ptp(points, axis=0).max())  # single precision serves for a mesh of size 1 about the origin
        self._mesh = wp.Mesh(points=wp.array(self._scaled(points), dtype=wp.vec3, device=device),
                             indices=wp.array(faces.astype(np.int32).reshape(-1), dtype=wp.int32, device=device))

    def search(self, points: np.ndarray, within: float) -> Nearest:
        """Return the nearest point of the mesh to each of [n, 3] points that is not farther than `within`; waits for the device."""
        count = len(points)
        face = wp.empty(count, dtype=wp.int32, device=self._device)
        share, side = wp.empty(count, dtype=wp.vec2, device=self._device), wp.empty(count, dtype=wp.float32, device=self._device)
        if count:
            given = wp.array(self._scaled(points), dtype=wp.vec3, device=self._device)
            devices.launch(_nearest, count, [self._mesh.id, given, within / self._size], [face, share, side], device=self._device)
        two = to_numpy(share).astype(np.float64)
        return Nearest(to_numpy(face), np.column_stack([two, 1 - two.sum(axis=1)]), to_numpy(side) > 0)

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        return ((points - self._middle) / self._size).astype(np.float32)
