"""The material of an asset: UsdPreviewSurface in its specular workflow, which is the reflectance model that the solvers fit.

Source: OpenUSD, "UsdPreviewSurface Specification": the surface, UsdUVTexture and UsdPrimvarReader.
"""

from collections.abc import Mapping

from pxr import Gf, Sdf, Usd, UsdShade

from service.asset.textures import Texture

_TYPES = Sdf.ValueTypeNames

_INPUTS = {
    "diffuse_albedo": ("diffuseColor", _TYPES.Color3f, "rgb", _TYPES.Float3),
    "normal": ("normal", _TYPES.Normal3f, "rgb", _TYPES.Float3),
    "specular": ("specularColor", _TYPES.Color3f, "rgb", _TYPES.Float3),
    "roughness": ("roughness", _TYPES.Float, "r", _TYPES.Float),
}
"""Layer → input of the surface, its type; output of the texture, its type."""


def define_material(usd_stage: Usd.Stage, path: Sdf.Path, textures: Mapping[str, Texture],
                    folder: str) -> UsdShade.Material:
    """Define a material at `path` that uses these textures.

    Args:
        textures: by layer name. Without `specular` the surface is the fitted Lambertian: F0 = 0, roughness = 1.
        folder: of the textures, relative to the layer, "./…".

    Convention:
        The normal map holds (n + 1)/2, so its texture has scale (2, 2, 2, 1) and bias (-1, -1, -1, 0) and is read raw.
        (UsdPreviewSurface Proposal, "Texture reader" and "Normal maps").
    """
    material = UsdShade.Material.Define(usd_stage, path)
    surface = _shader(usd_stage, path.AppendChild("Surface"), "UsdPreviewSurface")
    surface.CreateInput("useSpecularWorkflow", _TYPES.Int).Set(1)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    if "specular" not in textures:
        surface.CreateInput("specularColor", _TYPES.Color3f).Set(Gf.Vec3f(0))
        if "roughness" not in textures:
            surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
    if not textures:
        return material

    reader = _shader(usd_stage, path.AppendChild("TextureCoordinates"), "UsdPrimvarReader_float2")
    reader.CreateInput("varname", _TYPES.String).Set("st")
    coordinates = reader.CreateOutput("result", _TYPES.Float2)
    for layer, texture in textures.items():
        name, value_type, channel, channel_type = _INPUTS[layer]
        image = _shader(usd_stage, path.AppendChild(name[0].upper() + name[1:]), "UsdUVTexture")
        image.CreateInput("file", _TYPES.Asset).Set(Sdf.AssetPath(f"{folder}/{texture.file_name}"))
        image.CreateInput("st", _TYPES.Float2).ConnectToSource(coordinates)
        image.CreateInput("sourceColorSpace", _TYPES.Token).Set(texture.color_space)
        image.CreateInput("wrapS", _TYPES.Token).Set("clamp")
        image.CreateInput("wrapT", _TYPES.Token).Set("clamp")
        if layer == "normal":
            image.CreateInput("scale", _TYPES.Float4).Set(Gf.Vec4f(2, 2, 2, 1))
            image.CreateInput("bias", _TYPES.Float4).Set(Gf.Vec4f(-1, -1, -1, 0))
        output = image.CreateOutput(channel, channel_type)
        surface.CreateInput(name, value_type).ConnectToSource(output)
    return material


def _shader(usd_stage: Usd.Stage, path: Sdf.Path, identifier: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(usd_stage, path)
    shader.CreateIdAttr(identifier)
    return shader
