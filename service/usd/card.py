"""A card in the plane of the image, at the middle depth of the object, that shows relit frames: the variant `card` of `geo`.

Seen through the asset's camera, the card's picture is the frame.

Source: OpenUSD, "UsdPreviewSurface Specification" (emissiveColor, opacity, UsdUVTexture with an animated file).
"""

from collections.abc import Mapping

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.card import CardImages
from service.asset.textures import DATA_SPACE, DISPLAY_SPACE
from service.usd.layers import AssetLayers
from stage.camera import Camera

CARD = "Card"
"""Name of the mesh, of its material and, in lower case, of its variant of `geo`."""
CELLS = 64
"""Faces along each side where the lens distorts, so that the card is straight between them to a hundredth of a pixel in a 4k image; 1
elsewhere, where the card is one plane rectangle."""

_TYPES = Sdf.ValueTypeNames


def define_card(layers: AssetLayers, card: CardImages, camera: Camera, extent: np.ndarray) -> None:
    """Define the card and its material.

    Args:
        card: written into the folder that `layers` names.
        extent: [2, 3] bounding box of the surface, camera frame, scene units.
    """
    material = _define_material(layers, layers.looks.AppendChild(CARD), card)
    with layers.geometry_variant(CARD.lower()) as geom:
        mesh = _define_rectangle(layers.geometry, geom.AppendChild(CARD), camera, float(extent[:, 2].mean()))
        layers.bind(mesh.GetPath(), material)
    layers.set_times(layers.materials, min(card.colours), max(card.colours))


def _define_rectangle(usd_stage: Usd.Stage, path: Sdf.Path, camera: Camera, z: float) -> UsdGeom.Mesh:
    """Define the part of the plane at z that the image shows, with texture coordinates."""
    cells = 1 if camera.distortion is None else CELLS
    u, v = np.meshgrid(np.linspace(0, 1, cells + 1), np.linspace(0, 1, cells + 1))
    x, y = camera.plane_at(u * camera.width, v * camera.height)
    scale = -z if camera.projection == "perspective" else 1.0
    points = np.stack([x * scale, y * scale, np.full_like(x, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.stack([corner + cells + 1, corner + cells + 2, corner + 1, corner], axis=1).astype(np.int32)  # anticlockwise from +z
    mesh = UsdGeom.Mesh.Define(usd_stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 4, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    st = np.stack([u, 1 - v], axis=-1).reshape(-1, 2).astype(np.float32)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", _TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex).Set(Vt.Vec2fArray.FromNumpy(st))
    return mesh


def _define_material(layers: AssetLayers, path: Sdf.Path, card: CardImages) -> UsdShade.Material:
    """Define a material that reflects nothing and emits the frame of the time code."""
    usd_stage = layers.materials
    material = UsdShade.Material.Define(usd_stage, path)
    surface = _shader(usd_stage, path.AppendChild("Surface"), "UsdPreviewSurface")
    surface.CreateInput("diffuseColor", _TYPES.Color3f).Set(Gf.Vec3f(0))
    surface.CreateInput("ior", _TYPES.Float).Set(1.0)  # without a step of the index of refraction nothing is reflected
    surface.CreateInput("roughness", _TYPES.Float).Set(1.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", _TYPES.Token))
    reader = _shader(usd_stage, path.AppendChild("TextureCoordinates"), "UsdPrimvarReader_float2")
    reader.CreateInput("varname", _TYPES.String).Set("st")
    coordinates = reader.CreateOutput("result", _TYPES.Float2)
    colour = _define_texture(layers, path.AppendChild("EmissiveColor"), card.colours, card.color_space, coordinates)
    surface.CreateInput("emissiveColor", _TYPES.Color3f).ConnectToSource(colour.CreateOutput("rgb", _TYPES.Float3))
    if card.opacities:
        opacity = _define_texture(layers, path.AppendChild("Opacity"), card.opacities, DATA_SPACE, coordinates)
        surface.CreateInput("opacity", _TYPES.Float).ConnectToSource(opacity.CreateOutput("r", _TYPES.Float))
    return material


def _define_texture(layers: AssetLayers, path: Sdf.Path, files: Mapping[int, str], color_space: str,
                    coordinates: UsdShade.Output) -> UsdShade.Shader:
    """Define a texture whose file is that of the time code, and the first without a time."""
    image = _shader(layers.materials, path, "UsdUVTexture")
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


def _shader(usd_stage: Usd.Stage, path: Sdf.Path, identifier: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(usd_stage, path)
    shader.CreateIdAttr(identifier)
    return shader
