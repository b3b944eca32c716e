"""Writes solved maps as binary glTF: a mesh with textures, a metallic-roughness material and the camera, in one .glb file."""

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pygltflib import Asset, Mesh, Node, Primitive, Scene

from service import __version__
from service.asset.errors import AssetError
from service.asset.mesh import height_mesh
from service.asset.metallic import GLASS_IOR, loss_warnings, metallic_look
from service.asset.units import SCALE_NOTE, unit_in_metres
from service.gltf.camera import camera_and_place, camera_warnings
from service.gltf.container import Glb
from service.gltf.geometry import add_surface
from service.gltf.materials import add_material
from service.gltf.textures import NORMAL, write_textures
from service.requests.export import FIRST_VERSION, TextureFormat
from stage.camera import Camera
from stage.files import replacing
from stage.maps import SurfaceMaps
from stage.result_metadata import result_metadata

Progress = Callable[[str, float], None]
"""Called with the name of the work that begins and the fraction of the whole that is done, 0…1."""

GLTF_VERSION = "2.0"

TEXTURES_START, TEXTURES_END = 0.1, 0.9
"""Fractions of the whole at which the textures begin and end, as measured for 4096 by 4096 pixels."""


class AssetReport(NamedTuple):
    """The file and the sizes of an asset, and what its user should know of it."""

    path: Path
    vertex_count: int
    triangle_count: int
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # texture → pixels that did not fit into 0…1
    warnings: tuple[str, ...]  # sentences


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, version: str = FIRST_VERSION,
                textures: TextureFormat = TextureFormat.PNG16, progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a .glb file, whole or not at all.

    Args:
        maps: with `height`.
        path: the file; missing folders are made.
        name: free text; the root node, the mesh and the material are named after it.
        version: of the asset, kept with the file's name in the extras of `asset`.
        textures: the bits of normals, roughness and metallic; colours have 8.
        progress: called before each part of the work.

    Raises:
        AssetError: EXR textures; no height layer, or no face; a colour space that is not known; more than the 4 GiB that a .glb can hold.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    target = Path(path)
    if textures is TextureFormat.EXR:
        raise AssetError(f"{target} cannot hold EXR textures: a .glb takes PNG; store the textures as png16, or export a .usda or .usdc")
    tell = progress or (lambda what, done: None)
    tell("mesh", 0.0)
    mesh = height_mesh(maps)
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    unit_m = unit_in_metres(maps.camera)
    with replacing(target) as temporary, tempfile.TemporaryDirectory(prefix=f".{target.stem}.", dir=target.parent) as folder:
        glb = Glb()
        written = write_textures(maps, mesh, Path(folder), look=look, storage=textures, progress=lambda name, done: tell(
            f"texture {name}", TEXTURES_START + (TEXTURES_END - TEXTURES_START) * done))
        tell("file", TEXTURES_END)
        material = add_material(glb, written, Path(folder), ior=look.ior if look is not None else GLASS_IOR, name=name)
        surface = add_surface(glb, mesh, unit_m=unit_m, material=material, textured=bool(written), with_tangents=NORMAL in written)
        provenance = {**maps.provenance, "relit:color_space": maps.color_space}
        glb.document.asset = Asset(version=GLTF_VERSION, generator=f"Relit {__version__}",
                                   extras={"identifier": target.name, "version": version})
        add_scene(glb, surface, maps.camera, mesh.extent, provenance, name=name, unit_m=unit_m)
        glb.write(temporary)
    return AssetReport(target, len(mesh.points), 2 * len(mesh.quads) + len(mesh.triangles), mesh.step,
                       {name: texture.clipped_pixels for name, texture in written.items()},
                       (*camera_warnings(maps.camera), *(loss_warnings(look) if look is not None else ())))


def add_scene(glb: Glb, primitive: Primitive, camera: Camera, extent: np.ndarray, provenance: Mapping[str, str], *, name: str,
              unit_m: float) -> None:
    """Add the scene: a root node that stands in the world, and below it the surface and the camera.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, in units of the height map.
        provenance: kept in the extras of the root node, with the camera.
        unit_m: metres of a unit of the height map.

    Convention:
        The camera frame of Relit has the axes of glTF: +x right, +y up, +z towards the viewer. world_from_camera, where the capture gives
        it, is the matrix of the root node, column by column.
    """
    document = glb.document
    extras = result_metadata(camera, provenance)
    if not camera.metric:
        extras["relit:scale"] = SCALE_NOTE
    root = Node(name=name, children=[1, 2], extras=dict(sorted(extras.items())))
    if camera.world_from_camera is not None and not np.array_equal(camera.world_from_camera, np.eye(4)):
        root.matrix = np.array(camera.world_from_camera, dtype=np.float64).T.ravel().tolist()
    lens, place = camera_and_place(camera, extent, unit_m=unit_m)
    document.cameras.append(lens)
    document.meshes.append(Mesh(name=name, primitives=[primitive]))
    document.nodes += [root, Node(name="Mesh", mesh=0), Node(name="Camera", camera=0, translation=place)]
    document.scenes.append(Scene(name=name, nodes=[0]))
    document.scene = 0
