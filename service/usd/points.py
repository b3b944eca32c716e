"""Point clouds as UsdGeom.Points.

Source: OpenUSD, UsdGeomPoints: widths are diameters of the points, in scene units; displayColor is scene-linear.
"""

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.depth_cloud import linear_colours
from service.asset.errors import AssetError
from service.requests.export import FIRST_VERSION
from service.usd.files import write_layer
from service.usd.layers import describe_root
from service.usd.materials import define_display_color_material
from service.usd.names import prim_name
from service.usd.primvars import set_primvar
from stage.ply import PointCloud

SUFFIXES = (".usda", ".usdc")
WIDTH_PART = 0.5
"""Width of a point, as a part of the spacing that the points would have if they lay evenly on the sides of their box."""


def write_points(cloud: PointCloud, path: str | Path, *, name: str, provenance: dict[str, str] | None = None) -> None:
    """Write a point cloud as a USD layer, whole or not at all.

    Args:
        cloud: metres; `intensity`, where it has one, becomes the primvar of that name, one float for each point.
        path: .usda or .usdc.
        name: free text; the root prim is named after it.
        provenance: goes into customLayerData.

    Raises:
        AssetError: another suffix, or no point.
        StorageError: the disk refuses.
    """
    target = Path(path)
    if target.suffix.lower() not in SUFFIXES:
        raise AssetError(f"{target} cannot be written as USD points: its suffix must be .usda or .usdc")
    if len(cloud.points) == 0:
        raise AssetError(f"{target} cannot be written as USD points: there is no point")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    width = WIDTH_PART * float(np.linalg.norm(high - low)) / max(len(cloud.points) ** 0.5, 1.0)

    def define(usd_stage: Usd.Stage) -> None:
        UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(usd_stage, 1.0)
        usd_stage.GetRootLayer().documentation = f"{name}: measured points in the world. Where they come from is in customLayerData."
        for key, value in sorted((provenance or {}).items()):
            usd_stage.SetMetadataByDictKey("customLayerData", key, value)
        root = UsdGeom.Xform.Define(usd_stage, Sdf.Path.absoluteRootPath.AppendChild(prim_name(name)))
        usd_stage.SetDefaultPrim(root.GetPrim())
        describe_root(root, name=name, identifier=target.name, version=FIRST_VERSION, provenance=provenance or {})
        prim = define_points(usd_stage, root.GetPath().AppendChild("Points"), cloud.points, np.array([width]), normals=cloud.normals)
        set_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray, linear_colours(cloud.colours))
        if cloud.intensity is not None:
            set_primvar(prim, "intensity", Sdf.ValueTypeNames.FloatArray, cloud.intensity)
        looks = UsdGeom.Scope.Define(usd_stage, root.GetPath().AppendChild("Looks")).GetPath()
        material = define_display_color_material(usd_stage, looks.AppendChild("PointMaterial"))
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
        model = UsdGeom.ModelAPI.Apply(root.GetPrim())
        model.SetExtentsHint(model.ComputeExtentsHint(UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_])))

    write_layer(target, define)


def define_points(usd_stage: Usd.Stage, path: Sdf.Path, points: np.ndarray, widths: np.ndarray, *,
                  normals: np.ndarray | None) -> UsdGeom.Points:
    """Define points at `path`.

    Args:
        usd_stage: the stage.
        path: of the prim.
        points: [n, 3] in scene units.
        widths: [n], or [1] for points of one width.
        normals: [n, 3] unit vectors, or None.
    """
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
