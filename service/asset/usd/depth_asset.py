"""Writes a measured depth as a USD asset: a mesh between neighbouring pixels of one surface, and points; with what the scene looks like.

The points of a scan in the world are a layer of their own.

Source: OpenUSD, UsdGeomPoints: widths are diameters of the points, in scene units; displayColor is scene-linear.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from service.asset.content.depth import (
    GREY,
    UNCERTAINTY,
    MeasuredPoints,
    colour_image,
    colour_warnings,
    depth_mesh,
    linear_colours,
    measured_points,
    mesh_warnings,
    photographed,
)
from service.asset.content.mesh import SurfaceMesh
from service.asset.content.textures import write_textures
from service.asset.usd.files import check_textures, write_layer
from service.asset.usd.layers import AssetLayers, Description, define_root, describe_root, prim_name, set_extents_hint
from service.asset.usd.materials import define_display_color_material, define_looks
from service.asset.usd.scene import define_cameras, define_mesh, define_points, set_primvar
from service.asset.usd.surroundings import writing_asset
from service.errors import AssetError
from service.reporting.progress import Progress
from service.requests.export import FIRST_VERSION, Geometry, TextureFormat
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps

POINT_SUFFIXES = (".usda", ".usdc")
WIDTH_PART = 0.5
"""Width of a point, as a part of the spacing that the points would have if they lay evenly on the sides of their box."""


class _Parts(NamedTuple):
    mesh: SurfaceMesh | None  # None: no face, and points were asked for
    points: MeasuredPoints
    point_step: int  # the points are of every point_step-th row and column of pixels
    colours: np.ndarray | None  # [rows, cols, 3] float32 scene-linear Rec.709


def write_depth(maps: DepthMaps, cloud: PointCloud | None, path: str | Path, *, name: str, geometry: Geometry = Geometry.MESH,
                version: str = FIRST_VERSION, textures: TextureFormat = TextureFormat.PNG16,
                progress: Progress | None = None) -> tuple[str, ...]:
    """Write a depth as a USD asset with a mesh, which is cut at breaks of the depth, and the measured points as variants of `geo`.
    Returns sentences on what the asset lacks. Raises AssetError for another suffix, an EXR texture in a .usdz, no point, no face for a mesh
    that is asked for, or a cloud that is not one of this depth. Raises StorageError if the disk refuses; what was there before is left as
    it was.

    Args:
        cloud: what points.ply holds, or None.
        name: free text; the root prim is named after it.
        geometry: the variant that is selected. Beside a mesh with a vertex for every k-th row and column, the points are those of the same
            pixels; without any face there is no mesh beside points.
    """
    target = Path(path)
    check_textures(target, textures)
    parts = _parts(maps, cloud, geometry)
    with writing_asset(target, Description(name, maps.camera, maps.provenance, version=version)) as files:
        layers = files.layers
        UsdGeom.Scope.Define(layers.materials, layers.looks)
        for variant in sorted(Geometry, key=lambda other: other != geometry):
            if variant is Geometry.POINTS:
                _add_points(layers, parts, maps)
            elif parts.mesh is not None:
                _add_mesh(layers, parts.mesh, parts.colours, maps, files.textures, textures, progress)
        define_cameras(layers.geometry, layers.root, maps.camera, parts.points.extent)
        files.beside.extend(sorted(files.textures.iterdir()))
    told = mesh_warnings(parts.mesh, maps) if parts.mesh is not None and geometry is Geometry.MESH else ()
    return (*colour_warnings(parts.points), *told)


def _parts(maps: DepthMaps, cloud: PointCloud | None, geometry: Geometry) -> _Parts:
    points = measured_points(maps, cloud)
    colours = colour_image(points, maps.mask)
    if geometry is Geometry.MESH:
        mesh = depth_mesh(maps)
        return _Parts(mesh, points.every(mesh.step), mesh.step, colours)
    try:
        return _Parts(depth_mesh(maps), points, 1, colours)
    except AssetError:
        return _Parts(None, points, 1, colours)


def _add_mesh(layers: AssetLayers, mesh: SurfaceMesh, colours: np.ndarray | None, maps: DepthMaps, folder: Path,
              storage: TextureFormat, progress: Progress | None) -> None:
    """Define the variant with the mesh, and its looks if its colours are known, whose texture is written into the folder."""
    with layers.geometry_variant(Geometry.MESH) as geom:
        prim = define_mesh(layers.geometry, geom.AppendChild("Mesh"), mesh)
        set_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray, GREY if colours is None else colours[mesh.rows, mesh.cols])
        _set_uncertainty(prim, maps, mesh.rows, mesh.cols)
        layers.add_surface(prim.GetPath())
    if colours is not None:
        seen, look = photographed(maps, colours)
        define_looks(layers, write_textures(seen, mesh, folder, look=look, storage=storage, progress=progress), ior=look.ior)


def _add_points(layers: AssetLayers, parts: _Parts, maps: DepthMaps) -> None:
    """Define the variant with the points, and a material that shows their colours."""
    points, rows, cols, colours, normals = parts.points
    material = define_display_color_material(layers.materials, layers.looks.AppendChild("PointMaterial"))
    with layers.geometry_variant(Geometry.POINTS) as geom:
        prim = define_points(layers.geometry, geom.AppendChild("Points"), points, parts.points.widths(maps.camera, parts.point_step),
                             normals=normals)
        set_primvar(prim, "displayColor", Sdf.ValueTypeNames.Color3fArray, GREY if colours is None else colours)
        _set_uncertainty(prim, maps, rows, cols)
        layers.bind(prim.GetPath(), material)


def _set_uncertainty(prim: UsdGeom.Gprim, maps: DepthMaps, rows: np.ndarray, cols: np.ndarray) -> None:
    """Write standard deviation (metres) and confidence (0…1) of each vertex or point, where the depth has them; 0: of its pixel unknown."""
    for name in UNCERTAINTY:
        values = getattr(maps, name)
        if values is not None:
            set_primvar(prim, name, Sdf.ValueTypeNames.FloatArray, values[rows, cols])


def write_points(cloud: PointCloud, path: str | Path, *, name: str, provenance: dict[str, str] | None = None) -> None:
    """Write a point cloud in metres as a USD layer, .usda or .usdc, whole or not at all.

    The intensity of points, where they have one, becomes the primvar of that name. Raises AssetError for another suffix, or no point.
    Raises StorageError if the disk refuses."""
    target = Path(path)
    if target.suffix.lower() not in POINT_SUFFIXES:
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
