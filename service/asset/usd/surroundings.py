"""The files of an asset, and what it brings along as variants that are not selected: lights, an environment, relit frames."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.asset.content import card as card_images
from service.asset.content.openpbr import DOCUMENT
from service.asset.content.textures import FILE_NAMES
from service.asset.usd.card import define_card
from service.asset.usd.files import install, temporary_folder_beside
from service.asset.usd.layers import ENVIRONMENT, LAYER_FILES, RIG, AssetLayers, Description, light_folder, texture_folder
from service.asset.usd.rig import define_dome, define_rig, write_dome_texture
from stage.capture.camera import Camera
from stage.capture.capture import Capture

_FILES = re.compile(rf"{ENVIRONMENT}\.(?:exr|usda)|{RIG}\.usda|{RIG}_\d+\.exr|{card_images.FILE_PATTERN}")
"""Every file that define_surroundings can write."""


class Surroundings(NamedTuple):
    """Lights and relit frames that an asset includes; the camera of the capture and of the frames is that of the asset."""

    rig: Capture | None = None
    """Capture whose lights become the variant `rig` of `light`."""
    environment: Path | None = None
    """Lat-long map, which becomes the variant `environment` of `light`."""
    card: Mapping[int, Path] | None = None
    """Relit frames by their numbers, which become the variant `card` of `geo`."""
    clipped: dict[str, int] | None = None
    """Counts of clipped values as in stage.colour.environment_maps.read_environment, for lat-long maps."""


class AssetFiles(NamedTuple):
    """The files of an asset while it is written."""

    layers: AssetLayers
    textures: Path  # temporary folder of the textures
    beside: list[Path]  # the files in it that the asset has, in the order in which a package holds them
    lights: list[Path]  # layers of lights and their textures


@contextmanager
def writing_asset(target: Path, description: Description) -> Iterator[AssetFiles]:
    """Yield the empty layers of an asset, which replaces `target`, whole or not at all, when the block ends.

    Raises:
        AssetError: another suffix, or what the block raises.
        StorageError: the disk refuses; what was there before is left as it was.
    """
    with temporary_folder_beside(target) as temporary:
        files = AssetFiles(AssetLayers(temporary, target, description), temporary / texture_folder(target), [], [])
        files.textures.mkdir()
        yield files
        files.layers.save()
        first, *others = files.layers.files
        install(target, first, [*others, *files.beside], ours=files_of_assets(target), apart=files.lights)


def define_surroundings(files: AssetFiles, surroundings: Surroundings, camera: Camera, extent: np.ndarray) -> dict[str, int]:
    """Define the variants of `light` and `geo` that are asked for, and write their textures.

    Args:
        files: of the asset, to which those of the surroundings are added.
        surroundings: what the asset brings along.
        camera: of the asset.
        extent: [2, 3] bounding box of the surface, camera frame, scene units.

    Returns:
        By what they are, the pixels that did not fit into 0…1.

    Raises:
        AssetError: lights that cannot be placed.
        ImageError: an environment or a frame that cannot be used.
        StorageError: a file cannot be read or written.
    """
    layers, clipped_pixels = files.layers, {}
    if surroundings.card is not None:
        written = card_images.write_card(surroundings.card, files.textures, as_png=layers.packed)
        define_card(layers, written, camera, extent)
        files.beside[:0] = [files.textures / name for names in (written.colours, written.opacities) for name in names.values()]
        clipped_pixels["card"] = written.clipped_pixels
    textures = [] if surroundings.rig is None else define_rig(layers, surroundings.rig, extent)
    if surroundings.environment is not None:
        with layers.lighting(ENVIRONMENT) as usd_stage:
            texture = layers.lights / f"{ENVIRONMENT}.exr"
            write_dome_texture(surroundings.environment, texture, clipped=surroundings.clipped)
            define_dome(usd_stage, layers.root.AppendChild(ENVIRONMENT.capitalize()), f"./{texture.name}")
        textures.append(texture)
    files.lights.extend([*layers.light_files, *textures])
    return clipped_pixels


def files_of_assets(target: Path) -> list[str]:
    """Return the names of files in the folders beside an asset that an older one of its name can have; other files there stay."""
    folders = [target.parent / name for name in (texture_folder(target), light_folder(target))]
    around = [file.name for folder in folders if folder.is_dir() for file in folder.iterdir() if _FILES.fullmatch(file.name)]
    return [*LAYER_FILES, *FILE_NAMES, DOCUMENT, *around]
