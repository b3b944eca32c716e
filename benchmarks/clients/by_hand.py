"""Writes maps as a USD asset by the shortest way, sharing no code with the exporter: its materials and meshes are compared with this.

A quad for each pixel has the mean of the maps' normals as vertex normals, so that there is no normal map and no tangent frame; metallic
and base colour follow from albedo and F0 by the closed form that is known from glTF; textures have 16 bits, base colour in sRGB.

Source: KhronosGroup/glTF, KHR_materials_pbrSpecularGlossiness, "Best practices": solveMetallic.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from stage.formats.images import write_png
from stage.results.maps import SurfaceMaps

DIELECTRIC_F0 = 0.04
BLEED_ROUNDS = 8
LEAST_COSINE = 0.2
"""Surfaces that are seen at a flatter angle are extended to their pixel's corners as if they were not."""
CODES = 65535


def metallic_of(albedo: np.ndarray, f0: np.ndarray) -> np.ndarray:
    """Return the metallic [rows, cols] of albedo and F0 [rows, cols, 3]: the root of m² F + m b + c = 0 of their brightness."""
    diffuse, specular = albedo.max(axis=-1), f0.max(axis=-1)
    b = diffuse * (1 - specular) / (1 - DIELECTRIC_F0) + specular - 2 * DIELECTRIC_F0
    root = np.sqrt(np.maximum(b * b - 4 * DIELECTRIC_F0 * (DIELECTRIC_F0 - specular), 0))
    return np.where(specular < DIELECTRIC_F0, 0, np.clip((root - b) / (2 * DIELECTRIC_F0), 0, 1))


def write_by_hand(maps: SurfaceMaps, folder: Path, name: str, metal: np.ndarray | None = None) -> Path:
    """Write `name`.usdz into a folder and return its path.

    Args:
        maps: with normal, albedo, specular, roughness and height; their camera has a scale, or is at the origin.
        folder: exists.
        name: of the asset.
        metal: [rows, cols] true share of metal; None: estimated.
    """
    assert maps.height is not None and maps.normal is not None and maps.diffuse_albedo is not None
    assert maps.specular is not None and maps.roughness is not None
    f0 = np.broadcast_to(maps.specular if maps.specular.ndim == 3 else maps.specular[..., None], maps.diffuse_albedo.shape)
    share = metallic_of(maps.diffuse_albedo, f0) if metal is None else metal
    base = maps.diffuse_albedo + np.maximum(f0 - DIELECTRIC_F0 * (1 - share)[..., None], 0)
    layers = {"base_color": base, "metallic": share, "roughness": maps.roughness}
    for key, values in layers.items():
        stored = np.clip(_bled(values, maps.mask), 0, 1)
        if key == "base_color":  # three.js takes every base colour for sRGB
            stored = np.where(stored <= 0.0031308, 12.92 * stored, 1.055 * stored ** (1 / 2.4) - 0.055)
        write_png(folder / f"{name}_{key}.png", np.round(stored * CODES).astype(np.uint16), srgb=key == "base_color")
    layer = folder / f"{name}.usda"
    _write_stage(maps, layer, {key: f"./{name}_{key}.png" for key in layers})
    packed = folder / f"{name}.usdz"
    UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(packed))
    return packed


