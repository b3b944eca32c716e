"""Writes solved maps as a USD asset: a mesh with textures, a material and the camera, as .usda, .usdc or .usdz."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from service.asset.errors import AssetError
from service.asset.levels import level_meshes, with_smooth_normals
from service.asset.mesh import SurfaceMesh, height_mesh
from service.asset.metallic import IOR_LIMITS, loss_warnings, metallic_look
from service.asset.openpbr import openpbr_document, write_openpbr
from service.asset.textures import space_warnings, write_textures
from service.asset.units import unit_in_metres
from service.requests.export import FIRST_VERSION, TextureFormat
from service.usd.files import check_textures, install, temporary_folder_beside
from service.usd.layers import AssetLayers, Description, texture_folder
from service.usd.scene import define_asset, level_name
from service.usd.surroundings import Surroundings, define_surroundings, files_of_assets
from stage.maps import SurfaceMaps

Progress = Callable[[str, float], None]
"""Called with the name of the work that begins and the fraction of the whole that is done, 0…1."""

TEXTURES_START, TEXTURES_END = 0.1, 0.9
"""Fractions of the whole at which the textures begin and end, as measured for 4000 by 3000 pixels."""


NOTHING = Surroundings()
"""No surroundings."""


class AssetReport(NamedTuple):
    """The files and the sizes of an asset, and what its user should know of it."""

    path: Path  # the asset
    textures: tuple[Path, ...]  # files beside it, with the MaterialX document last; empty for .usdz, which holds them
    vertex_count: int
    face_count: int
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # texture → pixels that did not fit into 0…1
    warnings: tuple[str, ...]  # sentences
    levels: tuple[tuple[int, int], ...]  # vertices and faces of each level of detail
    lights: tuple[Path, ...]  # layers beside it

    @property
    def sizes(self) -> dict[str, tuple[int, int]]:
        """Vertices and faces by variant of `geo`."""
        return {"mesh": (self.vertex_count, self.face_count), **{level_name(k): size for k, size in enumerate(self.levels, start=1)}}


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, version: str = FIRST_VERSION,
                textures: TextureFormat = TextureFormat.PNG16, levels: int = 0, surroundings: Surroundings = NOTHING,
                progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a USD asset.

    Args:
        maps: with `height`.
        path: its suffix chooses the format. Beside a .usda and .usdc go the folders `<stem>_layers` and `<stem>_textures`; a .usda and a
            .usdc of one name share them.
        name: free text; the root prim is named after it.
        version: of the asset, for assetInfo.
        textures: how they are stored.
        levels: of detail, at most.
        surroundings: lights and frames that the asset brings along.
        progress: called before each part of the work.

    Raises:
        AssetError: another suffix; EXR textures in a .usdz; lights of a .usdz beside a .usda or .usdc of its name;
            no height layer, or no face; a colour space that is not known.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    target = Path(path)
    packed = check_textures(target, textures) == ".usdz"
    if packed and (surroundings.rig is not None or surroundings.environment is not None):
        _check_lights_are_free(target)
    tell = progress or (lambda what, done: None)

    tell("mesh", 0.0)
    mesh = height_mesh(maps)
    coarser: list[SurfaceMesh] = []
    if levels:
        if maps.normal is not None:  # else there is no normal map to hold what smoothing takes away
            mesh = with_smooth_normals(mesh)
        coarser = level_meshes(mesh, maps.camera, levels)
    look = metallic_look(maps) if maps.diffuse_albedo is not None else None
    provenance = {**maps.provenance, "relit:color_space": maps.color_space, **(look.provenance if look is not None else {})}
    description = Description(name, maps.camera, provenance, unit_in_metres(maps.camera), version)
    with temporary_folder_beside(target) as temporary:
        folder = temporary / texture_folder(target)
        folder.mkdir()
        written = write_textures(maps, mesh, folder, look=look, storage=textures, progress=lambda name, done: tell(
            f"texture {name}", TEXTURES_START + (TEXTURES_END - TEXTURES_START) * done))
        tell("layer", TEXTURES_END)
        beside = [folder / texture.file_name for texture in written.values()]
        openpbr = openpbr_document(written, ior=look.ior) if look is not None else None
        if openpbr is not None and not packed:  # a package may hold no .mtlx
            beside.append(write_openpbr(openpbr, folder))
        layers = AssetLayers(temporary, target, description)
        define_asset(layers, maps, [mesh, *coarser], written, ior=look.ior if look is not None else IOR_LIMITS[0], openpbr=openpbr)
        around = define_surroundings(layers, surroundings, maps.camera, mesh.extent, folder, packed=packed)
        beside[:0] = around.images
        layers.save()
        first, *others = layers.files
        install(target, first, [*others, *beside], ours=files_of_assets(target), apart=around.lights)
    installed = () if packed else tuple(target.parent / folder.name / file.name for file in beside)
    return AssetReport(target, installed, len(mesh.points), len(mesh.face_counts), mesh.step,
                       {**{name: texture.clipped_pixels for name, texture in written.items()}, **around.clipped_pixels},
                       (*(loss_warnings(look) if look is not None else ()), *space_warnings(written)),
                       tuple((len(level.points), len(level.triangles)) for level in coarser),
                       tuple(target.parent / layers.lights.name / file.name for file in layers.light_files))


def _check_lights_are_free(package: Path) -> None:
    """Refuse to write the lights of a package over those that another asset of its name refers to."""
    for suffix in (".usda", ".usdc"):
        other = package.with_suffix(suffix)
        if other.exists():
            raise AssetError(f"{package}: its lights would replace those of {other}: choose another name")
