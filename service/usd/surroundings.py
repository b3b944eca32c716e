"""What an asset brings along beside its surface, each as a variant that is not selected: lights, an environment, relit frames."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.asset import card as card_images
from service.asset.openpbr import DOCUMENT
from service.asset.textures import FILE_NAMES
from service.usd.card import define_card
from service.usd.environment import define_dome, write_dome_texture
from service.usd.layers import ENVIRONMENT, LAYER_FILES, RIG, AssetLayers, light_folder, texture_folder
from service.usd.rig import define_rig
from stage.camera import Camera
from stage.capture import Capture

_FILES = re.compile(rf"{ENVIRONMENT}\.(?:exr|usda)|{RIG}\.usda|{RIG}_\d+\.exr|{card_images.FILE_PATTERN}")
"""Every file that define_surroundings can write."""


class Surroundings(NamedTuple):
    """What an asset brings along; the camera of the capture and of the frames is that of the asset."""

    rig: Capture | None = None
    """Capture whose lights become the variant `rig` of `light`."""
    environment: Path | None = None
    """Lat-long map, which becomes the variant `environment` of `light`."""
    card: Mapping[int, Path] | None = None
    """Relit frames by their numbers, which become the variant `card` of `geo`."""
    clipped: dict[str, int] | None = None
    """As in stage.environment_maps.read_environment, for lat-long maps."""


class Written(NamedTuple):
    """The files of the surroundings."""

    images: list[Path]  # of a card
    lights: list[Path]  # layers and textures
    clipped_pixels: dict[str, int]  # what → pixels that did not fit into 0…1


def define_surroundings(layers: AssetLayers, surroundings: Surroundings, camera: Camera, extent: np.ndarray, folder: Path, *,
                        packed: bool) -> Written:
    """Define the variants of `light` and `geo` that are asked for, and write their textures.

    Args:
        extent: [2, 3] bounding box of the surface, camera frame, scene units.
        folder: temporary, of the textures of the surface.
        packed: for a .usdz, which holds the images of a card as PNG.

    Raises:
        AssetError: lights that cannot be placed.
        ImageError: an environment or a frame that cannot be used.
        StorageError: a file cannot be read or written.
    """
    images: list[Path] = []
    lights: list[Path] = []
    clipped_pixels: dict[str, int] = {}
    if surroundings.card is not None:
        written = card_images.write_card(surroundings.card, folder, as_png=packed)
        define_card(layers, written, camera, extent)
        images = [folder / name for names in (written.colours, written.opacities) for name in names.values()]
        clipped_pixels["card"] = written.clipped_pixels
    if surroundings.rig is not None:
        lights += define_rig(layers, surroundings.rig, extent)
    if surroundings.environment is not None:
        with layers.lighting(ENVIRONMENT) as usd_stage:
            texture = layers.lights / f"{ENVIRONMENT}.exr"
            write_dome_texture(surroundings.environment, texture, clipped=surroundings.clipped)
            define_dome(usd_stage, layers.root.AppendChild(ENVIRONMENT.capitalize()), f"./{texture.name}")
        lights.append(texture)
    return Written(images, [*layers.light_files, *lights], clipped_pixels)


def files_of_assets(target: Path) -> list[str]:
    """Return the names of files in the folders beside an asset that an older one of its name can have; other files there stay."""
    folders = [target.parent / name for name in (texture_folder(target), light_folder(target))]
    around = [file.name for folder in folders if folder.is_dir() for file in folder.iterdir() if _FILES.fullmatch(file.name)]
    return [*LAYER_FILES, *FILE_NAMES, DOCUMENT, *around]
