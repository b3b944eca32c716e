"""The two surfaces of a comparison: the scan as points with normals, and the design as triangles in which nearest points are searched."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from kernels.surface.nearest import NearestOnMesh
from service.scans.fusion.fuse import MESH_FILE
from service.scans.fusion.holes import vertex_vectors
from service.scans.points.planes import local_planes, robust_scatter
from service.scans.points.ply_points import PlyPoints, read_ply_faces, read_ply_points
from service.scans.viewpoints import find_viewpoints
from stage.errors import ResultError
from stage.formats.triangles import Triangles, read_triangles, weld, without_empty_faces
from stage.results.result_metadata import result_file

PLY = ".ply"
ON_SURFACE = 1e-6
"""Points nearer than this part of the design's size lie on it: which way they are off is told by the face alone."""
STRAY = 1e-3
ON_EDGE = 1e-5
"""A point lies on the edge across from a corner that has less than this weight."""
NO_VOLUME = 1e-9
"""The least volume of a closed design, in the cube of its size."""
LEAST_SCAN = 100
"""The fewest points of a scan that is compared."""


class ScannedSurface(NamedTuple):
    """The points of a scan in its own frame, metres."""

    points: np.ndarray  # [n, 3] float64
    normals: np.ndarray  # [n, 3] float64, unit, outward
    sigma: np.ndarray  # [n] float64, standard deviation across the surface
    sigma_source: str
    """`measured` (in the file), `declared` (an option) or `estimated` (from the scatter around local planes)."""
    faces: np.ndarray | None  # [f, 3] int; None: it is a set of points
    told: np.ndarray  # [n] bool: the normal is that of the point, and not of the nearest that has one, or fitted to those around

    @property
    def size(self) -> float:
        """The diagonal of the box around the points, metres, without a thousandth of them at each side, as stray ones."""
        return float(np.linalg.norm(np.ptp(np.quantile(self.points, (STRAY, 1 - STRAY), axis=0), axis=0)))


class Offsets(NamedTuple):
    """Points against the design: what is nearest to each, within reach."""

    near: np.ndarray  # [m] int64: the points within reach
    distance: np.ndarray  # [m] float64 metres, positive outside of the design
    across: np.ndarray  # [m, 3] float64: unit vector along which the distance counts, outward
    at: np.ndarray  # [m, 3] float64 metres: the nearest points of the design
    face: np.ndarray  # [m] int32


