"""The metallic look as a MaterialX document: an OpenPBR surface that reads the textures of an asset.

OpenPBR's base colour, metalness, roughness (α = roughness²) and index of refraction mean what UsdPreviewSurface's do. Its base under a
dielectric loses what the surface reflects, and light between microfacets is kept; Relit's BRDF does neither.

Source: OpenPBR Surface specification 1.1; MaterialX Specification 1.39 (image, normalmap, geompropvalue, colour spaces).
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path

import MaterialX as mx

from service.asset.content.textures import COLOURS, DISPLAY_SPACE, Texture

DOCUMENT = "openpbr.mtlx"
"""The file of the document, beside the textures."""

GRAPH, SURFACE, MATERIAL = "Textures", "OpenPBR", "Material"
"""Names of the elements: the graph of the textures, the surface and the material."""

_INPUTS = {
    "base_color": ("base_color", "color3"),
    "metallic": ("base_metalness", "float"),
    "roughness": ("specular_roughness", "float"),
    "normal": ("geometry_normal", "vector3"),
}
"""Texture → input of the surface, and its type."""

_COLOR_SPACES = {DISPLAY_SPACE: "srgb_texture", "lin_rec709_scene": "lin_rec709", "lin_ap1_scene": "acescg",
                 "lin_adobergb_scene": "lin_adobergb", "lin_p3d65_scene": "lin_displayp3"}
"""Names that MaterialX's own colour management knows for interchange names; others are written as they are."""


def openpbr_document(textures: Mapping[str, Texture], *, ior: float) -> mx.Document:
    """Return the material as a document whose files are relative to the folder of the textures.

    Without the texture `roughness` the surface is Lambertian: nothing is reflected, whatever the index of refraction.

    Convention:
        Texture coordinates are the geometric property `st`, as in USD. Images that are no colours declare no colour space.
    """
    document = mx.createDocument()
    document.setDataLibrary(_library())
    document.setColorSpace("lin_rec709")
    graph = document.addNodeGraph(GRAPH)
    surface = document.addNode("open_pbr_surface", SURFACE, "surfaceshader")
    coordinates = None
    for name, (target, kind) in _INPUTS.items():
        if (texture := textures.get(name)) is None:
            continue
        if coordinates is None:
            coordinates = graph.addNode("geompropvalue", "st", "vector2")
            coordinates.setInputValue("geomprop", "st")
        image = graph.addNode("image", name, kind)
        file = image.setInputValue("file", texture.file_name, "filename")
        if name in COLOURS:
            file.setColorSpace(_COLOR_SPACES.get(texture.color_space, texture.color_space))
        image.setConnectedNode("texcoord", coordinates)
        image.setInputValue("uaddressmode", "clamp")
        image.setInputValue("vaddressmode", "clamp")
        if name == "normal":
            unpacked = graph.addNode("normalmap", "tangent_space", "vector3")
            unpacked.setConnectedNode("in", image)
            image = unpacked
        output = graph.addOutput(f"{name}_out", kind)
        output.setConnectedNode(image)
        surface.setConnectedOutput(target, output)
    if "roughness" in textures:
        surface.setInputValue("specular_ior", ior)
    else:
        surface.setInputValue("specular_weight", 0.0)
        surface.setInputValue("specular_roughness", 1.0)
    document.addMaterialNode(MATERIAL, surface)
    return document


def write_openpbr(document: mx.Document, folder: Path) -> Path:
    """Write a document into the folder of the textures, and return its path."""
    path = folder / DOCUMENT
    path.write_text(mx.writeToXmlString(document), encoding="utf-8")
    return path


@cache
def _library() -> mx.Document:
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library
