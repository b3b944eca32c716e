"""The looks of an asset as UsdPreviewSurface: the metallic workflow, in which clients agree, and the specular one, which the solvers fit.

Blender and three.js multiply `specularColor` with the F0 of the index of refraction, so that metals of the specular workflow are black
there.

The metallic look is a MaterialX document too: each of its nodes becomes a shader of its definition's name, as the usdMtlx plug-in of
OpenUSD does it. The plug-in is not in OpenUSD's wheels, which cannot open a .mtlx, so that nothing refers to one. They also lack
MaterialX's definitions, and validators there call every such shader unknown. The shaders are therefore abstract prims (`class`), which
traversals leave out, and which UsdShade and Hydra find by the connection of the material. In a build with the plug-in, the same shaders
as `def` have no finding.

Source: OpenUSD, "UsdPreviewSurface Specification" (surface, UsdUVTexture, UsdPrimvarReader); "Color User Guide" (colorSpace of an
attribute, UsdColorSpaceAPI); usdMtlx (names of definitions, types, render context `mtlx`, MaterialXConfigAPI).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade

from service.asset.content.metallic import IOR_LIMITS, MetallicLook
from service.asset.content.openpbr import GRAPH, SURFACE, openpbr_document, write_openpbr
from service.asset.content.textures import DISPLAY_SPACE, Texture
from service.asset.usd.layers import AssetLayers

METALLIC, SPECULAR = "metallic", "specular"
"""The variants of `look`."""

_TYPES = Sdf.ValueTypeNames

_TEXTURED: dict[str, dict[str, tuple[str, ...]]] = {
    METALLIC: {"diffuseColor": ("base_color",), "metallic": ("metallic",)},
    SPECULAR: {"diffuseColor": ("diffuse_albedo", "base_color"), "specularColor": ("specular",)},
}
"""Look → input of the surface → names of the textures that it reads, of which it takes the first that there is."""

_SHARED: dict[str, tuple[str, ...]] = {"roughness": ("roughness",), "normal": ("normal",)}

_INPUT_TYPES = {
    "diffuseColor": (_TYPES.Color3f, "rgb", _TYPES.Float3),
    "specularColor": (_TYPES.Color3f, "rgb", _TYPES.Float3),
    "normal": (_TYPES.Normal3f, "rgb", _TYPES.Float3),
    "metallic": (_TYPES.Float, "r", _TYPES.Float),
    "roughness": (_TYPES.Float, "r", _TYPES.Float),
}
"""Input of the surface → its type; output of the texture, its type."""

RENDER_CONTEXT = "mtlx"

_MATERIALX_TYPES = {"float": _TYPES.Float, "string": _TYPES.String, "filename": _TYPES.Asset,
          "color3": _TYPES.Color3f, "vector2": _TYPES.Float2, "vector3": _TYPES.Float3,
          "surfaceshader": _TYPES.Token}


def define_looks(layers: AssetLayers, textures: Mapping[str, Texture], *, ior: float, openpbr: Any = None) -> None:
    """Define a material for each look, and make them the variants of `look`.
    `textures`: by name, written into the folder that `layers` names. Without `roughness` the surface is the fitted Lambertian: `ior` is 1,
    so that nothing is reflected at normal incidence, and roughness is 1. `openpbr`: MaterialX.Document of the metallic look, which its
    material has for the render context `mtlx`; None: it has none.

    Convention:
        The normal map holds (n + 1)/2, so its texture has scale (2, 2, 2, 1) and bias (-1, -1, -1, 0) and is read raw.
        Each file says its colour space twice: `sourceColorSpace` for the readers of UsdUVTexture (sRGB, or raw for scene-linear colours and
        data), and the metadata `colorSpace` of the attribute, which names the primaries too. Colours in the layer are lin_rec709_scene.
    """
    metallic = _define_material(layers, METALLIC, "Material", textures)
    surface = UsdShade.Shader(layers.materials.GetPrimAtPath(metallic.GetPath().AppendChild("Surface")))
    surface.CreateInput("ior", _TYPES.Float).Set(ior)
    if "metallic" not in textures:
        surface.CreateInput("metallic", _TYPES.Float).Set(0.0)
    if openpbr is not None:
        _define_materialx_surface(layers, metallic, openpbr)
    layers.add_look(METALLIC, metallic)

    specular = _define_material(layers, SPECULAR, "Specular", textures)
    if "specular" not in textures:
        surface = UsdShade.Shader(layers.materials.GetPrimAtPath(specular.GetPath().AppendChild("Surface")))
        surface.CreateInput("specularColor", _TYPES.Color3f).Set(Gf.Vec3f(0))
    layers.add_look(SPECULAR, specular)


def define_openpbr_looks(layers: AssetLayers, folder: Path, textures: Mapping[str, Texture], look: MetallicLook | None) -> list[Path]:
    """Define the looks, the metallic one with an OpenPBR surface too, and return the files that the asset has for them.

    The document of MaterialX is written beside the textures, unless the asset is a package, which may hold none.
    """
    ior = look.ior if look is not None else IOR_LIMITS[0]
    document = openpbr_document(textures, ior=ior) if look is not None else None
    UsdGeom.Scope.Define(layers.materials, layers.looks)
    define_looks(layers, textures, ior=ior, openpbr=document)
    files = [folder / texture.file_name for texture in textures.values()]
    return files if document is None or layers.packed else [*files, write_openpbr(document, folder)]


def _define_material(layers: AssetLayers, look: str, name: str, textures: Mapping[str, Texture]) -> UsdShade.Material:
    usd_stage, path = layers.materials, layers.looks.AppendChild(name)
    material = UsdShade.Material.Define(usd_stage, path)
    Usd.ColorSpaceAPI.Apply(material.GetPrim()).CreateColorSpaceNameAttr().Set(Gf.ColorSpaceNames.LinearRec709)
    surface = define_shader(usd_stage, path.AppendChild("Surface"), "UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(int(look == SPECULAR))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    if "roughness" not in textures:
        surface.CreateInput("roughness", _TYPES.Float).Set(1.0)

    read = {name: next((textures[t] for t in candidates if t in textures), None)
            for name, candidates in {**_TEXTURED[look], **_SHARED}.items()}
    if not any(read.values()):
        return material
    coordinates = define_coordinates(layers, path)
    for name, texture in read.items():
        if texture is None:
            continue
        value_type, channel, channel_type = _INPUT_TYPES[name]
        image = define_image(layers, path.AppendChild(name[0].upper() + name[1:]), {1: texture.file_name}, texture.color_space, coordinates)
        if name == "normal":
            image.CreateInput("scale", _TYPES.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            image.CreateInput("bias", _TYPES.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        surface.CreateInput(name, value_type).ConnectToSource(image.CreateOutput(channel, channel_type))
    return material


def define_coordinates(layers: AssetLayers, material: Sdf.Path) -> UsdShade.Output:
    """Define the reader of the texture coordinates of a material, and return its output."""
    reader = define_shader(layers.materials, material.AppendChild("TextureCoordinates"), "UsdPrimvarReader_float2")
    reader.CreateInput("varname", _TYPES.String).Set("st")
    return reader.CreateOutput("result", _TYPES.Float2)


def define_image(layers: AssetLayers, path: Sdf.Path, files: Mapping[int, str], color_space: str,
                 coordinates: UsdShade.Output) -> UsdShade.Shader:
    """Define a texture whose file is that of the time code, and the first without a time."""
    image = define_shader(layers.materials, path, "UsdUVTexture")
    file = image.CreateInput("file", _TYPES.Asset)
    file.Set(Sdf.AssetPath(f"{layers.texture_folder}/{files[min(files)]}"))
    if len(files) > 1:
        for number, name in files.items():
            file.Set(Sdf.AssetPath(f"{layers.texture_folder}/{name}"), number)
    file.GetAttr().SetColorSpace(color_space)
    image.CreateInput("st", _TYPES.Float2).ConnectToSource(coordinates)
    image.CreateInput("sourceColorSpace", _TYPES.Token).Set("sRGB" if color_space == DISPLAY_SPACE else "raw")
    image.CreateInput("wrapS", _TYPES.Token).Set("clamp")
    image.CreateInput("wrapT", _TYPES.Token).Set("clamp")
    return image


def define_display_color_material(usd_stage: Usd.Stage, path: Sdf.Path) -> UsdShade.Material:
    """Define a Lambertian material at `path` that takes its colour from the primvar displayColor."""
    material = UsdShade.Material.Define(usd_stage, path)
    surface = define_shader(usd_stage, path.AppendChild("Surface"), "UsdPreviewSurface")
    reader = define_shader(usd_stage, path.AppendChild("DisplayColor"), "UsdPrimvarReader_float3")
    reader.CreateInput("varname", _TYPES.String).Set("displayColor")
    surface.CreateInput("diffuseColor", _TYPES.Color3f).ConnectToSource(reader.CreateOutput("result", _TYPES.Float3))
    surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(1)
    surface.CreateInput("specularColor", _TYPES.Color3f).Set(Gf.Vec3f(0))
    surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    return material


def define_shader(usd_stage: Usd.Stage, path: Sdf.Path, identifier: str) -> UsdShade.Shader:
    """Define a shader."""
    shader = UsdShade.Shader.Define(usd_stage, path)
    shader.CreateIdAttr(identifier)
    return shader


def _define_materialx_surface(layers: AssetLayers, material: UsdShade.Material, document: Any) -> None:
    """Give a material a MaterialX surface, for renderers that read its render context; others see the material as it is."""
    graph, surface = document.getNodeGraph(GRAPH), document.getNode(SURFACE)
    nodes = UsdShade.NodeGraph.Define(layers.materials, material.GetPath().AppendChild(graph.getName()))
    shaders = {node.getName(): _materialx_node(layers, nodes.GetPath(), node) for node in graph.getNodes()}
    for node in graph.getNodes():
        for given in node.getInputs():
            if source := given.getNodeName():
                _input(shaders[node.getName()], given).ConnectToSource(shaders[source].GetOutput("out"))
    for output in graph.getOutputs():
        outlet = nodes.CreateOutput(output.getName(), _MATERIALX_TYPES[output.getType()])
        outlet.ConnectToSource(shaders[output.getNodeName()].GetOutput("out"))
    shader = _materialx_node(layers, material.GetPath(), surface)
    for given in surface.getInputs():
        if given.getOutputString():
            _input(shader, given).ConnectToSource(nodes.GetOutput(given.getOutputString()))
    material.CreateSurfaceOutput(RENDER_CONTEXT).ConnectToSource(shader.GetOutput("out"))
    for abstract in (nodes, shader):
        abstract.GetPrim().SetSpecifier(Sdf.SpecifierClass)
    prim = material.GetPrim()
    prim.AddAppliedSchema("MaterialXConfigAPI")  # by name, since the schema comes with the plug-in
    version = ".".join(map(str, document.getVersionIntegers()))
    prim.CreateAttribute("config:mtlx:version", _TYPES.String, custom=False).Set(version)


def _materialx_node(layers: AssetLayers, parent: Sdf.Path, node: Any) -> UsdShade.Shader:
    """Define a node with the values of its inputs and its output `out`; connections are made when all nodes are there."""
    shader = UsdShade.Shader.Define(layers.materials, parent.AppendChild(node.getName()))
    shader.CreateIdAttr(node.getNodeDef().getName())
    for given in node.getInputs():
        if not given.getValueString():
            continue
        if given.getType() == "filename":
            file = _input(shader, given)
            file.Set(Sdf.AssetPath(f"{layers.texture_folder}/{given.getValueString()}"))
            if given.getColorSpace():
                file.GetAttr().SetColorSpace(given.getColorSpace())
        else:
            value = given.getValue()
            _input(shader, given).Set(Gf.Vec3f(*value) if given.getType() == "color3" else value)
    shader.CreateOutput("out", _MATERIALX_TYPES[node.getType()])
    return shader


def _input(shader: UsdShade.Shader, given: Any) -> UsdShade.Input:
    return shader.CreateInput(given.getName(), _MATERIALX_TYPES[given.getType()])
