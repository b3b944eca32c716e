"""Writes solved maps as a USD asset: a mesh with textures, a material and the camera, as .usda, .usdc or .usdz."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from service.asset.mesh import height_mesh
from service.asset.textures import FILE_NAMES, write_textures
from service.usd.files import check_suffix, define_layer, temporary_folder_beside
from service.usd.scene import define_asset
from stage.maps import SurfaceMaps

Progress = Callable[[str, float], None]
"""Called with the name of the work that begins and the fraction of the whole that is done, 0…1."""

TEXTURES_START, TEXTURES_END = 0.1, 0.9
"""Fractions of the whole at which the textures begin and end, as measured for 4000 by 3000 pixels."""


class AssetReport(NamedTuple):
    """The files and the sizes of an asset."""

    path: Path  # the asset
    textures: tuple[Path, ...]  # files beside it; empty for .usdz, which holds them
    vertex_count: int
    face_count: int
    step: int  # every step-th pixel in both directions carries a vertex
    clipped_pixels: dict[str, int]  # layer → pixels that did not fit into 0…1


def write_asset(maps: SurfaceMaps, path: str | Path, *, name: str, progress: Progress | None = None) -> AssetReport:
    """Write solved maps as a USD asset.

    Args:
        maps: with `height`.
        path: its suffix chooses the format. Textures of .usda and .usdc go to the folder `<stem>_textures` beside it;
            a .usda and a .usdc of one name share that folder.
        name: free text; the root prim is named after it.
        progress: called before each part of the work.

    Raises:
        AssetError: another suffix; no height layer, or no face; a colour space that is not known.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    target = Path(path)
    packed = check_suffix(target) == ".usdz"
    tell = progress or (lambda what, done: None)

    tell("mesh", 0.0)
    mesh = height_mesh(maps)
    with temporary_folder_beside(target) as temporary:
        folder = temporary / f"{target.stem}_textures"
        folder.mkdir()
        textures = write_textures(maps, mesh, folder, progress=lambda layer, done: tell(
            f"texture {layer}", TEXTURES_START + (TEXTURES_END - TEXTURES_START) * done))
        tell("layer", TEXTURES_END)
        files = [folder / texture.file_name for texture in textures.values()]
        written = define_layer(temporary, target, lambda usd_stage: define_asset(
            usd_stage, maps, mesh, textures, name=name, texture_folder=f"./{folder.name}"), files)
        if packed:
            os.replace(written, target)
            files = []
        else:
            _install(written, folder, target)
    installed = tuple(target.parent / file.relative_to(temporary) for file in files)
    return AssetReport(target, installed, len(mesh.points), len(mesh.face_counts), mesh.step,
                       {layer: texture.clipped_pixels for layer, texture in textures.items()})


def _install(layer: Path, folder: Path, target: Path) -> None:
    """Put the textures and then the layer in place of older ones; on an error put the older ones back."""
    place, replaced = target.parent / folder.name, folder.with_name("replaced")
    if place.exists():
        os.rename(place, replaced)
    try:
        os.rename(folder, place)
        os.replace(layer, target)
    except OSError:
        if place.exists():
            os.rename(place, folder)
        if replaced.exists():
            os.rename(replaced, place)
        raise
    if replaced.exists():  # files that are not ours stay
        for file in replaced.iterdir():
            if file.name not in FILE_NAMES:
                os.rename(file, place / file.name)
