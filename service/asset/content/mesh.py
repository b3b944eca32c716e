"""A solved height map as a polygon mesh: arrays only, no file format.

One vertex per masked pixel (or every `step`-th one), four-sided faces between neighbours that lie on one surface
(service/asset/content/links.py). No face leads across a gap or a break: nothing was seen of what lies between. There the surface goes on
for half a pixel, to the edge of its outermost pixels, so that seen by the camera the mesh covers its pixels and nothing else, and both
sides of a break meet.
"""

import math
from typing import NamedTuple

import numpy as np

from service.asset.content.cells import CORNERS, cell_faces
from service.asset.content.links import Links, height_of, relief, surface_links, touched, without_islands
from service.errors import AssetError
from stage.capture.camera import Camera
from stage.results.depth_breaks import STEEPEST
from stage.results.maps import SurfaceMaps

VERTEX_BUDGET = 1_000_000
"""Vertices above which pixels are skipped: what DCC viewports and the web viewer still turn smoothly (some 60 MB)."""


class SurfaceMesh(NamedTuple):
    """A mesh in the camera frame, wound counter-clockwise as the camera sees it; edges have at most two faces, vertices one fan."""

    points: np.ndarray  # [V, 3] float32, camera frame, unit of the height map
    normals: np.ndarray  # [V, 3] float32, unit, area-weighted mean of the adjacent faces
    st: np.ndarray  # [V, 2] float32, texture coordinates, (0, 0) at the lower left corner of the image
    quads: np.ndarray  # [Q, 4] int32, vertex numbers
    triangles: np.ndarray  # [T, 3] int32, vertex numbers
    rows: np.ndarray  # [V] int64, row of the pixel in which each vertex lies or on whose edge it lies
    cols: np.ndarray  # [V] int64, its column
    step: int  # every step-th pixel in both directions carries a vertex
    centred: int  # so many of the first vertices lie on the centre of their pixel, the others along the border

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


def height_mesh(maps: SurfaceMaps, *, vertex_budget: int = VERTEX_BUDGET, links: Links | None = None) -> SurfaceMesh:
    """Return a height map as a mesh.

    Args:
        maps: with `height`; pixels outside the mask, not finite, or not in front of a perspective camera get no vertex, nor do single
            pixels, lines that are one pixel wide, and islands of a few pixels.
        vertex_budget: above it only every k-th pixel in both directions is used, with the smallest k that fits.
        links: which neighbours lie on one surface; None: those of surface_links.

    Convention:
        st = ((c + 0.5) / W, 1 - (r + 0.5) / H) for the pixel (row r, column c), so that a vertex lies on the centre
        of its own texel.
    """
    valid = valid_heights(maps)
    assert maps.height is not None
    if not _three_neighbours(valid):
        raise AssetError(f"the mask holds {np.count_nonzero(valid)} pixels with a height and no three of them are neighbours, so there is "
                         "no face to export")
    links = without_islands(surface_links(maps, valid) if links is None else links)
    step = _step(touched(links), vertex_budget)
    faces = cell_faces(links, step)
    if len(faces.quads) + len(faces.triangles) == 0:
        raise AssetError("no neighbouring pixels lie on one surface, so there is no face to export: --geometry points exports them alone")
    camera, (rows, cols) = maps.camera, faces.pixel.T
    nearest, other = (relief(maps.height[tuple(pixel.T)].astype(np.float64), camera) for pixel in (faces.pixel, faces.other))
    slope = np.where(faces.weight > 0, np.clip(nearest - other, -STEEPEST, STEEPEST), nearest - other)
    height = np.where(faces.weight == 0, maps.height[rows, cols], height_of(nearest + faces.weight * slope, camera))
    v, u = (faces.pixel + faces.shift + 0.5).T
    points = camera_points(camera, u, v, height)
    st = np.stack([u / camera.width, 1 - v / camera.height], axis=-1).astype(np.float32)
    normals = vertex_normals(points, faces.quads, faces.triangles)
    return SurfaceMesh(points, normals, st, faces.quads, faces.triangles, rows, cols, step, faces.centred)


def camera_points(camera: Camera, u: np.ndarray, v: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Return the camera-frame points [n, 3] float32 at image coordinates u and v [n] with these camera-frame z [n]."""
    x, y = camera.plane_at(u, v)
    if camera.projection == "perspective":
        x, y = -x * height, -y * height
    return np.stack([x, y, height], axis=-1).astype(np.float32)


def valid_heights(maps: SurfaceMaps) -> np.ndarray:
    """Return where the maps have a height in front of the camera: [rows, cols] bool."""
    if maps.height is None:
        raise AssetError("the maps have no height layer, so there is no surface to export: solve with a height")
    valid = maps.mask & np.isfinite(maps.height)
    if maps.camera.projection == "perspective":
        valid &= maps.height < 0
    return valid


def face_to_vertex(quad_values: np.ndarray, triangle_values: np.ndarray, quads: np.ndarray, triangles: np.ndarray,
                   vertex_count: int) -> np.ndarray:
    """Sum a vector for each face, [Q, 3] and [T, 3], onto the face's corners, and return the normalised sums [V, 3] float64."""
    corners = np.concatenate([quads.ravel(), triangles.ravel()])
    values = np.concatenate([np.repeat(quad_values, 4, axis=0), np.repeat(triangle_values, 3, axis=0)])
    total = np.stack([np.bincount(corners, values[:, axis], minlength=vertex_count) for axis in range(3)], axis=-1)
    return total / np.linalg.norm(total, axis=-1, keepdims=True)


def vertex_normals(points: np.ndarray, quads: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return vertex normals [V, 3] float32: the normalised sums of the area vectors of the adjacent faces."""
    p = points.astype(np.float64)
    quad_area = np.cross(p[quads[:, 2]] - p[quads[:, 0]], p[quads[:, 3]] - p[quads[:, 1]])
    triangle_area = np.cross(p[triangles[:, 1]] - p[triangles[:, 0]], p[triangles[:, 2]] - p[triangles[:, 0]])
    return face_to_vertex(quad_area, triangle_area, quads, triangles, len(points)).astype(np.float32)


def _step(pixels: np.ndarray, vertex_budget: int) -> int:
    """Return the smallest step whose vertices fit the budget."""
    step = max(1, math.isqrt(np.count_nonzero(pixels) // vertex_budget))
    while np.count_nonzero(pixels[::step, ::step]) > vertex_budget:
        step += 1
    return step


def _three_neighbours(valid: np.ndarray) -> bool:
    """Return whether three pixels of any 2×2 pixels are valid."""
    count = valid[:-1, :-1].astype(np.uint8) + valid[1:, :-1] + valid[1:, 1:] + valid[:-1, 1:]
    return bool((count >= CORNERS - 1).any())
