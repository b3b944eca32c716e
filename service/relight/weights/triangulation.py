"""The spherical Delaunay triangles of the lights: the faces of the convex hull of their directions.

Two kinds of places get an imaginary light, which hands its energy on. Lights on one circle, as rings have them, leave open how their
polygon is cut into triangles: a light in its middle, shared evenly by the corners, cuts it alike on all sides. And where lights are
missing, below a dome or behind lights on one side, a hull has faces that join lights far apart or that the centre does not see at all:
such a hole gets a light in its middle, shared evenly by its neighbours, and, if need be, more. So every direction lies in one triangle,
and no triangle is an accident.

Source: imaginary lights after the imaginary loudspeakers of Zotter and Frank, "All-round ambisonic panning and decoding", JAES 2012.
"""

import itertools
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from kernels.errors import ArrayError
from kernels.relight.directions.latlong import first_of_equals
from kernels.relight.weights.smooth import SphereTriangles, edge_planes

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


def triangulate_sphere(directions: np.ndarray) -> SphereTriangles:
    """Return the spherical Delaunay triangles of the lights; the centre lies inside their hull.
    `directions`: [lights, 3] unit vectors, no two of them closer than a ten-thousandth of a radian. Raises ArrayError: fewer than four
    lights, or all in one plane."""
    unit = np.ascontiguousarray(directions, dtype=np.float64)
    return _remembered(unit.tobytes(), len(unit))


def triangles_between(directions: np.ndarray) -> SphereTriangles:
    """Return the triangles of lights, of several in one place those of the first (latlong.first_of_equals)."""
    return triangulate_sphere(directions[first_of_equals(directions)])


@lru_cache(maxsize=REMEMBERED)
def _remembered(directions_bytes: bytes, count: int) -> SphereTriangles:
    """Return the triangles of lights; the result is kept, because every frame and every batch of pixels asks for the same ones."""
    directions = np.frombuffer(directions_bytes).reshape(count, -1)
    random = np.random.default_rng(0)  # a fixed seed, so that the shift is the same each time

    def shifted(unit: np.ndarray) -> np.ndarray:
        return unit + random.uniform(-SHIFT, SHIFT, unit.shape)

    points = shifted(directions)
    corner, normal, radius = _faces(points)
    largest = np.radians(LARGEST_FACE_DEGREES)
    hole = np.clip(HOLE * np.median(radius), np.radians(SMALLEST_HOLE_DEGREES), largest)
    polygons = _polygons(corner, normal, radius, hole)
    vertex = np.concatenate([directions, polygons @ directions])
    points = np.concatenate([points, shifted(_unit(vertex[len(directions) :]))])
    while True:  # the middle of a hole is far from all vertices, so that this ends
        corner, _, radius = _faces(points)
        wide = radius > np.where((corner < len(directions)).all(axis=1), hole, largest)
        if not wide.any():
            break
        a, b, c = _unit(vertex[corner[np.argmax(np.where(wide, radius, 0))]])
        vertex = np.concatenate([vertex, _unit(np.cross(b - a, c - a)[None])])
        points = np.concatenate([points, shifted(vertex[-1:])])
    share = _hand_on(corner, np.concatenate([np.eye(len(directions)), polygons]), len(vertex))
    return SphereTriangles(vertex, corner, _neighbours(corner), share)


