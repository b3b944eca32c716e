"""The prims of geometry: meshes, points and their primvars.

Source: OpenUSD, UsdGeomMesh, UsdGeomPoints, UsdGeomPrimvar ("Indexed Primvars"): validators ask for indices where a value repeats.
"""

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from service.asset.content.mesh import SurfaceMesh

_ARRAYS = {Sdf.ValueTypeNames.FloatArray: Vt.FloatArray, Sdf.ValueTypeNames.Color3fArray: Vt.Vec3fArray}


def define_mesh(usd_stage: Usd.Stage, path: Sdf.Path, mesh: SurfaceMesh) -> UsdGeom.Mesh:
    """Define the polygons with normals and texture coordinates."""
    usd_mesh = define_polygons(usd_stage, path, mesh.points, mesh.normals, mesh.face_counts, mesh.face_indices)
    coordinates = UsdGeom.PrimvarsAPI(usd_mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray,
                                                              UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(mesh.st))
    return usd_mesh


def define_polygons(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, normals: np.ndarray, counts: np.ndarray,
                    indices: np.ndarray) -> UsdGeom.Mesh:
    """Define polygons with normals, of which `counts` has the corners of each face and `indices` the vertex numbers of all."""
    usd_mesh = UsdGeom.Mesh.Define(usd_stage, path)
    usd_mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    usd_mesh.CreateDoubleSidedAttr(True)
    usd_mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    usd_mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    usd_mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    usd_mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    usd_mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    usd_mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return usd_mesh


def set_primvar(prim: UsdGeom.Gprim, name: str, kind: Sdf.ValueTypeName, values: np.ndarray) -> None:
    """Set a primvar of vertices or points, FloatArray or Color3fArray, or of the whole prim where one value is given."""
    interpolation = UsdGeom.Tokens.constant if len(values) == 1 else UsdGeom.Tokens.vertex
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, kind, interpolation)
    first, index = distinct(values)
    repeated = len(first) < len(values)
    primvar.Set(_ARRAYS[kind].FromNumpy(np.ascontiguousarray(values[first] if repeated else values, dtype=np.float32)))
    if repeated:
        primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))


def distinct(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where each different value stands first, and for each value the number of the one that it equals."""
    columns = values.reshape(len(values), -1).T
    key = np.zeros(len(values), dtype=np.int64)
    for column in columns:  # at most as many keys as values, so that the product of two counts stays below 2^63
        _, part = np.unique(column, return_inverse=True)
        _, key = np.unique(key * (int(part.max(initial=0)) + 1) + part, return_inverse=True)
    _, first, index = np.unique(key, return_index=True, return_inverse=True)
    return first, index


def define_points(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, widths: np.ndarray, *,
                  normals: np.ndarray | None) -> UsdGeom.Points:
    """Define points with widths [n], or [1] for points of one width."""
    prim = UsdGeom.Points.Define(usd_stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, dtype=np.float32)))
    each_width = Vt.FloatArray.FromNumpy(np.broadcast_to(widths, len(points)).astype(np.float32))
    prim.CreateWidthsAttr(each_width)  # one a point: readers that compute an extent give up on one for all
    prim.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    prim.CreateExtentAttr(UsdGeom.Points.ComputeExtent(prim.GetPointsAttr().Get(), each_width))
    if normals is not None:
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, dtype=np.float32)))
        prim.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    return prim
