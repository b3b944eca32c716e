"""The material of an asset in the metallic-roughness model of glTF.

Source: glTF 2.0 Specification, 3.9 "Materials"; KHR_materials_ior; KHR_materials_specular.
"""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib as gltf

from service.asset.content.mesh import SurfaceMesh
from service.asset.content.metallic import GLASS_IOR, MetallicLook
from service.asset.content.textures import BLEED_TEXELS, DATA_SPACE, DISPLAY_SPACE, Texture, bleed, encode, encode_normals, side_by_side
from service.asset.gltf.container import Glb
from service.errors import AssetError
from service.requests.export import TextureFormat
from stage.formats.images import write_png
from stage.results.maps import SurfaceMaps

BASE_COLOR, METALLIC_ROUGHNESS, NORMAL = "base_color", "metallic_roughness", "normal"
"""The images of a material."""


def check_textures(target: Path, storage: TextureFormat) -> None:
    """Check that a .glb can hold textures that are stored so: it has no place for EXR."""
    if storage is TextureFormat.EXR:
        raise AssetError(f"{target} cannot hold EXR textures: a .glb takes PNG; store the textures as png16, or export a .usda or .usdc")


def write_textures(maps: SurfaceMaps, mesh: SurfaceMesh, folder: Path, *, look: MetallicLook | None,
                   storage: TextureFormat = TextureFormat.PNG16) -> dict[str, Texture]:
    """Write the images that a glTF material of solved maps uses, and return them by name.

    METALLIC_ROUGHNESS is there only where a highlight was fitted.

    Args:
        mesh: of these maps; the normal map is relative to its frame.
        look: of these maps, where they have reflectance.
        storage: PNG16 or PNG8, the bits of the images that are no colours.
    """
    reach = max(BLEED_TEXELS, mesh.step)
    data: type[np.unsignedinteger[Any]] = np.uint8 if storage is TextureFormat.PNG8 else np.uint16

    def write(name: str, codes: np.ndarray, known: np.ndarray, clipped: int) -> Texture:
        write_png(folder / f"{name}.png", bleed(codes, known, reach=reach, in_place=True), srgb=name == BASE_COLOR)
        return Texture(f"{name}.png", DISPLAY_SPACE if name == BASE_COLOR else DATA_SPACE, clipped)

    def write_base_color(look: MetallicLook) -> Texture:
        codes, clipped = encode(look.base_color, look.known, maps.color_space, np.uint8)
        return write(BASE_COLOR, codes, look.known, clipped)

    def write_metallic_roughness(look: MetallicLook, roughness: np.ndarray) -> Texture:
        known = look.known & np.isfinite(roughness)
        green, clipped = encode(roughness, known, None, data)
        blue, _ = encode(look.metallic, known, None, data)
        red = np.full_like(green, np.iinfo(data).max)  # readers that expect three maps in one image take it as no occlusion
        return write(METALLIC_ROUGHNESS, np.stack([red, green, blue], axis=-1), known, clipped)

    def write_normal(normal: np.ndarray) -> Texture:
        codes, known, clipped = encode_normals(normal, maps.mask & np.isfinite(normal.sum(axis=-1)), mesh, data)
        return write(NORMAL, codes, known, clipped)

    writers: dict[str, Callable[[], Texture]] = {}
    if look is not None:
        writers[BASE_COLOR] = partial(write_base_color, look)
        if maps.specular is not None and maps.roughness is not None:
            writers[METALLIC_ROUGHNESS] = partial(write_metallic_roughness, look, maps.roughness)
    if maps.normal is not None:
        writers[NORMAL] = partial(write_normal, maps.normal)
    return side_by_side(writers)


NEUTRAL_GREY = 0.18
"""Base colour where the maps have no albedo: the default of UsdPreviewSurface, so that both formats look alike."""


def add_material(glb: Glb, textures: Mapping[str, Texture], folder: Path, *, name: str, ior: float = GLASS_IOR) -> int:
    """Add a material that uses these textures, and return its number.

    Convention:
        A surface without specular reflection has `specularFactor` 0 (KHR_materials_specular): F0 and F90 are 0, and what is left is
        Lambert's law. The index of refraction of dielectrics is written where it is not 1.5, the default (KHR_materials_ior).
    """
    document = glb.document
    if textures:
        document.samplers.append(gltf.Sampler(magFilter=gltf.LINEAR, minFilter=gltf.LINEAR_MIPMAP_LINEAR, wrapS=gltf.CLAMP_TO_EDGE,
                                              wrapT=gltf.CLAMP_TO_EDGE))
    numbers: dict[str, int] = {}
    for image, texture in textures.items():
        document.textures.append(gltf.Texture(source=glb.add_png(folder / texture.file_name), sampler=0, name=image))
        numbers[image] = len(document.textures) - 1

    surface = gltf.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    if BASE_COLOR in numbers:
        surface.baseColorTexture = gltf.TextureInfo(index=numbers[BASE_COLOR])
    else:
        surface.baseColorFactor = [NEUTRAL_GREY] * 3 + [1.0]
    material = gltf.Material(name=name, pbrMetallicRoughness=surface, doubleSided=True)
    if METALLIC_ROUGHNESS in numbers:
        surface.metallicRoughnessTexture = gltf.TextureInfo(index=numbers[METALLIC_ROUGHNESS])
        surface.metallicFactor = 1.0
        if ior != GLASS_IOR:
            material.extensions = {"KHR_materials_ior": {"ior": ior}}
    else:
        material.extensions = {"KHR_materials_specular": {"specularFactor": 0.0}}
    if NORMAL in numbers:
        material.normalTexture = gltf.NormalMaterialTexture(index=numbers[NORMAL])
    document.extensionsUsed += list(material.extensions)
    document.materials.append(material)
    return len(document.materials) - 1


def add_unlit_material(glb: Glb, *, name: str, coloured: bool) -> int:
    """Add a material that shows the colours of points as they were measured, or grey, and return its number (KHR_materials_unlit)."""
    shade = 1.0 if coloured else NEUTRAL_GREY
    glb.document.materials.append(gltf.Material(
        name=name, extensions={"KHR_materials_unlit": {}},
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(baseColorFactor=[shade] * 3 + [1.0], metallicFactor=0.0, roughnessFactor=1.0)))
    glb.document.extensionsUsed.append("KHR_materials_unlit")
    return len(glb.document.materials) - 1
