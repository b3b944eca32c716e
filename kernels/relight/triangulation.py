"""The spherical Delaunay triangles of the lights: the faces of the convex hull of their directions.

Two kinds of places get an imaginary light, which hands its energy on. Lights on one circle, as rings have them, leave open how their
polygon is cut into triangles: a light in its middle, shared evenly by the corners, cuts it alike on all sides. And where lights are
missing, below a dome or behind lights on one side, a hull has faces that join lights far apart or that the centre does not see at all:
such a hole gets a light in its middle, shared evenly by its neighbours, and, if need be, more. So every direction lies in one triangle,
and no triangle is an accident.

Source: convex hull by insertion, de Berg et al., "Computational Geometry", chapter 11; imaginary lights after the imaginary
loudspeakers of Zotter and Frank, "All-round ambisonic panning and decoding", JAES 2012.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError

SHIFT = 1e-10
"""Largest random shift of a light along each axis, in the unit of its direction, so that no four lights lie exactly in one plane. It is a
million times the rounding of float64, and less than a light stands out between neighbours a ten-thousandth of a radian away."""
FLAT = 1e-3
"""Lights within this distance of one plane, in the unit of their directions, count as in it; the measured directions of a ring scatter
more."""
BEND = 0.1
"""Faces whose normals differ by less than this part of their radius, in radians, are one polygon: directions that are 15 degrees apart and
measured to half a degree are off their circle by as much."""
HOLE = 3.0
"""A face between lights is a hole when its radius is this many times the median radius of the faces."""
SMALLEST_HOLE_DEGREES = 20.0
"""Least radius of a hole in degrees."""
LARGEST_FACE_DEGREES = 80.0
"""Largest radius of a face's circle, degrees. At 90 degrees the centre would lie in the face; the faces of a regular tetrahedron have 70.5
degrees."""


REMEMBERED = 4
"""Number of sets of lights whose triangles are kept in memory."""
CHUNK = 4096
"""Number of directions that are compared with all faces at one time: it bounds the memory."""


class SphereTriangles(NamedTuple):
    """Triangles that cover the sphere."""

    vertex: np.ndarray  # [vertices, 3] the lights; middles of polygons, in their planes; unit vectors to the middles of holes
    corner: np.ndarray  # [faces, 3] index of a vertex, counterclockwise seen from outside
    neighbour: np.ndarray  # [faces, 3] the face beyond the edge that lies opposite to the corner
    share: np.ndarray  # [vertices, lights] part of a vertex's energy that a light gets; rows sum to one


class _Faces(NamedTuple):
    corner: np.ndarray  # [faces, 3]
    normal: np.ndarray  # [faces, 3] unit vectors, outwards
    height: np.ndarray  # [faces] of the plane over the centre: cosine of the radius of the corners' circle


def triangulate_sphere(directions: np.ndarray) -> SphereTriangles:
    """Return the spherical Delaunay triangles of the lights.

    Args:
        directions: [lights, 3] unit vectors, no two of them closer than a ten-thousandth of a radian.

    Returns:
        The triangles; the centre lies inside their hull.

    Raises:
        ArrayError: fewer than four lights, or all in one plane.
    """
    unit = np.ascontiguousarray(directions, dtype=np.float64)
    return _remembered(unit.tobytes(), len(unit))


@lru_cache(maxsize=REMEMBERED)
def _remembered(directions_bytes: bytes, count: int) -> SphereTriangles:
    """Return the triangles of lights; the result is kept, because every frame and every batch of pixels asks for the same ones."""
    directions = np.frombuffer(directions_bytes).reshape(count, -1)
    random = np.random.default_rng(0)  # a fixed seed, so that the shift is the same each time

    def shifted(unit: np.ndarray) -> np.ndarray:
        return unit + random.uniform(-SHIFT, SHIFT, unit.shape)

    points = shifted(directions)
    faces, rest = _start(points)
    faces = _insert(faces, points, rest)
    largest = np.radians(LARGEST_FACE_DEGREES)
    hole = np.clip(HOLE * np.median(_radius(faces)), np.radians(SMALLEST_HOLE_DEGREES), largest)
    polygons = _polygons(faces, len(directions), hole)
    vertex = np.concatenate([directions, polygons @ directions])
    points = np.concatenate([points, shifted(_unit(vertex[len(directions) :]))])
    faces = _insert(faces, points, range(len(directions), len(points)))
    while True:  # the middle of a hole is far from all vertices, so that this ends
        radius = _radius(faces)
        wide = radius > np.where((faces.corner < len(directions)).all(axis=1), hole, largest)
        if not wide.any():
            break
        a, b, c = _unit(vertex[faces.corner[np.argmax(np.where(wide, radius, 0))]])
        vertex = np.concatenate([vertex, _unit(np.cross(b - a, c - a)[None])])
        points = np.concatenate([points, shifted(vertex[-1:])])
        faces = _insert(faces, points, [len(points) - 1])
    share = _hand_on(faces.corner, np.concatenate([np.eye(len(directions)), polygons]), len(vertex))
    return SphereTriangles(vertex, faces.corner, _neighbours(faces.corner), share)


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


def find_faces(triangles: SphereTriangles, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangle that each of a few directions lies in, on the host.

    Args:
        triangles: that cover the sphere.
        directions: [n, 3] unit vectors.

    Returns:
        [n] faces, and [n, 3] float64 shares of their corners; they sum to one.
    """
    inward, length = edge_planes(triangles)
    face = np.concatenate([np.einsum("sx,fkx->fks", part, inward).min(axis=1).argmax(axis=0)
                           for part in np.array_split(directions, max(1, len(directions) // CHUNK))])
    share = np.maximum(np.einsum("sx,skx->sk", directions, inward[face]), 0) * length[face]
    return face, share / share.sum(axis=1, keepdims=True)



def _start(points: np.ndarray) -> tuple[_Faces, list[int]]:
    """Return a tetrahedron of four points far apart, and the indices of the other points."""
    if len(points) < 4:
        raise ArrayError(f"smooth weighting needs lights in four different places, got {len(points)}: choose cells")
    second = int(np.argmax(np.linalg.norm(points - points[0], axis=1)))
    edge = points[second] - points[0]
    third = int(np.argmax(np.linalg.norm(np.cross(points - points[0], edge), axis=1)))
    normal = np.cross(edge, points[third] - points[0])
    above = (points - points[0]) @ (normal / np.linalg.norm(normal))
    fourth = int(np.argmax(np.abs(above)))
    if abs(above[fourth]) < FLAT:
        raise ArrayError(f"smooth weighting needs lights that are not all in one plane, got {len(points)} that are: choose cells")
    a, b, c = (0, second, third) if above[fourth] < 0 else (0, third, second)
    corner = np.array([[a, b, c], [a, fourth, b], [b, fourth, c], [c, fourth, a]])
    return _planes(points, corner), [i for i in range(len(points)) if i not in (a, b, c, fourth)]


def _planes(points: np.ndarray, corner: np.ndarray) -> _Faces:
    a, b, c = (points[corner[:, k]] for k in range(3))
    normal = _unit(np.cross(b - a, c - a))
    return _Faces(corner, normal, (normal * a).sum(axis=1))


def _insert(faces: _Faces, points: np.ndarray, added: range | list[int]) -> _Faces:
    """Add points one by one that lie outside the hull: the faces that a point sees are replaced by a fan from the point to their
    outline."""
    for index in added:
        seen = faces.normal @ points[index] > faces.height
        away = faces.corner[seen]
        begin, end = away.reshape(-1), np.roll(away, -1, axis=1).reshape(-1)
        outline = ~np.isin(begin * len(points) + end, end * len(points) + begin)  # an inner edge occurs in both directions
        fan = np.stack([begin[outline], end[outline], np.full(int(outline.sum()), index)], axis=1)
        if len(fan) != int(seen.sum()) + 2:  # after Euler; a bug, or lights that defy rounding
            raise ArrayError(f"no triangles were found between {len(points)} lights: choose cells")
        faces = _Faces(*(np.concatenate([old[~seen], new]) for old, new in zip(faces, _planes(points, fan), strict=True)))
    return faces


def _polygons(faces: _Faces, lights: int, hole: float) -> np.ndarray:
    """Return [polygons, lights]: 1 / corners at the corners of each polygon that several faces in one plane form; holes are left out."""
    radius = _radius(faces)
    neighbour = _neighbours(faces.corner)
    bend = np.linalg.norm(faces.normal[:, None] - faces.normal[neighbour], axis=2)
    flat = (bend < BEND * np.minimum(radius[:, None], radius[neighbour])) & (np.maximum(radius[:, None], radius[neighbour]) <= hole)
    polygon, before = np.arange(len(radius)), np.full(len(radius), -1)
    while (polygon != before).any():  # the lowest number of a face spreads over its polygon
        before, polygon = polygon, np.minimum(polygon, np.where(flat, polygon[neighbour], len(radius)).min(axis=1))
    member = np.zeros((len(radius), lights))
    for k in range(3):
        member[polygon, faces.corner[:, k]] = 1
    member = member[member.sum(axis=1) > 3]
    return member / member.sum(axis=1, keepdims=True)


def _radius(faces: _Faces) -> np.ndarray:
    """Return the [faces] angular radius of each face's circumscribed circle, radians."""
    return np.arccos(np.clip(faces.height, -1, 1))


def _neighbours(corner: np.ndarray) -> np.ndarray:
    begin, end = np.roll(corner, -1, axis=1).reshape(-1), np.roll(corner, -2, axis=1).reshape(-1)
    count = int(corner.max()) + 1
    order = np.argsort(end * count + begin)
    return order[np.searchsorted((end * count + begin)[order], begin * count + end)].reshape(-1, 3) // 3


def _hand_on(corner: np.ndarray, share: np.ndarray, vertices: int) -> np.ndarray:
    """Append the shares of the vertices in holes: the mean of their neighbours' shares, of which some may be in holes too."""
    known = len(share)
    beside = np.zeros((vertices, vertices))
    for k in range(3):
        beside[corner[:, k], corner[:, k - 1]] = 1
    passed = beside[known:] / beside[known:].sum(axis=1, keepdims=True)
    return np.concatenate([share, np.linalg.solve(np.eye(vertices - known) - passed[:, known:], passed[:, :known] @ share)])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
