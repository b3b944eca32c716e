"""A solved height map as a polygon mesh: arrays only, no USD.

One vertex per masked pixel (or every `step`-th one), four-sided faces between neighbours that are all valid, triangles
where three of the four are. Nothing is bridged at full resolution; with a step, gaps narrower than it are. No face leads from one part of
the object to another (layer `part`): nothing was seen of what lies between.
"""

import math
from typing import NamedTuple

import numpy as np

from service.asset.errors import AssetError
from stage.maps import SurfaceMaps

VERTEX_BUDGET = 1_000_000
"""Vertices above which pixels are skipped: what DCC viewports and the web viewer still turn smoothly (some 60 MB)."""

CORNERS = 4
"""A cell of the pixel grid, counter-clockwise seen by the viewer: top left, bottom left, bottom right, top right."""


class SurfaceMesh(NamedTuple):
    """A mesh in the camera frame, wound counter-clockwise as the camera sees it."""

    points: np.ndarray  # [V, 3] float32, camera frame, unit of the height map
    normals: np.ndarray  # [V, 3] float32, unit, area-weighted mean of the adjacent faces
    st: np.ndarray  # [V, 2] float32, texture coordinates, (0, 0) at the lower left corner of the image
    quads: np.ndarray  # [Q, 4] int32, vertex numbers
    triangles: np.ndarray  # [T, 3] int32, vertex numbers
    rows: np.ndarray  # [V] int64, pixel row of each vertex
    cols: np.ndarray  # [V] int64, pixel column of each vertex
    step: int  # every step-th pixel in both directions carries a vertex

    @property
    def face_counts(self) -> np.ndarray:
        """Corners per face, [Q + T] int32: quads first."""
        return np.repeat(np.array([4, 3], dtype=np.int32), [len(self.quads), len(self.triangles)])

    @property
    def face_indices(self) -> np.ndarray:
        """Vertex numbers of the corners of each face, [4 Q + 3 T] int32."""
        return np.concatenate([self.quads.ravel(), self.triangles.ravel()])

    @property
    def extent(self) -> np.ndarray:
        """Lowest and highest corner of the bounding box, [2, 3] float32."""
        return np.stack([self.points.min(axis=0), self.points.max(axis=0)])


def height_mesh(maps: SurfaceMaps, *, vertex_budget: int = VERTEX_BUDGET) -> SurfaceMesh:
    """Return a height map as a mesh.

    Args:
        maps: with `height`; pixels outside the mask, not finite, or not in front of a perspective camera get no vertex.
        vertex_budget: above it only every k-th pixel in both directions is used, with the smallest k that fits.

    Raises:
        AssetError: there is no height layer, or no three neighbouring pixels to span a face.

    Convention:
        st = ((c + 0.5) / W, 1 - (r + 0.5) / H) for the pixel (row r, column c), so that a vertex lies on the centre
        of its own texel.
    """
    if maps.height is None:
        raise AssetError("the maps have no height layer, so there is no surface to export: solve with a height")
    valid_pixels = maps.mask & np.isfinite(maps.height)
    if maps.camera.projection == "perspective":
        valid_pixels &= maps.height < 0
    step = _step(valid_pixels, vertex_budget)
    valid = valid_pixels[::step, ::step]
    quads, triangles = _faces(valid)
    if maps.part is not None:
        part = maps.part[::step, ::step].reshape(-1)
        quads, triangles = (faces[(part[faces] == part[faces[:, :1]]).all(axis=1)] for faces in (quads, triangles))
    if len(quads) + len(triangles) == 0:
        raise AssetError(f"the mask holds {np.count_nonzero(valid_pixels)} pixels with a height and no three of them "
                         "are neighbours, so there is no face to export")

    used = np.zeros(valid.size, dtype=bool)
    used[quads] = True
    used[triangles] = True
    vertex_of_cell = np.cumsum(used, dtype=np.int32) - np.int32(1)
    quads, triangles = vertex_of_cell[quads], vertex_of_cell[triangles]
    rows, cols = (step * index for index in np.nonzero(used.reshape(valid.shape)))

    all_points = maps.camera.points(np.where(valid_pixels, maps.height, 0))
    points = all_points[rows, cols]
    image_rows, image_cols = maps.mask.shape
    st = np.stack([(cols + 0.5) / image_cols, 1 - (rows + 0.5) / image_rows], axis=-1).astype(np.float32)
    return SurfaceMesh(points, _normals(points, quads, triangles), st, quads, triangles, rows, cols, step)


