"""The prims of an asset: /Name with Geom/Mesh, Looks/Material and Camera, and its metadata.

Source: OpenUSD: UsdModelAPI (kind, names), UsdGeomModelAPI (extentsHint), UsdGeom (axes, units, meshes).
"""

from collections.abc import Mapping

import numpy as np
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from service.asset.mesh import SurfaceMesh
from service.asset.textures import Texture
from service.usd.camera import define_camera
from service.usd.materials import define_material
from stage.camera import Camera
from stage.maps import SurfaceMaps

UNIT_WITHOUT_SCALE_M = 0.001
"""Metres of a pixel where the capture has no scale, so that the asset has a visible size."""

SCALE_NOTE = "unknown: the capture gives no scale, so one pixel is taken as one millimetre"


def define_asset(usd_stage: Usd.Stage, maps: SurfaceMaps, mesh: SurfaceMesh, textures: Mapping[str, Texture], *,
                 name: str, texture_folder: str) -> None:
    """Define the prims of an asset on an empty USD stage.

    Args:
        textures: written beside the layer, in texture_folder ("./…").
        name: free text; the root prim is named after it, with other characters than letters, digits and _ replaced.

    Convention:
        The asset is in the camera frame; world_from_camera, where the capture gives it, is the root's transform.
    """
    unit_m = 1.0 if maps.camera.metric else UNIT_WITHOUT_SCALE_M
    root = define_root(usd_stage, maps.camera, {**maps.provenance, "relit:color_space": maps.color_space}, name=name, unit_m=unit_m)
    if not maps.camera.metric:
        root.GetPrim().SetCustomDataByKey("relit:scale", SCALE_NOTE)
    path = root.GetPath()
    UsdGeom.Scope.Define(usd_stage, path.AppendChild("Geom"))
    usd_mesh = define_mesh(usd_stage, path.AppendPath("Geom/Mesh"), mesh)
    UsdGeom.Scope.Define(usd_stage, path.AppendChild("Looks"))
    material = define_material(usd_stage, path.AppendPath("Looks/Material"), textures, texture_folder)
    UsdShade.MaterialBindingAPI.Apply(usd_mesh.GetPrim()).Bind(material)
    define_camera(usd_stage, path.AppendChild("Camera"), maps.camera, mesh.extent)
    hint_extent(root)


def define_root(usd_stage: Usd.Stage, camera: Camera, provenance: Mapping[str, str], *, name: str, unit_m: float) -> UsdGeom.Xform:
    """Define axes, unit and the root prim with its metadata, and return that prim.

    Args:
        camera: its world_from_camera becomes the root's transform.
        provenance: kept in customLayerData, with the camera.
        name: free text; the root prim is named after it.
        unit_m: metres of a scene unit.
    """
    UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(usd_stage, unit_m)
    root = UsdGeom.Xform.Define(usd_stage, Sdf.Path.absoluteRootPath.AppendChild(Tf.MakeValidIdentifier(name)))
    usd_stage.SetDefaultPrim(root.GetPrim())
    _describe(usd_stage, root.GetPrim(), camera, provenance, name)
    if camera.world_from_camera is not None:
        root.AddTransformOp().Set(_matrix(camera.world_from_camera, unit_m))
    return root


def hint_extent(root: UsdGeom.Xform) -> None:
    """Write the bounding box of everything below the root, for readers that do not load it."""
    model = UsdGeom.ModelAPI.Apply(root.GetPrim())
    model.SetExtentsHint(model.ComputeExtentsHint(UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])))


def _describe(usd_stage: Usd.Stage, root: Usd.Prim, camera: Camera, provenance: Mapping[str, str], name: str) -> None:
    """Write kind, names and provenance."""
    model = Usd.ModelAPI(root)
    model.SetKind(Kind.Tokens.component)
    model.SetAssetName(name)
    if root.GetName() != name and name:
        root.SetDisplayName(name)
    method = provenance.get("relit:method")
    usd_stage.GetRootLayer().documentation = (
        f"{name}: a measured surface, exported by Relit{f' (method {method})' if method else ''}. Camera frame: "
        "+x right, +y up, +z towards the viewer. Where it comes from is in customLayerData.")
    known = {**provenance, "relit:camera": camera.model_dump_json()}
    for key, value in sorted(known.items()):
        usd_stage.SetMetadataByDictKey("customLayerData", key, value)


def define_mesh(usd_stage: Usd.Stage, path: Sdf.Path, mesh: SurfaceMesh) -> UsdGeom.Mesh:
    """Define the polygons with normals and texture coordinates."""
    usd_mesh = UsdGeom.Mesh.Define(usd_stage, path)
    usd_mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    usd_mesh.CreateDoubleSidedAttr(True)
    usd_mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.points))
    usd_mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(mesh.face_counts))
    usd_mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.face_indices))
    usd_mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(mesh.extent))
    usd_mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(mesh.normals))
    usd_mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    coordinates = UsdGeom.PrimvarsAPI(usd_mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray,
                                                              UsdGeom.Tokens.vertex)
    coordinates.Set(Vt.Vec2fArray.FromNumpy(mesh.st))
    return usd_mesh


def _matrix(world_from_camera: tuple[tuple[float, ...], ...], unit_m: float) -> Gf.Matrix4d:
    """Return a column-vector transform in metres as USD's row-vector transform in scene units."""
    matrix = np.array(world_from_camera, dtype=np.float64)
    matrix[:3, 3] /= unit_m
    return Gf.Matrix4d(*matrix.T.ravel().tolist())
