"""The material of an asset in the metallic-roughness model of glTF.

Source: glTF 2.0 Specification, 3.9 "Materials"; KHR_materials_ior; KHR_materials_specular.
"""

from collections.abc import Mapping
from pathlib import Path

import pygltflib as gltf

from service.asset.metallic import GLASS_IOR
from service.asset.textures import Texture
from service.gltf.container import Glb
from service.gltf.textures import BASE_COLOR, METALLIC_ROUGHNESS, NORMAL

NEUTRAL_GREY = 0.18
"""Base colour where the maps have no albedo: the default of UsdPreviewSurface, so that both formats look alike."""


def add_material(glb: Glb, textures: Mapping[str, Texture], folder: Path, *, name: str, ior: float = GLASS_IOR) -> int:
    """Add a material that uses these textures, and return its number.

    Args:
        textures: by name, written into `folder`.
        name: of the material.
        ior: index of refraction of the dielectric share.

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
    """Add a material that shows the colours of points as they were measured, and return its number (KHR_materials_unlit).

    Args:
        coloured: the points have colours; without, they are grey.
    """
    shade = 1.0 if coloured else NEUTRAL_GREY
    glb.document.materials.append(gltf.Material(
        name=name, extensions={"KHR_materials_unlit": {}},
        pbrMetallicRoughness=gltf.PbrMetallicRoughness(baseColorFactor=[shade] * 3 + [1.0], metallicFactor=0.0, roughnessFactor=1.0)))
    glb.document.extensionsUsed.append("KHR_materials_unlit")
    return len(glb.document.materials) - 1
