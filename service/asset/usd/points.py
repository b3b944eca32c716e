"""Point clouds as UsdGeom.Points.

Source: OpenUSD, UsdGeomPoints: widths are diameters of the points, in scene units; displayColor is scene-linear.
"""

from pathlib import Path

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from service.asset.content.depth import linear_colours
from service.asset.usd.files import write_layer
from service.asset.usd.layers import define_root, describe_root, prim_name, set_extents_hint
from service.asset.usd.materials import define_display_color_material
from service.asset.usd.scene import define_points, set_primvar
from service.errors import AssetError
from service.requests.export import FIRST_VERSION
from stage.formats.ply import PointCloud

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
        root = define_root(usd_stage, Sdf.Path.absoluteRootPath.AppendChild(prim_name(name)), provenance=provenance, documentation=(
            f"{name}: measured points in the world. Where they come from is in customLayerData."))
        describe_root(root, name=name, identifier=target.name, version=FIRST_VERSION, provenance=provenance or {})
        prim = define_points(usd_stage, root.GetPath().AppendChild("Points"), cloud.points, np.array([width]), normals=cloud.normals)
        set_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray, linear_colours(cloud.colours))
        if cloud.intensity is not None:
            set_primvar(prim, "intensity", Sdf.ValueTypeNames.FloatArray, cloud.intensity)
        looks = UsdGeom.Scope.Define(usd_stage, root.GetPath().AppendChild("Looks")).GetPath()
        material = define_display_color_material(usd_stage, looks.AppendChild("PointMaterial"))
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)
        set_extents_hint(root.GetPrim())

    write_layer(target, define)
