"""A point cloud as UsdGeom.Points, with intensity."""

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from service.usd.errors import AssetError
from stage.errors import StorageError
from stage.files import replacing
from stage.ply import PointCloud

SUFFIXES = (".usda", ".usdc")
WIDTH_PART = 0.5
"""Of the spacing that the points would have, spread evenly over the sides of their box: what a viewer draws of each."""


def write_points(cloud: PointCloud, path: str | Path, *, name: str, provenance: dict[str, str] | None = None) -> None:
    """Write a point cloud as a USD layer, whole or not at all.

    Args:
        cloud: metres; `intensity`, where it has one, becomes the primvar of that name, a float a point.
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
    with replacing(target) as temporary:
        temporary.unlink()
        try:
            usd_stage = Usd.Stage.CreateNew(str(temporary))
            _define(usd_stage, cloud, name, provenance or {})
            usd_stage.Save()
            del usd_stage
        except Tf.ErrorException as error:
            raise StorageError(f"cannot write {target}: USD could not write it") from error


def _define(usd_stage: Usd.Stage, cloud: PointCloud, name: str, provenance: dict[str, str]) -> None:
    UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(usd_stage, 1.0)
    root = UsdGeom.Xform.Define(usd_stage, Sdf.Path.absoluteRootPath.AppendChild(Tf.MakeValidIdentifier(name)))
    usd_stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root.GetPrim()).SetKind("component")
    for key, value in sorted(provenance.items()):
        usd_stage.SetMetadataByDictKey("customLayerData", key, value)
    prim = UsdGeom.Points.Define(usd_stage, root.GetPath().AppendChild("Points"))
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(cloud.points, dtype=np.float32)))
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    width = WIDTH_PART * float(np.linalg.norm(high - low)) / max(len(cloud.points) ** 0.5, 1.0)
    prim.CreateWidthsAttr(Vt.FloatArray([width]))
    prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    prim.CreateExtentAttr(UsdGeom.Points.ComputeExtent(prim.GetPointsAttr().Get(), prim.GetWidthsAttr().Get())
                          or Vt.Vec3fArray([Gf.Vec3f(*low.tolist()), Gf.Vec3f(*high.tolist())]))
    if cloud.normals is not None:
        prim.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(cloud.normals, dtype=np.float32)))
    variables = UsdGeom.PrimvarsAPI(prim)
    colour = variables.CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex)
    colour.Set(Vt.Vec3fArray.FromNumpy(_linear(cloud.colours)))
    if cloud.intensity is not None:
        intensity = variables.CreatePrimvar("intensity", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
        intensity.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(cloud.intensity, dtype=np.float32)))


def _linear(colours: np.ndarray) -> np.ndarray:
    """displayColor is scene-linear Rec.709: the sRGB decoding of 8-bit colours."""
    value = colours.astype(np.float32) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4).astype(np.float32)
