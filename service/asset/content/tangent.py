"""The tangent frame of the exported mesh, and normals expressed in it.

A normal map is read by renderers relative to the frame that they interpolate between the vertices: N, the vertex
normal; T, the direction in which s grows, made perpendicular to N; B = N × T (the convention of MikkTSpace, which
Blender and most DCCs follow). At full resolution a texel lies on its vertex, so that nothing is interpolated.
"""

from typing import NamedTuple

import numpy as np

from service.asset.content.mesh import SurfaceMesh

TRIANGLES = 1 << 18
"""Triangles whose tangents are computed at one time, which bounds the memory."""


class TangentFrame(NamedTuple):
    """The tangent frame of the mesh at the texels of some rows; zero where no vertex is near."""

    tangent: np.ndarray  # [rows, cols, 3] float32, unit, camera frame, towards growing s
    normal: np.ndarray  # [rows, cols, 3] float32, unit, camera frame, the interpolated vertex normal
    covered: np.ndarray  # [rows, cols] bool, True where the frame exists

    def express(self, normal: np.ndarray) -> np.ndarray:
        """Return camera-frame normals [rows, cols, 3] in tangent space: their components along T, B = N × T, and N, float32."""
        found = np.empty(normal.shape, dtype=np.float32)
        found[..., 0], found[..., 2] = np.vecdot(self.tangent, normal), np.vecdot(self.normal, normal)
        t, m = np.moveaxis(self.tangent, -1, 0), np.moveaxis(normal, -1, 0)
        found[..., 1] = sum(self.normal[..., x] * (t[y] * m[z] - t[z] * m[y]) for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)))
        return found


class TangentFrames:
    """The frames that a renderer interpolates over a mesh, at the centres of texels.

    Convention:
        Between the vertices of a mesh with step > 1 the frame is interpolated bilinearly; renderers split the quads
        into triangles, which differs in second order of the step.
    """

    def __init__(self, mesh: SurfaceMesh, shape: tuple[int, int]) -> None:
        """Put the vertices in order for a texture of a shape (rows, cols), which is that of the height map."""
        self._step, self._shape = mesh.step, shape
        self._normals, self._tangents = _grid(mesh.normals, mesh, shape), _grid(vertex_tangents(mesh), mesh, shape)

    def of_rows(self, start: int, stop: int) -> TangentFrame:
        """Return the frames of the texels of rows start … stop - 1."""
        normal, covered = _unit(self._spread(self._normals, start, stop))
        tangent = self._spread(self._tangents, start, stop)
        tangent, _ = _unit(tangent - normal * np.vecdot(tangent, normal)[..., None])
        return TangentFrame(tangent, normal, covered)

    def _spread(self, grid: np.ndarray, start: int, stop: int) -> np.ndarray:
        """Return values of the vertices' grid at every texel of the rows, bilinear between the vertices."""
        if self._step == 1:
            return grid[start:stop]
        for axis, texels in ((0, np.arange(start, stop)), (1, np.arange(self._shape[1]))):
            position = texels / self._step
            low = position.astype(np.int64)
            high = np.minimum(low + 1, grid.shape[axis] - 1)
            weight = np.expand_dims((position - low).astype(np.float32), tuple({0, 1, 2} - {axis}))
            grid = np.take(grid, low, axis=axis) * (1 - weight) + np.take(grid, high, axis=axis) * weight
        return grid


def vertex_tangents(mesh: SurfaceMesh) -> np.ndarray:
    """Return unit tangents ∂P/∂s of the planar texture coordinates, perpendicular to the vertex normals.
    Returns [V, 3] float32. Each triangle adds its direction ∂P/∂s, laid into the plane of the normal and weighted by its angle at the
    vertex.

    Source: Mikkelsen, "Simulation of Wrinkled Surfaces Revisited", 2008, as in mikktspace.c: quads are divided along their shorter diagonal
        in texture space, or in space where both are alike.
    """
    p, st, normals = mesh.points.astype(np.float64), mesh.st.astype(np.float64), mesh.normals.astype(np.float64)
    triangles = np.concatenate([_divided(mesh.quads, p, st), mesh.triangles])
    total = np.zeros_like(p)
    for start in range(0, len(triangles), TRIANGLES):
        corners = triangles[start:start + TRIANGLES]
        a, b, c = corners.T
        st_1, st_2 = st[b] - st[a], st[c] - st[a]
        along_s = (p[b] - p[a]) * st_2[:, 1:] - (p[c] - p[a]) * st_1[:, 1:]
        along_s *= np.sign(st_1[:, :1] * st_2[:, 1:] - st_1[:, 1:] * st_2[:, :1])
        for corner in range(3):
            vertex = corners[:, corner]
            tangent, last, following = (_in_plane(vectors, normals[vertex]) for vectors in (
                along_s, p[corners[:, corner - 1]] - p[vertex], p[corners[:, (corner + 1) % 3]] - p[vertex]))
            angle = np.arccos(np.clip(np.einsum("tx,tx->t", last, following), -1, 1))
            for axis in range(3):
                total[:, axis] += np.bincount(vertex, angle * tangent[:, axis], minlength=len(p))
    return _unit(total)[0].astype(np.float32)


def _divided(quads: np.ndarray, points: np.ndarray, st: np.ndarray) -> np.ndarray:
    a, b, c, d = quads.T
    first, second = (((st[i] - st[k]) ** 2).sum(axis=-1) for i, k in ((a, c), (b, d)))
    alike = ((points[a] - points[c]) ** 2).sum(axis=-1) <= ((points[b] - points[d]) ** 2).sum(axis=-1)
    along_first = ((first < second) | ((first == second) & alike))[:, None]
    return np.concatenate([np.where(along_first, quads[:, [0, 1, 2]], quads[:, [0, 1, 3]]),
                           np.where(along_first, quads[:, [0, 2, 3]], quads[:, [1, 2, 3]])])


def _in_plane(vectors: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return vectors [n, 3] without their part along unit normals, with length one; zero where nothing is left."""
    return _unit(vectors - normals * np.vecdot(vectors, normals)[:, None])[0]


def _grid(values: np.ndarray, mesh: SurfaceMesh, shape: tuple[int, int]) -> np.ndarray:
    """Return vertex values [V, 3] in rows and columns of every step-th pixel; zero where there is no vertex."""
    grid = np.zeros((-(-shape[0] // mesh.step), -(-shape[1] // mesh.step), 3), dtype=np.float32)
    centred = slice(mesh.centred)
    grid[mesh.rows[centred] // mesh.step, mesh.cols[centred] // mesh.step] = values[centred]
    return grid


def _unit(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the vectors with length one, or zero where they were zero, and where they were not zero."""
    length = np.sqrt(np.vecdot(vectors, vectors))
    present = length > 0
    return vectors / np.where(present, length, 1)[..., None], present
