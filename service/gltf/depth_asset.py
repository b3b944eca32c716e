"""Writes a measured depth as binary glTF: a mesh with the photograph as its texture, or the measured points with their colours."""

from pathlib import Path

import numpy as np
from pygltflib import Primitive

from service.asset.depth_cloud import UNCERTAINTY, MeasuredPoints, colour_image, colour_warnings, measured_points
from service.asset.depth_mesh import depth_mesh, mesh_warnings
from service.asset.mesh import SurfaceMesh
from service.asset.metallic import metallic_look
from service.gltf.camera import camera_warnings
from service.gltf.container import Glb, writing_glb
from service.gltf.geometry import add_attribute, add_points, add_surface
from service.gltf.materials import add_material, add_unlit_material
from service.gltf.scene import add_scene
from service.gltf.textures import check_textures, write_textures
from service.requests.export import FIRST_VERSION, Geometry, TextureFormat
from stage.depth_maps import DepthMaps
from stage.maps import SurfaceMaps
from stage.ply import PointCloud


def write_depth(maps: DepthMaps, cloud: PointCloud | None, path: str | Path, *, name: str, geometry: Geometry = Geometry.MESH,
                version: str = FIRST_VERSION, textures: TextureFormat = TextureFormat.PNG16) -> tuple[str, ...]:
    """Write a depth as a .glb file, whole or not at all.

    Args:
        maps: a depth.
        cloud: what points.ply holds, or None.
        path: the file; missing folders are made.
        name: free text; the root node and the material are named after it.
        geometry: what the asset is made of; glTF has no variants for both.
        version: of the asset, kept with the file's name in the extras of `asset`.
        textures: a .glb has no place for EXR.

    Returns:
        Sentences on what the asset lacks.

    Raises:
        AssetError: EXR textures; no point, or no face for a mesh; a cloud that is not one of this depth; more than 4 GiB.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    target = Path(path)
    check_textures(target, textures)
    points = measured_points(maps, cloud)
    mesh = depth_mesh(maps) if geometry is Geometry.MESH else None
    with writing_glb(target) as (glb, folder):
        if mesh is None:
            material = add_unlit_material(glb, name=name, coloured=points.colours is not None)
            primitive = add_points(glb, points.points, points.colours, material=material)
            _add_uncertainty(glb, primitive, maps, points.rows, points.cols)
            extent = np.stack([points.points.min(axis=0), points.points.max(axis=0)])
        else:
            primitive, extent = _add_mesh(glb, mesh, maps, points, folder, name, textures), mesh.extent
        add_scene(glb, primitive, maps.camera, extent, maps.provenance, name=name, file_name=target.name, version=version)
    told = mesh_warnings(mesh, maps) if mesh is not None else ()
    return (*colour_warnings(points), *told, *camera_warnings(maps.camera))


def _add_mesh(glb: Glb, mesh: SurfaceMesh, maps: DepthMaps, points: MeasuredPoints, folder: Path, name: str,
              storage: TextureFormat) -> Primitive:
    """Add the mesh with its texture, and return its primitive."""
    seen = SurfaceMaps(camera=maps.camera, mask=maps.mask, diffuse_albedo=colour_image(points, maps.mask), color_space="lin_rec709_scene")
    look = metallic_look(seen) if seen.diffuse_albedo is not None else None
    written = write_textures(seen, mesh, folder, look=look, storage=storage)
    material = add_material(glb, written, folder, name=name)
    primitive = add_surface(glb, mesh, unit_m=1.0, material=material, textured=bool(written), with_tangents=False)
    _add_uncertainty(glb, primitive, maps, mesh.rows, mesh.cols)
    return primitive


def _add_uncertainty(glb: Glb, primitive: Primitive, maps: DepthMaps, rows: np.ndarray, cols: np.ndarray) -> None:
    """Add standard deviation (_SIGMA, metres) and confidence (_CONFIDENCE) of each vertex, where the depth has them; 0: unknown."""
    for layer in UNCERTAINTY:
        values = getattr(maps, layer)
        if values is not None:
            add_attribute(glb, primitive, layer, values[rows, cols])