def _bled(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return values whose surroundings hold their neighbours' mean, so that filtering at the edge meets nothing black."""
    values, known = np.where(mask if values.ndim == 2 else mask[..., None], values, 0).astype(np.float64), mask.copy()
    for _ in range(BLEED_ROUNDS):
        total, count = np.zeros_like(values), np.zeros(known.shape)
        for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
            count += np.roll(known, step, axis)
            total += np.roll(values, step, axis)
        new = ~known & (count > 0)
        values[new] = total[new] / (count[new] if values.ndim == 2 else count[new][:, None])
        known |= new
    return values


class _Mesh(NamedTuple):
    points: np.ndarray  # [V, 3]
    normals: np.ndarray  # [V, 3]
    st: np.ndarray  # [V, 2]
    quads: np.ndarray  # [Q, 4]


def _mesh(maps: SurfaceMaps) -> _Mesh:
    """Return a quad for each pixel of the mask, whose corners are the mean of where the tangent planes of the adjacent pixels of its part
    meet the corner's ray."""
    assert maps.height is not None and maps.normal is not None
    valid = maps.mask & np.isfinite(maps.height)
    height, width = valid.shape
    perspective = maps.camera.projection == "perspective"
    points = maps.camera.points(np.where(valid, maps.height, -1 if perspective else 0))[valid].astype(np.float64)
    flat = maps.camera.points(np.full(valid.shape, -1.0 if perspective else 0.0)).astype(np.float64)[..., :2]  # at z -1 or 0
    across, down = flat[0, 1] - flat[0, 0], flat[1, 0] - flat[0, 0]
    normal = maps.normal[valid].astype(np.float64)
    rows, cols = np.nonzero(valid)
    part = np.zeros(len(rows), int) if maps.part is None else maps.part[valid].astype(int)
    keys, z, places = [], [], []
    for dr, dc in ((0, 0), (1, 0), (1, 1), (0, 1)):  # counter-clockwise as the camera sees it
        xy = flat[rows, cols] + (dc - 0.5) * across + (dr - 0.5) * down
        if perspective:
            ray = np.concatenate([xy, np.full((len(xy), 1), -1.0)], axis=-1)
            faces = (normal * points).sum(-1) < -LEAST_COSINE * np.linalg.norm(points, axis=-1)
            t = (normal * points).sum(-1) / np.minimum((normal * ray).sum(-1), -LEAST_COSINE / 2)
            z.append(np.where(faces, -t, points[:, 2]))
        else:
            z.append(points[:, 2] - ((xy - points[:, :2]) * normal[:, :2]).sum(-1) / np.maximum(normal[:, 2], LEAST_COSINE))
        keys.append((part * (height + 1) + rows + dr) * (width + 1) + cols + dc)
        places.append(xy)
    unique, first, quads = np.unique(np.stack(keys), return_index=True, return_inverse=True)
    quads = quads.reshape(4, -1)
    count = np.bincount(quads.ravel())
    mean_z = np.bincount(quads.ravel(), np.concatenate(z)) / count
    mean_normal = np.stack([np.bincount(quads.ravel(), np.tile(normal[:, axis], 4)) for axis in range(3)], axis=-1)
    xy = np.concatenate(places)[first] * (-mean_z[:, None] if perspective else 1)
    col, row = unique % (width + 1), unique // (width + 1) % (height + 1)
    return _Mesh(np.concatenate([xy, mean_z[:, None]], axis=-1), mean_normal / np.linalg.norm(mean_normal, axis=-1, keepdims=True),
                 np.stack([col / width, 1 - row / height], axis=-1), quads.T)


def _write_stage(maps: SurfaceMaps, path: Path, textures: dict[str, str]) -> None:
    made = _mesh(maps)
    usd_stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(usd_stage, 1.0 if maps.camera.metric else 0.001)
    root = UsdGeom.Xform.Define(usd_stage, "/Object")
    usd_stage.SetDefaultPrim(root.GetPrim())
    if maps.camera.world_from_camera is not None:
        root.AddTransformOp().Set(Gf.Matrix4d(*np.array(maps.camera.world_from_camera).T.ravel().tolist()))
    mesh = UsdGeom.Mesh.Define(usd_stage, "/Object/Mesh")
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(made.points, np.float32)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(made.normals, np.float32)))
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(made.quads), 4))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(made.quads.astype(np.int32).ravel()))
    st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex")
    st.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(made.st, np.float32)))
    material = UsdShade.Material.Define(usd_stage, "/Object/Material")
    surface = _shader(usd_stage, "Surface", "UsdPreviewSurface")
    reader = _shader(usd_stage, "Reader", "UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    for key, (target, kind, output) in {"base_color": ("diffuseColor", Sdf.ValueTypeNames.Color3f, "rgb"),
                                        "metallic": ("metallic", Sdf.ValueTypeNames.Float, "r"),
                                        "roughness": ("roughness", Sdf.ValueTypeNames.Float, "r")}.items():
        texture = _shader(usd_stage, key, "UsdUVTexture")
        texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(textures[key])
        texture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB" if key == "base_color" else "raw")
        texture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
        made = texture.CreateOutput(output, Sdf.ValueTypeNames.Float3 if output == "rgb" else Sdf.ValueTypeNames.Float)
        surface.CreateInput(target, kind).ConnectToSource(made)
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    usd_stage.Save()


def _shader(usd_stage: Usd.Stage, name: str, kind: str) -> UsdShade.Shader:
    shader = UsdShade.Shader.Define(usd_stage, f"/Object/Material/{name}")
    shader.CreateIdAttr(kind)
    return shader