def without_faces(mesh: SurfaceMesh, torn: np.ndarray) -> SurfaceMesh:
    """Return the mesh without some of its faces and without the vertices that only these used.

    Args:
        torn: [Q + T] bool, quads first.

    Raises:
        AssetError: no face is left.
    """
    quads, triangles = mesh.quads[~torn[:len(mesh.quads)]], mesh.triangles[~torn[len(mesh.quads):]]
    if len(quads) + len(triangles) == 0:
        raise AssetError("no neighbouring pixels lie on one surface, so there is no face to export: --geometry points exports them alone")
    used = np.zeros(len(mesh.points), dtype=bool)
    used[quads] = True
    used[triangles] = True
    renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
    quads, triangles = renumbered[quads], renumbered[triangles]
    points = mesh.points[used]
    return SurfaceMesh(points, _normals(points, quads, triangles), mesh.st[used], quads, triangles, mesh.rows[used], mesh.cols[used],
                       mesh.step)


def face_to_vertex(quad_values: np.ndarray, triangle_values: np.ndarray, quads: np.ndarray, triangles: np.ndarray,
                   vertex_count: int) -> np.ndarray:
    """Sum a vector for each face onto the face's corners, and normalise the sums.

    Args:
        quad_values: [Q, 3]. triangle_values: [T, 3].

    Returns:
        [V, 3] float64 unit vectors.
    """
    corners = np.concatenate([quads.ravel(), triangles.ravel()])
    values = np.concatenate([np.repeat(quad_values, 4, axis=0), np.repeat(triangle_values, 3, axis=0)])
    total = np.stack([np.bincount(corners, values[:, axis], minlength=vertex_count) for axis in range(3)], axis=-1)
    return total / np.linalg.norm(total, axis=-1, keepdims=True)


def _step(valid: np.ndarray, vertex_budget: int) -> int:
    """Return the smallest step whose vertices fit the budget."""
    step = max(1, math.isqrt(np.count_nonzero(valid) // vertex_budget))
    while np.count_nonzero(valid[::step, ::step]) > vertex_budget:
        step += 1
    return step


def _faces(valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return quads [Q, 4] and triangles [T, 3] between valid grid points, as flat grid numbers."""
    numbers = np.arange(valid.size).reshape(valid.shape)

    def corners(grid: np.ndarray) -> np.ndarray:
        return np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]])

    number, present = corners(numbers), corners(valid)
    count = present.sum(axis=0)
    quads = number[:, count == CORNERS].T
    triangles = [number[[c for c in range(CORNERS) if c != absent]][:, (count == CORNERS - 1) & ~present[absent]].T
                 for absent in range(CORNERS)]
    return quads, np.concatenate(triangles)


def _normals(points: np.ndarray, quads: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return vertex normals [V, 3] float32: the normalised sums of the area vectors of the adjacent faces."""
    p = points.astype(np.float64)
    quad_area = np.cross(p[quads[:, 2]] - p[quads[:, 0]], p[quads[:, 3]] - p[quads[:, 1]])
    triangle_area = np.cross(p[triangles[:, 1]] - p[triangles[:, 0]], p[triangles[:, 2]] - p[triangles[:, 0]])
    return face_to_vertex(quad_area, triangle_area, quads, triangles, len(points)).astype(np.float32)
