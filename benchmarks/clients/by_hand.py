"""Writes maps as a USD asset by the shortest way, sharing no code with the exporter: its materials and meshes are compared with this.

A vertex for each pixel has the map's normal as vertex normal, so that there is no normal map and no tangent frame; metallic and base
colour follow from albedo and F0 by the closed form that is known from glTF; textures have 16 bits, base colour in sRGB.

Source: KhronosGroup/glTF, KHR_materials_pbrSpecularGlossiness, "Best practices": solveMetallic.
"""

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt

from stage.images import write_png
from stage.maps import SurfaceMaps

DIELECTRIC_F0 = 0.04
BLEED_ROUNDS = 8
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


def _write_stage(maps: SurfaceMaps, path: Path, textures: dict[str, str]) -> None:
    valid = maps.mask & np.isfinite(maps.height)
    number = np.full(valid.shape, -1)
    number[valid] = np.arange(np.count_nonzero(valid))
    corners = np.stack([number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]], axis=-1).reshape(-1, 4)
    faces = np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    whole = (faces >= 0).all(axis=1)
    if maps.part is not None:
        of_vertex = maps.part[valid]
        whole &= (of_vertex[faces] == of_vertex[faces[:, :1]]).all(axis=1)
    faces = faces[whole]
    rows, cols = np.nonzero(valid)
    height, width = valid.shape
    points = maps.camera.points(np.where(valid, maps.height, 0))[valid].astype(np.float32)
    st = np.stack([(cols + 0.5) / width, 1 - (rows + 0.5) / height], axis=-1).astype(np.float32)

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
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(maps.normal[valid], np.float32)))
    mesh.SetNormalsInterpolation("vertex")
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
    UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "vertex").Set(Vt.Vec2fArray.FromNumpy(st))
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
