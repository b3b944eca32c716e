"""A mesh of triangles with fewer faces and texture coordinates, as the textured asset of a fusion has it.

The libraries that make it work for minutes without a look at signals, and let no other thread run: they have a process of their own.
"""

import io
import os
import subprocess
import sys
from typing import Any, NamedTuple

import fast_simplification
import numpy as np

from service.asset.content.links import joined
from service.asset.content.mesh import SurfaceMesh, vertex_normals
from service.errors import AssetError

PADDING_TEXELS = 4
"""Texels between charts: bilinear filtering stays clean down to the second mip level."""

APART = 1e-3
"""Part of the way to its faces by which a vertex is moved that several fans of faces shared, so that no two vertices are at one place."""


class UnwrappedMesh(NamedTuple):
    """A mesh whose vertices are split along the seams of its charts."""

    mesh: SurfaceMesh
    place: np.ndarray  # [V] int64, the number of the place at which each vertex lies: alike for those that a seam has split


def unwrapper() -> Any:
    """Return xatlas, which may be not installed."""
    try:
        import xatlas
    except ImportError as error:
        raise AssetError("the textured asset needs xatlas: pip install 'relit[scans]', or give --no-texture") from error
    return xatlas


def textured_mesh(points: np.ndarray, faces: np.ndarray, *, most_faces: int, texture_px: int) -> UnwrappedMesh:
    """Return a mesh of points [V, 3] and faces [F, 3] with fewer faces and texture coordinates in charts that do not overlap.

    Source:
        Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997, as fast-simplification does it; Young,
        xatlas, after Lévy et al., "Least squares conformal maps", SIGGRAPH 2002.
    """
    unwrapper()
    middle, given = points.mean(axis=0), io.BytesIO()
    np.savez(given, places=(points - middle).astype(np.float32), triangles=faces.astype(np.int32), most_faces=most_faces,
             texture_px=texture_px)
    done = subprocess.run([sys.executable, "-P", "-m", __name__], input=given.getvalue(), capture_output=True, start_new_session=True,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))})
    if done.returncode:
        raise AssetError(f"the asset: texture coordinates for {most_faces} faces failed (exit code {done.returncode}): give fewer "
                         "--texture-faces, or --no-texture")
    places, triangles, place, indices, st = np.load(io.BytesIO(done.stdout)).values()
    none = np.zeros((0, 4), dtype=np.int32)
    pixel = np.zeros(len(place), dtype=np.int64)
    world = (places.astype(np.float64) + middle).astype(np.float32)
    normals = _normals(places, triangles)
    mesh = SurfaceMesh(world[place], normals[place], st.astype(np.float32), none, indices.astype(np.int32), pixel, pixel, 1, len(place))
    return UnwrappedMesh(mesh, place.astype(np.int64))


def _unwrap(places: np.ndarray, triangles: np.ndarray, most_faces: int, texture_px: int) -> tuple[np.ndarray, ...]:
    """Return the vertices and faces that are left, and of the unwrapped mesh the number of the place of each vertex, its faces, and st."""
    xatlas = unwrapper()
    if len(triangles) > most_faces:
        places, triangles = fast_simplification.simplify(places, triangles, target_count=most_faces)
    places, triangles = _manifold(places, triangles)
    atlas = xatlas.Atlas()
    atlas.add_mesh(places, triangles.astype(np.uint32))
    pack = xatlas.PackOptions()
    pack.padding, pack.resolution, pack.create_image = PADDING_TEXELS, texture_px, False
    atlas.generate(pack_options=pack)
    return places, triangles, *atlas[0]


def _manifold(places: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces such that edges have at most two faces, wound alike, and vertices one fan; others are left out."""
    corners = places[triangles].astype(np.float64)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    triangles = triangles[area > 0]
    while True:
        start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
        at_edge = np.zeros(len(start), dtype=bool)
        for keys, most in ((np.minimum(start, end) * len(places) + np.maximum(start, end), 2), (start * len(places) + end, 1)):
            _, edge, count = np.unique(keys, return_inverse=True, return_counts=True)
            at_edge |= count[edge.ravel()] > most
        crowded = at_edge.reshape(-1, 3).any(axis=1)
        if not crowded.any():
            break
        triangles = np.delete(triangles, np.flatnonzero(crowded)[-1:], axis=0)
    used, number = np.unique(triangles, return_inverse=True)
    places, triangles = places[used].astype(np.float64), number.reshape(-1, 3).astype(np.int32)
    triangles, source = _one_fan_a_vertex(triangles)
    places = places[source]
    split = np.bincount(source, minlength=len(source))[source] > 1
    centre = np.stack([np.bincount(triangles.ravel(), np.repeat(places[triangles].mean(axis=1)[:, axis], 3), minlength=len(places))
                       for axis in range(3)], axis=-1) / np.bincount(triangles.ravel(), minlength=len(places))[:, None]
    places[split] += APART * (centre - places)[split]
    return places.astype(np.float32), triangles


def _one_fan_a_vertex(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return faces wound alike with a vertex for each fan of faces that hang together by edges, and the old number of every vertex.

    `fans.split_fans` is for faces that lie side by side in an image; in space, a closed fan may touch another at its middle.
    """
    start, end = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    following = np.roll(np.arange(triangles.size).reshape(-1, 3), -1, axis=1).ravel()
    size = int(start.max()) + 1
    order = np.argsort(end * size + start)
    opposite = order[np.minimum(np.searchsorted((end * size + start)[order], start * size + end), len(order) - 1)]
    inner = (start[opposite] == end) & (end[opposite] == start)
    here, there = np.flatnonzero(inner), opposite[inner]
    fan = joined(triangles.size, np.concatenate([here, following[here]]), np.concatenate([following[there], there]))
    _, first, number = np.unique(fan, return_index=True, return_inverse=True)
    return number.reshape(-1, 3).astype(np.int32), start[first]


def _normals(places: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the normals of vertices: those of all faces around each, or of one where these cancel."""
    with np.errstate(invalid="ignore"):
        normals = vertex_normals(places, np.zeros((0, 4), dtype=np.int32), triangles)
    corners = places[triangles].astype(np.float64)
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    own = np.zeros(normals.shape, dtype=np.float32)
    own[triangles.ravel()] = np.repeat(face, 3, axis=0)
    return np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, own)


if __name__ == "__main__":
    asked = np.load(io.BytesIO(sys.stdin.buffer.read()))
    np.savez(sys.stdout.buffer, *_unwrap(asked["places"], asked["triangles"], int(asked["most_faces"]), int(asked["texture_px"])))
