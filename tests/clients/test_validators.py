"""Validators find nothing, whatever is exported: each file, each kind of texture, masks with holes, parts, and maps without layers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils

from service.export.export import export
from service.requests.export import ExportRequest, Geometry, TextureFormat
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.formats import exr
from stage.formats.ply import POINTS_FILE, PointCloud, write_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import MAPS_FILE, SurfaceMaps
from tests.clients.scenes import GOLD, PAINT, ball_maps, seen_in_perspective, without_scale
from tests.clients.validators import findings
from tests.scenes.surroundings import capture_of, write_frames
from tests.service.asset.gltf import reading

SIDE = 40
pytestmark = pytest.mark.long

ORTHOGRAPHIC = Camera(projection="orthographic", resolution=(SIDE, SIDE), pixel_size_m=0.2 / SIDE)
TWO = ball_maps(ORTHOGRAPHIC, (PAINT, GOLD))[0]


def with_holes(maps: SurfaceMaps) -> SurfaceMaps:
    """Return maps with holes, single pixels, bridges that are one pixel wide, pixels that touch at a corner, and an own island."""
    mask = maps.mask.copy()
    mask[12:15, 10:14] = False
    mask[20::3, 8:20:2] = False
    mask[25:28, 22:30] = False
    mask[26, 22:30] = True
    mask[30, 15], mask[31, 16] = False, False
    mask[1, 1] = mask[1, 2] = mask[2, 1] = mask[2, 2] = True
    height = np.where(np.isfinite(maps.height), maps.height, 0)
    normal = maps.normal.copy()
    normal[1:3, 1:3] = (0, 0, 1)
    part = maps.part.copy()
    part[1:3, 1:3] = 3
    return replace(maps, mask=mask, height=height, normal=normal, part=part)


SURFACES = {
    "parts": TWO,
    "holes": with_holes(TWO),
    "no parts": replace(ball_maps(ORTHOGRAPHIC, (PAINT,))[0], part=None),
    "perspective": seen_in_perspective(TWO),
    "no specular": replace(TWO, specular=None, roughness=None),
    "no material": replace(TWO, specular=None, roughness=None, diffuse_albedo=None),
    "no scale": without_scale(TWO),
    "ACEScg, clipped": replace(TWO, color_space="lin_ap1_scene",
                               diffuse_albedo=3 * convert(TWO.diffuse_albedo, "lin_rec709_scene", "lin_ap1_scene")),
}

WAYS = {
    "usdz": {}, "usdz, 8 bits": {"textures": TextureFormat.PNG8}, "usdz, levels": {"levels": 2}, "usdc": {}, "usdc, levels": {"levels": 1},
    "usda, EXR": {"textures": TextureFormat.EXR}, "glb": {"textures": TextureFormat.PNG16}, "glb, 8 bits": {"textures": TextureFormat.PNG8},
}
"""Suffixes and options."""
THROUGHOUT = ("usdz, levels", "usda, EXR", "glb, 8 bits")
"""Ways that write every surface, one for each writer and kind of texture; the others write one."""


def exported(maps: SurfaceMaps, folder: Path, **options) -> Path:
    """Write maps and export them; the name has characters that no prim may have."""
    (folder / "maps").mkdir()
    maps.write(folder / "maps" / MAPS_FILE)
    asset = folder / f"asset.{options.pop('suffix')}"
    export(ExportRequest(maps=folder / "maps", out=asset, name="梟 2/a", **options))
    return asset


def faults(asset: Path) -> list[str]:
    """Return what the validators of its format find in an asset."""
    return reading.findings(reading.validate(asset)[0]) if asset.suffix == ".glb" else findings(asset)


@pytest.mark.parametrize(("surface", "way"), [(surface, way) for surface in SURFACES for way in WAYS
                                              if way in THROUGHOUT or surface == "holes"])
def test_validators_and_arkit_find_nothing(surface, way, tmp_path):
    assert faults(exported(SURFACES[surface], tmp_path, suffix=way.partition(",")[0], **WAYS[way])) == []


@pytest.mark.parametrize("suffix", ["usda", "usdz"])
def test_usd_validators_and_arkit_find_nothing_in_lights_and_frames(suffix, tmp_path):
    lights = [{"type": "distant", "direction": [1, 0, 1], "irradiance": [1, 2, 3]}, {"type": "gradient", "axis": "y", "sign": 1},
              {"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1], "axis": [0, 0, -1], "anisotropy": 2}]
    capture = capture_of(tmp_path / "capture", ORTHOGRAPHIC, lights)
    frames = write_frames(tmp_path / "frames", (1001, 1002), ORTHOGRAPHIC)
    sky = np.ones((8, 16), np.float16)
    exr.write(tmp_path / "sky.exr", {"R": sky, "G": sky, "B": sky}, color_space="lin_ap1_scene", metadata={})
    asset = exported(TWO, tmp_path, suffix=suffix, rig=capture.folder, environment=tmp_path / "sky.exr", card=frames)
    layers = sorted((tmp_path / "asset_lights").glob("*.usda"))
    assert [layer.stem for layer in layers] == ["environment", "rig"]
    assert [finding for file in (asset, *layers) for finding in findings(file)] == []


@pytest.mark.parametrize("geometry", list(Geometry))
@pytest.mark.parametrize(("suffix", "known"), [("usdz", "depth"), ("glb", "depth"), *(
    (suffix, "depth, σ and colours") for suffix in ("usdz", "usda", "usdc", "glb"))])
def test_nothing_is_found_in_depths(geometry, suffix, known, tmp_path):
    """Parts with holes, seen in perspective."""
    seen = seen_in_perspective(with_holes(TWO))
    depth = np.where(seen.mask, -seen.height, 0).astype(np.float32)
    maps = DepthMaps(camera=seen.camera, mask=seen.mask, depth=depth)
    if known != "depth":
        maps = replace(maps, sigma=np.full_like(depth, 0.001), confidence=np.full_like(depth, 0.5))
        points = seen.camera.points(-depth)[seen.mask]
        write_ply(PointCloud(points, np.full(points.shape, 128, np.uint8)), tmp_path / POINTS_FILE)
    maps.write(tmp_path / DEPTH_FILE)
    asset = tmp_path / f"asset.{suffix}"
    export(ExportRequest(maps=tmp_path, out=asset, name="梟 2/a", geometry=geometry))
    assert faults(asset) == []


def test_what_the_validators_are_for_is_found(tmp_path):
    """A light in a package, a mesh without a material, and a wrong extent."""
    usd_stage = Usd.Stage.CreateNew(str(tmp_path / "light.usdc"))
    UsdGeom.SetStageUpAxis(usd_stage, UsdGeom.Tokens.y)
    root = UsdGeom.Xform.Define(usd_stage, "/Root")
    usd_stage.SetDefaultPrim(root.GetPrim())
    UsdLux.DomeLight.Define(usd_stage, "/Root/Dome")
    mesh = UsdGeom.Mesh.Define(usd_stage, "/Root/Mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateExtentAttr([(0, 0, 0), (0.5, 0.5, 0)])
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim())
    usd_stage.Save()
    UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "light.usdc")), str(tmp_path / "light.usdz"))
    found = " ".join(findings(tmp_path / "light.usdz"))
    assert "DomeLight, which it does not know" in found
    assert "bound to no material" in found
    assert "NVIDIA" in found and "xtent" in found


def test_a_wrong_materialx_document_is_found(tmp_path):
    asset = exported(TWO, tmp_path, suffix="usda")
    assert findings(asset) == []
    document, = tmp_path.rglob("*.mtlx")
    document.write_text(document.read_text().replace("base_color.png", "colour.png").replace("open_pbr_surface", "open_pbr_surfac"))
    found = " ".join(findings(asset))
    assert "there is no file colour.png" in found and "no definition of open_pbr_surfac" in found
