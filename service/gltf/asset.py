"""Writes solved maps as binary glTF: a mesh with textures, a metallic-roughness material and the camera, in one .glb file."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from service.asset.mesh import height_mesh
from service.asset.metallic import GLASS_IOR, loss_warnings, metallic_look
from service.asset.units import unit_in_metres
from service.gltf.camera import camera_warnings
from service.gltf.container import writing_glb
from service.gltf.geometry import add_surface
from service.gltf.materials import add_material
from service.gltf.scene import add_scene
from service.gltf.textures import NORMAL, check_textures, write_textures
from service.requests.export import FIRST_VERSION, TextureFormat
from stage.maps import SurfaceMaps

Progress = Callable[[str, float], None]
"""Called with the name of the work that begins and the fraction of the whole that is done, 0…1."""

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

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Vertices and faces of the mesh."""
        return {"mesh": (self.vertex_count, self.triangle_count)}


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
    check_textures(target, textures)
    tell = progress or (lambda what, done: None)
    tell("mesh", 0.0)
    mesh = height_mesh(maps)
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    unit_m = unit_in_metres(maps.camera)
    with writing_glb(target) as (glb, folder):
        written = write_textures(maps, mesh, folder, look=look, storage=textures, progress=lambda name, done: tell(
            f"texture {name}", TEXTURES_START + (TEXTURES_END - TEXTURES_START) * done))
        tell("file", TEXTURES_END)
        material = add_material(glb, written, folder, ior=look.ior if look is not None else GLASS_IOR, name=name)
        surface = add_surface(glb, mesh, unit_m=unit_m, material=material, textured=bool(written), with_tangents=NORMAL in written)
        provenance = {**maps.provenance, "relit:color_space": maps.color_space, **(look.provenance if look is not None else {})}
        add_scene(glb, surface, maps.camera, mesh.extent, provenance, name=name, file_name=target.name, version=version, unit_m=unit_m)
    return AssetReport(target, len(mesh.points), 2 * len(mesh.quads) + len(mesh.triangles), mesh.step,
                       {name: texture.clipped_pixels for name, texture in written.items()},
                       (*camera_warnings(maps.camera), *(loss_warnings(look) if look is not None else ())))