class Design:
    """The design of a part, metres."""

    def __init__(self, mesh: Triangles, *, device: str) -> None:
        self.points, self.faces = mesh
        corners = self.points[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1)
        self.normals: np.ndarray = normals / length[:, None]
        self.areas: np.ndarray = length / 2
        self.size: float = float(np.linalg.norm(np.ptp(self.points, axis=0)))
        self._corners, self._search = corners, NearestOnMesh(self.points, self.faces, device=device)
        welded = weld(self.points)[1][self.faces]
        start, end = welded[:, [1, 2, 0]], welded[:, [2, 0, 1]]  # the edges across from each corner
        ahead, back = start * np.int64(len(self.points)) + end, end * np.int64(len(self.points)) + start
        self._border: np.ndarray = ~np.isin(ahead, back)
        self._rim: np.ndarray = np.isin(welded, np.concatenate([start[self._border], end[self._border]]))
        middle = corners - self.points.mean(axis=0)
        volume = float(np.einsum("fi,fi->", middle[:, 0], np.cross(middle[:, 1], middle[:, 2]))) / 6
        self.inward: bool = np.array_equal(np.sort(ahead, axis=None), np.sort(back, axis=None)) and volume < NO_VOLUME * self.size**3
        """The faces are closed, but their fronts do not turn outward."""
        self.turned_edges: int = _turned_edges(welded)
        """Number of edges between faces of which one turns its front the other way."""

    def sample(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return points [count, 3] that lie evenly on the surface, always the same, and the faces [count] that they lie on."""
        random = np.random.default_rng(0)
        total = np.cumsum(self.areas)
        face = np.searchsorted(total, (np.arange(count) + random.random(count)) / count * total[-1]).clip(max=len(total) - 1)
        one, other = random.random((2, count))
        root = np.sqrt(one)
        share = np.stack([1 - root, root * (1 - other), root * other], axis=1)
        return np.einsum("nk,nki->ni", share, self._corners[face]), face

    def offsets(self, points: np.ndarray, within: float) -> Offsets:
        """Return where points [n, 3] in the frame of the design lie against it, those that are nearer than `within` metres, and not beyond
        the border of an open surface."""
        found = self._search.search(points, within)
        near = np.flatnonzero(found.face >= 0)
        face, share = found.face[near], found.share[near]
        apart = points[near] - np.einsum("nk,nki->ni", share, self._corners[face])
        aside = np.linalg.norm(apart - (apart * self.normals[face]).sum(axis=1, keepdims=True) * self.normals[face], axis=1)
        ends = (self._border[face] & (share < ON_EDGE)) | (self._rim[face] & (share > 1 - ON_EDGE))
        near = near[~ends.any(axis=1) | (aside <= ON_SURFACE * self.size)]
        face = found.face[near]
        at = np.einsum("nk,nki->ni", found.share[near], self._corners[face])
        apart = points[near] - at
        far = np.linalg.norm(apart, axis=1)
        sign = np.where(found.outside[near], 1.0, -1.0)
        inside = far > ON_SURFACE * self.size
        across = np.where(inside[:, None], apart * (sign / np.maximum(far, 1e-300))[:, None], self.normals[face])
        return Offsets(near, np.where(inside, sign * far, (apart * self.normals[face]).sum(axis=1)), across, at, face)


def _turned_edges(faces: np.ndarray) -> int:
    """Return at how many edges more faces run one way than the other way by two: of consistent surfaces it is one, at a border."""
    a, b, c = np.sort(faces, axis=1).astype(np.int64).T
    count = faces.max() + np.int64(1)
    _, side = np.unique(a * count + b, return_inverse=True)  # numbers, which sort three times as fast as rows
    once = faces[np.unique(side * count + c, return_index=True)[1]].astype(np.int64)
    start, end = once.reshape(-1), np.roll(once, -1, axis=1).reshape(-1)
    _, edge = np.unique(np.minimum(start, end) * count + np.maximum(start, end), return_inverse=True)
    return int((np.abs(np.bincount(edge, np.where(start < end, 1, -1))) > 1).sum())


def read_design(path: Path, unit_m: float, *, device: str) -> Design:
    """Read the design of a part, whose coordinates are in a unit of so many metres."""
    if path.suffix.lower() == PLY:
        ply = read_ply_points(path)
        if not ply.kept.all():
            raise ResultError(f"{path}: has vertices whose coordinates are not finite, or that relit fuse invented to close holes")
        points, faces = ply.points, read_ply_faces(path, ply.kept)
        if faces is None:
            raise ResultError(f"{path}: has no faces: a design is a surface")
        mesh = without_empty_faces(points, faces, path)
    else:
        mesh = read_triangles(path)
    design = Design(mesh._replace(points=mesh.points * unit_m), device=device)
    if design.inward:
        raise ResultError(f"{path}: its faces turn their fronts inward, or both ways: turn them over, so that outside is known")
    return design


def read_scanned(path: Path, unit_m: float, sigma_m: float | None) -> ScannedSurface:
    """Read a scan, whose coordinates are in a unit of so many metres.
    Raises ResultError if it has too few points, or nothing tells which side of it is outside: faces, normals, or that it was all seen from
    one place."""
    file = result_file(path, MESH_FILE, command="relit fuse") if path.is_dir() else path
    if file.suffix.lower() == PLY:
        ply = read_ply_points(file)
        points, normals, sigma, faces = _once(ply, read_ply_faces(file, ply.kept))
        points = points * unit_m
    else:
        points, faces = read_triangles(file)
        points, normals, sigma = points * unit_m, None, None
    if len(points) < LEAST_SCAN:
        raise ResultError(f"{file}: has {len(points)} different points: {LEAST_SCAN} are the fewest that are compared")
    fitted = normals is None and faces is None
    if normals is None:
        normals = _estimated_normals(points, file) if faces is None else vertex_vectors(points, faces)
    normals = np.nan_to_num(normals, posinf=0, neginf=0)
    outward = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    bare = ~outward.any(axis=1)
    if faces is None and bare.any() and not bare.all():  # they face as the nearest point does that has a normal
        outward[bare] = outward[~bare][cKDTree(points[~bare]).query(points[bare])[1]]
    source = "declared" if sigma_m is not None else "measured" if sigma is not None else "estimated"
    if sigma_m is not None:
        spread = np.full(len(points), sigma_m)
    elif sigma is not None:
        if not (np.isfinite(sigma) & (sigma > 0)).all():
            raise ResultError(f"{file}: has a sigma that is not a positive number: give --sigma-m")
        spread = sigma * unit_m
    else:
        near = points - points.mean(axis=0)  # coordinates on a map are too large for floats of 32 bits
        scatter = robust_scatter(local_planes(near.astype(np.float32), origin=np.zeros(3)))
        if not np.isfinite(scatter):
            raise ResultError(f"{file}: its {len(points)} points are too few or too far apart to tell their σ: give --sigma-m")
        spread = np.full(len(points), scatter)
    return ScannedSurface(points, outward, spread, source, faces, ~bare & (not fitted))


def _once(ply: PlyPoints, faces: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Return the points of a file, each place once, with the sums of their normals, their largest σ, and faces [f, 3] between them.
    Vertices at one place are one reading, as where each triangle has corners of its own."""
    kept, place = weld(ply.points)
    normals = sigma = None
    if ply.normals is not None:
        normals = np.zeros((len(kept), 3))
        np.add.at(normals, place, ply.normals)
    if ply.sigma is not None:
        sigma = ply.sigma[kept]
        np.fmax.at(sigma, place, ply.sigma)
    return ply.points[kept], normals, sigma, None if faces is None else place[faces]


def _estimated_normals(points: np.ndarray, file: Path) -> np.ndarray:
    """Return normals of points [n, 3] towards the place from which all of them were seen."""
    found = find_viewpoints([points], [None])
    if found.place is None:
        raise ResultError(f"{file}: has neither faces nor normals, and nothing else says which side of its points is outside: "
                          f"{found.reason}")
    return local_planes(points.astype(np.float32), origin=found.place[0]).normals.astype(np.float64)
