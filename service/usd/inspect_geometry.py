"""Facts about the geometry of an asset: the topology of meshes, primvars, points.

Source: OpenUSD: UsdGeomMesh, UsdGeomPoints, UsdGeomPrimvar (interpolation), UsdGeomImageable (purpose).
"""

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom

from service.asset.links import joined

FIRST = Usd.TimeCode.EarliestTime()
"""When an asset with time samples is looked at."""


@dataclass(frozen=True)
class PrimvarFacts:
    """A primvar, the normals among them."""

    name: str
    interpolation: str
    count: int
    """Values, without repetition by indices."""
    low: tuple[float, ...] | None
    """Smallest value of each component; None where the values are no numbers."""
    high: tuple[float, ...] | None


@dataclass(frozen=True)
class MeshFacts:
    """A mesh. A whole height field has one piece and no hole."""

    path: str
    purpose: str
    vertices: int
    faces: int
    pieces: int
    """Parts that no edge joins."""
    boundary_edges: int
    """Edges of one face."""
    non_manifold_edges: int
    """Edges of more than two faces."""
    holes: int
    """Boundaries beyond the outer one of each piece; boundaries that touch in a vertex count as one."""
    primvars: tuple[PrimvarFacts, ...]


@dataclass(frozen=True)
class PointsFacts:
    """A point cloud."""

    path: str
    purpose: str
    points: int
    width_m: tuple[float, float] | None
    """Smallest and largest width."""
    primvars: tuple[PrimvarFacts, ...]


def mesh_facts(mesh: UsdGeom.Mesh) -> MeshFacts:
    """Return the facts about a mesh; faces that name vertices beyond its points are left out of its topology."""
    points = mesh.GetPointsAttr().Get(FIRST)
    counts, indices = (np.array(attribute.Get(FIRST) or [], np.int64) for attribute in (mesh.GetFaceVertexCountsAttr(),
                                                                                   mesh.GetFaceVertexIndicesAttr()))
    vertices = len(points) if points is not None else 0
    if counts.sum() != len(indices) or counts.min(initial=0) < 0 or (len(indices) and (indices.min() < 0 or indices.max() >= vertices)):
        edges, faces_of_edge = np.zeros((0, 2), np.int64), np.zeros(0, np.int64)
    else:
        edges, faces_of_edge = _edges(counts, indices, vertices)
    boundary = edges[faces_of_edge == 1]
    piece = joined(vertices, *edges.T)
    outline = joined(vertices, *boundary.T)
    open_pieces = np.unique(piece[boundary[:, 0]])
    return MeshFacts(str(mesh.GetPath()), _purpose(mesh), vertices, len(counts), len(np.unique(piece[edges[:, 0]])), len(boundary),
                     int((faces_of_edge > 2).sum()), len(np.unique(outline[boundary[:, 0]])) - len(open_pieces), _primvars(mesh))


def points_facts(points: UsdGeom.Points, unit_m: float) -> PointsFacts:
    """Return the facts about points; `unit_m` metres are a scene unit."""
    widths = np.array(points.GetWidthsAttr().Get(FIRST) or [], np.float64) * unit_m
    return PointsFacts(str(points.GetPath()), _purpose(points), len(points.GetPointsAttr().Get(FIRST) or []),
                       (float(widths.min()), float(widths.max())) if len(widths) else None, _primvars(points))


def _purpose(prim: UsdGeom.Imageable) -> str:
    return str(prim.ComputePurpose())


def _edges(counts: np.ndarray, indices: np.ndarray, vertices: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of faces [E, 2], each once, and how many faces have each [E]."""
    ends = np.cumsum(counts)
    following = np.arange(1, len(indices) + 1)
    filled = counts > 0
    following[ends[filled] - 1] = (ends - counts)[filled]
    pair = np.sort(np.stack([indices, indices[following]], axis=-1), axis=-1) if len(indices) else np.zeros((0, 2), np.int64)
    keys, faces = np.unique(pair[:, 0] * max(vertices, 1) + pair[:, 1], return_counts=True)
    return np.stack(np.divmod(keys, max(vertices, 1)), axis=-1), faces


def _primvars(prim: UsdGeom.PointBased) -> tuple[PrimvarFacts, ...]:
    """Return the primvars with a value, and the normals before them."""
    found = []
    normals = prim.GetNormalsAttr().Get(FIRST)
    if normals is not None:
        found.append(_range("normals", str(prim.GetNormalsInterpolation()), normals))
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues():
        found.append(_range(primvar.GetPrimvarName(), str(primvar.GetInterpolation()), primvar.Get(FIRST)))
    return tuple(found)


def _range(name: str, interpolation: str, value: object) -> PrimvarFacts:
    """Return a primvar with the range of each component."""
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        return PrimvarFacts(name, interpolation, len(value) if hasattr(value, "__len__") else 1, None, None)
    if numbers.size == 0:
        return PrimvarFacts(name, interpolation, 0, None, None)
    rows = numbers.reshape(len(numbers), -1) if numbers.ndim else numbers.reshape(1, 1)
    return PrimvarFacts(name, interpolation, len(rows), tuple(map(float, rows.min(axis=0))), tuple(map(float, rows.max(axis=0))))
