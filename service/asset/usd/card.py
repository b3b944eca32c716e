"""A card in the plane of the image, at the middle depth of the object, that shows relit frames: the variant `card` of `geo`.

Seen through the asset's camera, the card's picture is the frame.

Source: OpenUSD, "UsdPreviewSurface Specification" (emissiveColor, opacity, UsdUVTexture with an animated file).
"""


import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from service.asset.content.card import CardImages
from service.asset.content.textures import DATA_SPACE
from service.asset.usd.layers import AssetLayers
from service.asset.usd.materials import define_coordinates, define_image, define_shader
from service.asset.usd.scene import define_polygons
from stage.capture.camera import Camera

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
    normals = np.tile(np.array([0, 0, 1], np.float32), (len(points), 1))
    mesh = define_polygons(usd_stage, path, points, normals, np.full(len(faces), 4, np.int32), faces.ravel())
    st = np.stack([u, 1 - v], axis=-1).reshape(-1, 2).astype(np.float32)
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", _TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex).Set(Vt.Vec2fArray.FromNumpy(st))
    return mesh


def _define_material(layers: AssetLayers, path: Sdf.Path, card: CardImages) -> UsdShade.Material:
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
