"""Writes solved maps or a measured depth as binary glTF: one .glb file with a mesh or points, their material and the camera."""

from pathlib import Path

import numpy as np
from pygltflib import Primitive

from service.asset.content.depth import UNCERTAINTY, colour_image, colour_warnings, depth_mesh, measured_points, mesh_warnings, photographed
from service.asset.content.metallic import GLASS_IOR, loss_warnings
from service.asset.content.surface import AssetReport, surface_of
from service.asset.gltf.container import Glb, writing_glb
from service.asset.gltf.scene import (
    NORMAL,
    add_attribute,
    add_material,
    add_points,
    add_scene,
    add_surface,
    add_unlit_material,
    camera_warnings,
    check_textures,
    write_textures,
)
from service.requests.export import FIRST_VERSION, Geometry, TextureFormat
from stage.formats.ply import PointCloud
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, version: str = FIRST_VERSION,
                textures: TextureFormat = TextureFormat.PNG16) -> AssetReport:
    """Write solved maps as a .glb file, whole or not at all.
    `name`: free text; the root node, the mesh and the material are named after it. `textures`: the bits of normals, roughness and metallic;
    colours have 8. Raises AssetError for EXR textures, maps without a height layer or without a face, a colour space that is not known, or
    more than the 4 GiB that a .glb can hold. Raises StorageError if the disk refuses; what was there before is left as it was."""
    target = Path(path)
    check_textures(target, textures)
    mesh, look, provenance, unit_m = surface_of(maps)
    with writing_glb(target) as (glb, folder):
        written = write_textures(maps, mesh, folder, look=look, storage=textures)
        material = add_material(glb, written, folder, ior=look.ior if look is not None else GLASS_IOR, name=name)
        surface = add_surface(glb, mesh, unit_m=unit_m, material=material, textured=bool(written), with_tangents=NORMAL in written)
        add_scene(glb, surface, maps.camera, mesh.extent, provenance, name=name, file_name=target.name, version=version, unit_m=unit_m)
    return AssetReport(target, {"mesh": (len(mesh.points), 2 * len(mesh.quads) + len(mesh.triangles))}, mesh.step,
                       {name: texture.clipped_pixels for name, texture in written.items()},
                       (*camera_warnings(maps.camera), *(loss_warnings(look) if look is not None else ())))


def write_depth(
    maps: DepthMaps,
    cloud: PointCloud | None,  # what points.ply holds, or None
    path: str | Path, *,
    name: str,  # free text; the root node and the material are named after it
    geometry: Geometry = Geometry.MESH,  # what the asset is made of; glTF has no variants for both
    version: str = FIRST_VERSION,  # of the asset, kept with the file's name in the extras of `asset`
    textures: TextureFormat = TextureFormat.PNG16,
) -> tuple[str, ...]:
    """Write a depth as a .glb file, whole or not at all, and return sentences on what the asset lacks.
    Raises AssetError for EXR textures, no point, no face for a mesh, a cloud that is not one of this depth, or more than 4 GiB. Raises
    StorageError if the disk refuses; what was there before is left as it was."""
    target = Path(path)
    check_textures(target, textures)
    points = measured_points(maps, cloud)
    mesh = depth_mesh(maps) if geometry is Geometry.MESH else None
    with writing_glb(target) as (glb, folder):
        if mesh is None:
            material = add_unlit_material(glb, name=name, coloured=points.colours is not None)
            primitive, extent = add_points(glb, points.points, points.colours, material=material), points.extent
            _add_uncertainty(glb, primitive, maps, points.rows, points.cols)
        else:
            colours = colour_image(points, maps.mask)
            written = {}
            if colours is not None:
                seen, look = photographed(maps, colours)
                written = write_textures(seen, mesh, folder, look=look, storage=textures)
            material = add_material(glb, written, folder, name=name)
            primitive = add_surface(glb, mesh, unit_m=1.0, material=material, textured=bool(written), with_tangents=False)
            extent = mesh.extent
            _add_uncertainty(glb, primitive, maps, mesh.rows, mesh.cols)
        add_scene(glb, primitive, maps.camera, extent, maps.provenance, name=name, file_name=target.name, version=version)
    told = mesh_warnings(mesh, maps) if mesh is not None else ()
    return (*colour_warnings(points), *told, *camera_warnings(maps.camera))


def _add_uncertainty(glb: Glb, primitive: Primitive, maps: DepthMaps, rows: np.ndarray, cols: np.ndarray) -> None:
    """Add standard deviation (_SIGMA, metres) and confidence (_CONFIDENCE) of each vertex, where the depth has them; 0: unknown."""
    for layer in UNCERTAINTY:
        values = getattr(maps, layer)
        if values is not None:
            add_attribute(glb, primitive, layer, values[rows, cols])