def find_faces(triangles: SphereTriangles, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles that a few directions [n, 3] lie in, on the host: [n] faces, and [n, 3] float64 shares of their corners."""
    inward, length = edge_planes(triangles)
    face = np.concatenate([np.einsum("sx,fkx->fks", part, inward).min(axis=1).argmax(axis=0)
                           for part in np.array_split(directions, max(1, len(directions) // CHUNK))])
    share = np.maximum(np.einsum("sx,skx->sk", directions, inward[face]), 0) * length[face]
    return face, share / share.sum(axis=1, keepdims=True)


def share_smooth(samples: np.ndarray, energy: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Share the energy [n, channels] of a few samples out over the lights, all in different places, each to the three around it.

    Returns:
        [lights, channels] float64; its sum is that of the samples.
    """
    triangles = triangulate_sphere(directions)
    face, part = find_faces(triangles, samples)
    corner = triangles.corner[face].reshape(-1)
    return np.stack([np.bincount(corner, weights=(part * amount[:, None]).reshape(-1), minlength=len(triangles.vertex)) @ triangles.share
                     for amount in energy.T], axis=1)


def lights_around(directions: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the three lights, of four or more not in one plane, whose triangle each sample lies in.
    Returns [n, 3] int32 lights and [n, 3] float32 shares that sum to one; where lights are missing the nearest stand for the corners."""
    kept, triangles = first_of_equals(directions), triangles_between(directions)
    nearest = kept[np.argmax(triangles.vertex @ directions[kept].T, axis=1)]
    nearest[: len(kept)] = kept
    face, share = find_faces(triangles, samples)
    return nearest[triangles.corner[face]].astype(np.int32), share.astype(np.float32)


def left_out(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lights that each light [lights, 3] would be predicted from if it were missing, and their shares.
    Returns [lights, 3] int32 and [lights, 3] float32. Taken from the neighbours of the light: of the triangles between them that hold
    it, the one whose farthest corner is nearest. Where none holds it, at the rim of a dome, all shares are 0."""
    kept, triangles = first_of_equals(directions), triangles_between(directions)
    real = len(kept)
    around: list[set[int]] = [set() for _ in range(len(triangles.vertex))]
    for corners in triangles.corner:
        for a, b in itertools.permutations(corners.tolist(), 2):
            around[a].add(b)
    lights = np.zeros((len(directions), 3), np.int32)
    shares = np.zeros((len(directions), 3), np.float32)
    for vertex in range(real):
        ring = {other for other in around[vertex] if other < real}
        for imaginary in (other for other in around[vertex] if other >= real):  # replace an imaginary vertex by its real neighbours
            ring |= {other for other in around[imaginary] if other < real and other != vertex}
        triples = np.array(list(itertools.combinations(sorted(ring), 3)), dtype=int).reshape(-1, 3)
        corners = triangles.vertex[triples]
        inverse = np.linalg.pinv(np.swapaxes(corners, 1, 2))
        share = np.einsum("tij,j->ti", inverse, triangles.vertex[vertex])
        farthest = (corners @ triangles.vertex[vertex]).min(axis=1)
        holds = (share.min(axis=1) >= -1e-6) & (np.abs(np.linalg.det(corners)) > 1e-6)
        if holds.any():
            best = int(np.argmax(np.where(holds, farthest, -2)))
            lights[kept[vertex]] = kept[triples[best]]
            shares[kept[vertex]] = np.maximum(share[best], 0) / np.maximum(share[best], 0).sum()
    return lights, shares


def _faces(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the faces of the hull of points in an order that no implementation of the hull changes.
    Returns [faces, 3] corners, counterclockwise seen from outside; [faces, 3] unit normals; and [faces] the angular radius of the circle
    of the corners, radians."""
    if len(points) < 4:
        raise ArrayError(f"smooth weighting needs lights in four different places, got {len(points)}: choose cells")
    across = points - points[0]
    edge = across[np.argmax(np.linalg.norm(across, axis=1))]
    normal = np.cross(edge, across[np.argmax(np.linalg.norm(np.cross(across, edge), axis=1))])
    if np.abs(across @ normal).max() < FLAT * np.linalg.norm(normal):
        raise ArrayError(f"smooth weighting needs lights that are not all in one plane, got {len(points)} that are: choose cells")
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        raise ArrayError(f"no triangles were found between {len(points)} lights: choose cells") from error
    if len(hull.vertices) != len(points):  # lights that defy rounding
        raise ArrayError(f"no triangles were found between {len(points)} lights: choose cells")
    corner = np.asarray(hull.simplices, dtype=np.int64)
    a, b, c = (points[corner[:, k]] for k in range(3))
    inwards = (np.cross(b - a, c - a) * hull.equations[:, :3]).sum(axis=1) < 0
    corner[inwards] = corner[inwards, ::-1]
    corner = np.take_along_axis(corner, (corner.argmin(axis=1)[:, None] + np.arange(3)) % 3, axis=1)  # the lowest number first
    corner = corner[np.lexsort(corner.T[::-1])]
    a, b, c = (points[corner[:, k]] for k in range(3))
    normals = _unit(np.cross(b - a, c - a))
    return corner, normals, np.arccos(np.clip((normals * a).sum(axis=1), -1, 1))


def _polygons(corner: np.ndarray, normal: np.ndarray, radius: np.ndarray, hole: float) -> np.ndarray:
    """Return [polygons, lights]: 1 / corners at the corners of each polygon that several faces in one plane form; holes are left out."""
    neighbour = _neighbours(corner)
    bend = np.linalg.norm(normal[:, None] - normal[neighbour], axis=2)
    flat = (bend < BEND * np.minimum(radius[:, None], radius[neighbour])) & (np.maximum(radius[:, None], radius[neighbour]) <= hole)
    face, side = np.nonzero(flat)
    count, polygon = connected_components(coo_array((np.ones(len(face)), (face, neighbour[face, side])), shape=(len(radius),) * 2))
    member = np.zeros((count, int(corner.max()) + 1))
    member[polygon[:, None], corner] = 1
    member = member[member.sum(axis=1) > 3]
    return member / member.sum(axis=1, keepdims=True)


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
