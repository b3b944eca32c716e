"""Reading of meshes of triangles as programs for design write them: STL, ASCII or binary, and OBJ."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage.errors import ResultError, storage

STL, OBJ = ".stl", ".obj"
STL_HEADER = 84
"""Bytes before the facets of a binary STL file: a comment, and their number."""
FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


class Triangles(NamedTuple):
    """A mesh of triangles in the unit of its file."""

    points: np.ndarray  # [V, 3] float64, each once
    faces: np.ndarray  # [F, 3] int32, counter-clockwise seen from outside, each with an area


def read_triangles(path: Path) -> Triangles:
    """Read a mesh; polygons of an OBJ file become triangles around their first corner, and faces without an area are left out.
    Raises ResultError if the file is no STL or OBJ file, is damaged, or holds no face. Raises StorageError if it cannot be read."""
    if path.suffix.lower() not in (STL, OBJ):
        raise ResultError(f"{path}: is not a mesh that is read: give an STL, OBJ or PLY file; programs for design export STEP as STL")
    with storage("read", path):
        content = path.read_bytes()
    corners = _obj(content, path) if path.suffix.lower() == OBJ else _stl(content, path)
    if not np.isfinite(corners).all():
        raise ResultError(f"{path}: has a coordinate that is not a number")
    points = corners.reshape(-1, 3)
    kept, place = weld(points)
    return without_empty_faces(points[kept], place.reshape(-1, 3), path)


def without_empty_faces(points: np.ndarray, faces: np.ndarray, path: Path) -> Triangles:
    """Return a mesh of points [V, 3] and faces [F, 3] without faces that have no area; ResultError names the file if none is left."""
    sides = points[faces[:, 1:]] - points[faces[:, :1]]
    kept = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) > 0
    if not kept.any():
        raise ResultError(f"{path}: holds no face with an area")
    return Triangles(points, faces[kept].astype(np.int32))


def weld(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which points [n, 3] are the first at their places, [m] int64 in their order, and the number [n] of each point's place among
    these."""
    _, first, place = np.unique(points, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[place.reshape(-1)]


def _stl(content: bytes, path: Path) -> np.ndarray:
    count = int.from_bytes(content[STL_HEADER - 4:STL_HEADER], "little")
    if len(content) >= STL_HEADER + count * FACET.itemsize and (count or content.lstrip()[:5].lower() != b"solid"):
        return np.frombuffer(content, dtype=FACET, count=count, offset=STL_HEADER)["corners"].astype(np.float64)
    if content.lstrip()[:5].lower() != b"solid":
        raise ResultError(f"{path}: is truncated, or no STL file: it announces {count} facets and has {len(content)} bytes")
    lines = [line.split() for line in content.decode("ascii", "replace").lower().splitlines()]
    try:
        corners = np.array([words[1:4] for words in lines if words[:1] == ["vertex"]], dtype=np.float64)
    except ValueError as error:
        raise ResultError(f"{path}: has a vertex that is not three numbers") from error
    if corners.size and corners.shape[1:] != (3,):
        raise ResultError(f"{path}: has a vertex that is not three numbers")
    if corners.size % 9 or not [words for words in lines if words[:1] == ["endsolid"]]:
        raise ResultError(f"{path}: is truncated: its last facet or its endsolid is missing")
    return corners.reshape(-1, 3, 3)


def _obj(content: bytes, path: Path) -> np.ndarray:
    points: list[list[str]] = []
    faces: list[tuple[int, int, int]] = []
    polygons: list[int] = []
    try:
        for words in (line.split() for line in content.decode("utf-8", "replace").splitlines()):
            if words[:1] == ["v"]:
                points.append(words[1:4])
            elif words[:1] == ["f"]:
                polygon = [int(word.partition("/")[0]) for word in words[1:]]
                at = [number - 1 if number > 0 else len(points) + number if number else -1 for number in polygon]
                faces += [(at[0], at[k], at[k + 1]) for k in range(1, len(at) - 1)]
                polygons += [len(polygons)] * (len(at) - 2)
        places = np.array(points, dtype=np.float64).reshape(-1, 3)
    except ValueError as error:
        raise ResultError(f"{path}: has a line that is not understood: {error}") from error
    index = np.array(faces, dtype=np.int64).reshape(-1, 3)
    if index.size and (index.min() < 0 or index.max() >= len(places)):
        raise ResultError(f"{path}: has a face of a vertex that is not there")
    corners = places[index]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    of, whole = np.array(polygons, dtype=np.int64), np.zeros((len(index), 3))
    np.add.at(whole, of, across)
    if (np.einsum("fi,fi->f", across, whole[of]) < -1e-9 * (whole[of] ** 2).sum(axis=1)).any():
        raise ResultError(f"{path}: has a polygon that is not convex: export it as triangles")
    return corners
