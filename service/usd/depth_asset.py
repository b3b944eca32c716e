"""Writes a measured depth as a USD asset: a mesh between neighbouring pixels of one surface, or points; with the scene's colours."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from pxr import Sdf, Usd

from service.asset.depth_mesh import depth_mesh
from service.asset.errors import AssetError
from service.requests.export import FIRST_VERSION
from service.usd.camera import define_camera
from service.usd.files import check_suffix, install, temporary_folder_beside
from service.usd.layers import LAYER_FILES, AssetLayers, Description
from service.usd.points import define_points, linear_colours, set_display_color
from service.usd.scene import define_mesh
from stage.depth_maps import DepthMaps
from stage.ply import PointCloud

POINT_WIDTH = 1.5
"""Width of a point in footprints of a pixel: neighbouring points just overlap, corner to corner."""
GREY = 0.5
"""Linear colour where none is known."""


def write_depth_points(maps: DepthMaps, cloud: PointCloud | None, path: str | Path, *, name: str,
                       version: str = FIRST_VERSION) -> None:
    """Write the measured points as a USD asset.

    Args:
        maps: a depth; its points are taken where there is no cloud.
        cloud: what points.ply holds, or None.
        path: .usda, .usdc or .usdz.
        name: free text; the root prim is named after it.
        version: of the asset, for assetInfo.

    Raises:
        AssetError: another suffix, or no point.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    points = cloud.points if cloud is not None else maps.camera.points(-maps.depth)[maps.mask]
    if len(points) == 0:
        raise AssetError("the depth has no point, so there is nothing to export")
    focal = min(maps.camera.focal_px) if maps.camera.focal_px is not None else None
    widths = POINT_WIDTH * (np.abs(points[:, 2]) / focal if focal else np.full(len(points), maps.camera.pixel_size_m or 1.0))
    colours = linear_colours(cloud.colours) if cloud is not None else np.full((1, 3), GREY, np.float32)

    def fill(usd_stage: Usd.Stage, parent: Sdf.Path) -> np.ndarray:
        prim = define_points(usd_stage, parent.AppendChild("Points"), points, widths, normals=None if cloud is None else cloud.normals)
        set_display_color(prim, colours)
        return np.array(prim.GetExtentAttr().Get())

    _write(maps, Path(path), Description(name, maps.camera, maps.provenance, version=version), "points", fill)


def write_depth_mesh(maps: DepthMaps, cloud: PointCloud | None, path: str | Path, *, name: str,
                       version: str = FIRST_VERSION) -> None:
    """Write a depth as a mesh without faces over steps of the depth.

    Args:
        maps: a depth.
        cloud: what points.ply holds, for the colours of its pixels, or None.
        path: .usda, .usdc or .usdz.
        name: free text; the root prim is named after it.
        version: of the asset, for assetInfo.

    Raises:
        AssetError: another suffix, or no face.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    check_suffix(Path(path))
    mesh = depth_mesh(maps)
    colours = np.full((1, 3), GREY, np.float32)
    if cloud is not None and len(cloud.colours) == np.count_nonzero(maps.mask):  # a point a pixel, row by row
        of_pixel = np.zeros((*maps.mask.shape, 3), np.uint8)
        of_pixel[maps.mask] = cloud.colours
        colours = linear_colours(of_pixel[mesh.rows, mesh.cols])

    def fill(usd_stage: Usd.Stage, parent: Sdf.Path) -> np.ndarray:
        set_display_color(define_mesh(usd_stage, parent.AppendChild("Mesh"), mesh), colours)
        return mesh.extent

    _write(maps, Path(path), Description(name, maps.camera, maps.provenance, version=version), "mesh", fill)


def _write(maps: DepthMaps, target: Path, description: Description, variant: str,
           fill: Callable[[Usd.Stage, Sdf.Path], np.ndarray]) -> None:
    """Write the asset around what `fill` defines below /Name/Geom; `fill` returns the extent of that."""
    with temporary_folder_beside(target) as temporary:
        layers = AssetLayers(temporary, target, description)
        with layers.geometry_variant(variant) as geom:
            extent = fill(layers.geometry, geom)
        define_camera(layers.geometry, layers.root.AppendChild("Camera"), maps.camera, extent)
        layers.save()
        first, *others = layers.files
        install(target, first, others, ours=LAYER_FILES)
