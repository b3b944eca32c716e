"""The files of an asset, and what it brings along as variants that are not selected: lights, an environment, relit frames.

Relit frames are shown by a card in the plane of the image, at the middle depth of the object: the variant `card` of `geo`. Seen through the
asset's camera, the card's picture is the frame.

Source: OpenUSD, "UsdPreviewSurface Specification" (emissiveColor, opacity, UsdUVTexture with an animated file).
"""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.content import card as card_images
from service.asset.content.openpbr import DOCUMENT
from service.asset.content.textures import DATA_SPACE, FILE_NAMES
from service.asset.usd.files import install, temporary_folder_beside
from service.asset.usd.layers import ENVIRONMENT, LAYER_FILES, RIG, AssetLayers, Description, light_folder, texture_folder
from service.asset.usd.light_prims import define_dome, define_rig, write_dome_texture
from service.asset.usd.materials import define_coordinates, define_image, define_shader
from service.asset.usd.scene import define_polygons
from stage.capture.camera import Camera
from stage.capture.capture import Capture

CARD = "Card"
"""Name of the mesh, of its material and, in lower case, of its variant of `geo`."""
CELLS = 64
"""Faces along each side where the lens distorts, so that the card is straight between them to a hundredth of a pixel in a 4k image; 1
elsewhere, where the card is one plane rectangle."""

_TYPES = Sdf.ValueTypeNames
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
    outside: dict[str, float] | None = None
    """Is given what colours gain of which Rec.709 has a channel below 0, by files; see the same function."""
    encodings: dict[str, str] | None = None
    """Is given the sentence of an environment whose values seem to be encoded otherwise than they are taken; see the same function."""


class AssetFiles(NamedTuple):
    """The files of an asset while it is written."""

    layers: AssetLayers
    textures: Path  # temporary folder of the textures
    beside: list[Path]  # the files in it that the asset has, in the order in which a package holds them
    lights: list[Path]  # layers of lights and their textures


@contextmanager
def writing_asset(target: Path, description: Description) -> Iterator[AssetFiles]:
    """Yield the empty layers of an asset, which replaces `target`, whole or not at all, when the block ends."""
    with temporary_folder_beside(target) as temporary:
        files = AssetFiles(AssetLayers(temporary, target, description), temporary / texture_folder(target), [], [])
        files.textures.mkdir()
        yield files
        files.layers.save()
        first, *others = files.layers.files
        install(target, first, [*others, *files.beside], ours=files_of_assets(target), apart=files.lights)


def define_surroundings(files: AssetFiles, surroundings: Surroundings, camera: Camera, extent: np.ndarray) -> dict[str, int]:
    """Define the variants of `light` and `geo` that are asked for, write their textures, and return counts of clipped pixels by variant.
    `files`: of the asset, to which those of the surroundings are added. `extent`: [2, 3] bounding box of the surface, camera frame, scene
    units."""
    layers, clipped_pixels = files.layers, {}
    outside = {} if surroundings.outside is None else surroundings.outside
    if surroundings.card is not None:
        written = card_images.write_card(surroundings.card, files.textures, as_png=layers.packed)
        _define_card(layers, written, camera, extent)
        files.beside[:0] = [files.textures / name for names in (written.colours, written.opacities) for name in names.values()]
        clipped_pixels["card"] = written.clipped_pixels
    textures = [] if surroundings.rig is None else define_rig(layers, surroundings.rig, extent, outside)
    if surroundings.environment is not None:
        with layers.lighting(ENVIRONMENT) as usd_stage:
            texture = layers.lights / f"{ENVIRONMENT}.exr"
            write_dome_texture(surroundings.environment, texture, clipped=surroundings.clipped, outside=outside,
                               encodings=surroundings.encodings)
            define_dome(usd_stage, layers.root.AppendChild(ENVIRONMENT.capitalize()), f"./{texture.name}")
        textures.append(texture)
    files.lights.extend([*layers.light_files, *textures])
    return clipped_pixels


def _define_card(layers: AssetLayers, card: card_images.CardImages, camera: Camera, extent: np.ndarray) -> None:
    """Define the card, whose images are written already, at the middle depth of the surface's bounding box [2, 3], and its material."""
    material = _define_material(layers, layers.looks.AppendChild(CARD), card)
    with layers.geometry_variant(CARD.lower()) as geom:
        mesh = _define_rectangle(layers.geometry, geom.AppendChild(CARD), camera, float(extent[:, 2].mean()))
        layers.bind(mesh.GetPath(), material)
    layers.set_times(layers.materials, min(card.colours), max(card.colours))


def _define_rectangle(usd_stage: Usd.Stage, path: Sdf.Path, camera: Camera, z: float) -> UsdGeom.Mesh:
    """Define the part of the plane at z that the image shows, with texture coordinates."""
    cells = 1 if camera.distortion is None else CELLS
    u, v = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    points = camera.points_over(u * camera.width, v * camera.height, np.full_like(u, z)).reshape(-1, 3)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.stack([corner + cells + 1, corner + cells + 2, corner + 1, corner], axis=1).astype(np.int32)  # anticlockwise from +z
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    mesh = define_polygons(usd_stage, path, points, normals, np.full(len(faces), 4, np.int32), faces.ravel())
    st = np.stack([u, 1 - v], axis=-1).reshape(-1, 2).astype(np.float32)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", _TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex).Set(Vt.Vec2fArray.FromNumpy(st))
    return mesh


def _define_material(layers: AssetLayers, path: Sdf.Path, card: card_images.CardImages) -> UsdShade.Material:
    """Define a material that reflects nothing and emits the frame of the time code."""
    usd_stage = layers.materials
    material = UsdShade.Material.Define(usd_stage, path)
    surface = define_shader(usd_stage, path.AppendChild("Surface"), "UsdPreviewSurface")
    surface.CreateInput("diffuseColor", _TYPES.Color3f).Set(Gf.Vec3f(0))
    surface.CreateInput("ior", _TYPES.Float).Set(1.0)  # without a step of the index of refraction nothing is reflected
    surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    coordinates = define_coordinates(layers, path)
    colour = define_image(layers, path.AppendChild("EmissiveColor"), card.colours, card.color_space, coordinates)
    surface.CreateInput("emissiveColor", _TYPES.Color3f).ConnectToSource(colour.CreateOutput("rgb", _TYPES.Float3))
    if card.opacities:
        opacity = define_image(layers, path.AppendChild("Opacity"), card.opacities, DATA_SPACE, coordinates)
        surface.CreateInput("opacity", _TYPES.Float).ConnectToSource(opacity.CreateOutput("r", _TYPES.Float))
    return material


def files_of_assets(target: Path) -> list[str]:
    """Return the names of files in the folders beside an asset that an older one of its name can have; other files there stay."""
    folders = [target.parent / name for name in (texture_folder(target), light_folder(target))]
    around = [file.name for folder in folders if folder.is_dir() for file in folder.iterdir() if _FILES.fullmatch(file.name)]
    return [*LAYER_FILES, *FILE_NAMES, DOCUMENT, *around]
