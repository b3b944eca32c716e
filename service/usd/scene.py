"""The prims of an asset of solved maps: below /Name, Geom/Mesh, Looks/Material and Camera.

Source: OpenUSD: UsdGeom (meshes, primvars).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Sdf, Usd, UsdGeom, Vt

from service.asset.mesh import SurfaceMesh
from service.asset.textures import Texture
from service.asset.units import SCALE_NOTE
from service.usd.camera import define_cameras
from service.usd.layers import AssetLayers
from service.usd.materials import define_looks
from stage.maps import SurfaceMaps


def define_asset(layers: AssetLayers, maps: SurfaceMaps, meshes: Sequence[SurfaceMesh], textures: Mapping[str, Texture], *,
                 ior: float, openpbr: Any) -> None:
    """Define the prims of an asset of solved maps.

    Args:
        meshes: the full mesh, then its levels of detail.
        textures: written into the folder that `layers` names.
        ior: index of refraction of the dielectric share of the surface.
        openpbr: MaterialX.Document of the surface, or None.

    Convention:
        The asset is in the camera frame.
    """
    if not maps.camera.metric:
        layers.geometry.GetPrimAtPath(layers.root).SetCustomDataByKey("relit:scale", SCALE_NOTE)
    with layers.geometry_variant("mesh") as geom:
        layers.add_surface(define_mesh(layers.geometry, geom.AppendChild("Mesh"), meshes[0]).GetPath())
    for number, level in enumerate(meshes[1:], start=1):
        with layers.geometry_variant(level_name(number)) as geom:
            layers.add_surface(define_mesh(layers.geometry, geom.AppendChild(level_name(number).capitalize()), level).GetPath())
    UsdGeom.Scope.Define(layers.materials, layers.looks)
    define_looks(layers, textures, ior=ior, openpbr=openpbr)
    define_cameras(layers.geometry, layers.root, maps.camera, meshes[0].extent)


def level_name(number: int) -> str:
    """Return the variant of a level of detail, 1 the finest."""
    return f"lod{number}"


def define_mesh(usd_stage: Usd.Stage, path: Sdf.Path, mesh: SurfaceMesh) -> UsdGeom.Mesh:
    """Define the polygons with normals and texture coordinates."""
    usd_mesh = define_polygons(usd_stage, path, mesh.points, mesh.normals, mesh.face_counts, mesh.face_indices)
    coordinates = UsdGeom.PrimvarsAPI(usd_mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray,
                                                              UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(mesh.st))
    return usd_mesh


def define_polygons(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, normals: np.ndarray, counts: np.ndarray,
                    indices: np.ndarray) -> UsdGeom.Mesh:
    """Define polygons with normals.

    Args:
        points: [V, 3] float32. normals: [V, 3] float32.
        counts: [F] corners of each face. indices: vertex numbers of all corners.
    """
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
