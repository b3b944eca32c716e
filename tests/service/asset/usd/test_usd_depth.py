"""Depths as USD: a mesh with what the scene looks like and points as variants, nothing bridged over a break."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from service.asset.content.depth import depth_mesh
from service.asset.usd.depth_asset import write_depth
from service.errors import AssetError
from service.requests.export import Geometry
from stage.capture.camera import Camera
from stage.formats import images
from stage.formats.ply import PointCloud, write_ply
from stage.results.depth_maps import DepthMaps
from tests.clients.validators import findings
from tests.reference.colour import srgb_to_linear
from tests.service.asset.walls import CAMERA, cloud_of, make, uncertain

LENS = {"model": "brown_conrady", "k": [-0.1, 0.02, 0.0], "p": [0.001, -0.002]}
CAMERAS = {
    "perspective": CAMERA,
    "lens": Camera.model_validate({"projection": "perspective", "resolution": [24, 16], "focal_px": [40.0, 42.0], "distortion": LENS}),
    "orthographic": Camera.model_validate({"projection": "orthographic", "resolution": [24, 16], "pixel_size_m": 0.02}),
}


def opened(path, geo=None):
    usd_stage = Usd.Stage.Open(str(path))
    if geo is not None:
        usd_stage.GetDefaultPrim().GetVariantSet("geo").SetVariantSelection(geo)
    return usd_stage


@pytest.mark.long
@pytest.mark.parametrize(("suffix", "geometry", "known"), [(".usda", Geometry.MESH, True), (".usdc", Geometry.POINTS, True),
                                                          (".usdz", Geometry.MESH, False), (".usda", Geometry.POINTS, False)])
def test_validators_find_nothing(tmp_path, suffix, geometry, known):
    maps = make(broken=suffix != ".usdc", **uncertain())
    write_depth(maps, cloud_of(maps, normals=True) if known else None, tmp_path / f"wall{suffix}", name="Wand 1", geometry=geometry)
    assert UsdGeom.GetStageMetersPerUnit(opened(tmp_path / f"wall{suffix}")) == 1.0
    assert findings(tmp_path / f"wall{suffix}") == []


@pytest.mark.parametrize("geometry", list(Geometry))
def test_mesh_and_points_are_variants_and_the_one_asked_for_is_selected(tmp_path, geometry):
    maps = make()
    write_depth(maps, cloud_of(maps), tmp_path / "wall.usdc", name="Wall", geometry=geometry)
    usd_stage = opened(tmp_path / "wall.usdc")
    geo = usd_stage.GetDefaultPrim().GetVariantSet("geo")
    assert sorted(geo.GetVariantNames()) == ["mesh", "points"] and geo.GetVariantSelection() == geometry
    for variant, prim in (("mesh", "Mesh"), ("points", "Points")):
        geo.SetVariantSelection(variant)
        shown = [p.GetName() for p in usd_stage.Traverse() if p.IsA(UsdGeom.PointBased)]
        assert shown == [prim]
        seen = np.array(UsdGeom.PointBased(usd_stage.GetPrimAtPath(f"/Wall/Geom/{prim}")).GetPointsAttr().Get())
        margin = maps.depth.max() * 1.5 / 40 / 2 if variant == "points" else 0.0  # half the width of the widest point
        hint = np.array(UsdGeom.ModelAPI(usd_stage.GetDefaultPrim()).GetExtentsHint())
        assert (hint[0] <= seen.min(axis=0)).all() and (hint[1] >= seen.max(axis=0)).all()
        assert np.abs(hint - [seen.min(axis=0), seen.max(axis=0)]).max() <= margin + 1e-6
        assert variant == "mesh" or (hint[1] - seen.max(axis=0) > 0.9 * margin).all()


def test_points_keep_place_colour_and_normal(tmp_path):
    maps = make(**uncertain())
    cloud = cloud_of(maps, normals=True)
    write_depth(maps, cloud, tmp_path / "wall.usdc", name="Wall", geometry=Geometry.POINTS)
    usd_stage = Usd.Stage.Open(str(tmp_path / "wall.usdc"))
    points = UsdGeom.Points(usd_stage.GetPrimAtPath("/Wall/Geom/Points"))
    assert (np.array(points.GetPointsAttr().Get()) == cloud.points).all()
    assert (np.array(points.GetNormalsAttr().Get()) == cloud.normals).all()
    assert np.abs(np.array(points.GetDisplayColorPrimvar().ComputeFlattened()) - srgb_to_linear(cloud.colours / 255)).max() < 1e-4
    assert np.allclose(points.GetWidthsAttr().Get(), 1.5 * maps.depth[maps.mask] / 40, rtol=1e-5)
    api = UsdGeom.PrimvarsAPI(points)
    assert (np.array(api.GetPrimvar("sigma").ComputeFlattened()) == maps.sigma[maps.mask]).all()
    assert (np.array(api.GetPrimvar("confidence").ComputeFlattened()) == maps.confidence[maps.mask]).all()
    material, _ = UsdShade.MaterialBindingAPI(points).ComputeBoundMaterial()
    reader = material.ComputeSurfaceSource()[0].GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert reader.GetPrim().GetAttribute("inputs:varname").Get() == "displayColor"


@pytest.mark.parametrize("suffix", [".usda", ".usdz"])
@pytest.mark.parametrize("camera", list(CAMERAS))
def test_a_mesh_looks_like_the_scene(tmp_path, suffix, camera):
    maps = make(camera=CAMERAS[camera], **uncertain())
    cloud = cloud_of(maps)
    assert write_depth(maps, cloud, tmp_path / f"wall{suffix}", name="Wall") == ()
    usd_stage = Usd.Stage.Open(str(tmp_path / f"wall{suffix}"))
    mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/Wall/Geom/Mesh"))
    rows, cols = np.nonzero(maps.mask)
    of_pixel = np.zeros((16, 24, 3), np.uint8)
    of_pixel[rows, cols] = cloud.colours
    api = UsdGeom.PrimvarsAPI(mesh)
    st = np.array(api.GetPrimvar("st").Get())
    pixel = np.rint((1 - st[:, 1]) * 16 - 0.5).astype(int), np.rint(st[:, 0] * 24 - 0.5).astype(int)
    assert np.abs(np.array(mesh.GetDisplayColorPrimvar().ComputeFlattened()) - srgb_to_linear(of_pixel[pixel] / 255)).max() < 1e-4
    for name in ("sigma", "confidence"):
        assert api.GetPrimvar(name).GetInterpolation() == UsdGeom.Tokens.vertex
        assert (np.array(api.GetPrimvar(name).ComputeFlattened()) == getattr(maps, name)[pixel]).all()
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource()[0]
    image = surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim()
    assert surface.GetInput("roughness").Get() == 1.0
    if suffix == ".usda":
        shown = images.read_pixels(image.GetAttribute("inputs:file").Get().resolvedPath)
        assert np.abs(shown[rows, cols] - cloud.colours / 255).max() < 1 / 65535 + 1e-6  # 16 bits
        assert shown[5, 8].any()  # filled from around, so that filtering does not darken the border


def test_points_between_pixels_colour_the_mesh(tmp_path):
    """As lasers give them: fewer than the pixels of the depth, and beside pixel centres."""
    maps = make()
    rows, cols = np.nonzero(maps.mask)
    some = (cols % 2 == 0) & (rows > 2)
    x, y = CAMERA.plane_at(cols[some] + 0.8, rows[some] + 0.3)
    points = (np.stack([x, y, -np.ones(len(x))], axis=-1) * 1.21).astype(np.float32)
    colours = np.full((len(points), 3), (180, 90, 40), np.uint8)
    write_depth(maps, PointCloud(points, colours), tmp_path / "wall.usda", name="Wall")
    usd_stage = opened(tmp_path / "wall.usda")
    mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/Wall/Geom/Mesh"))
    assert np.abs(np.array(mesh.GetDisplayColorPrimvar().ComputeFlattened()) - srgb_to_linear(np.array([180, 90, 40]) / 255)).max() < 1e-4


def test_a_mesh_is_not_bridged_over_a_break(tmp_path):
    whole, broken = depth_mesh(make()), depth_mesh(make(broken=True))
    assert whole.centred == broken.centred == 381
    assert np.ptp(whole.points[whole.quads][..., 2], axis=1).max() < 0.1 and np.isin(whole.cols[whole.quads], [11, 12]).all(axis=1).any()
    faces = [*broken.quads, *broken.triangles]
    assert all(np.ptp(broken.points[face, 2]) < 0.1 for face in faces)
    assert not any({11, 12} <= set(broken.cols[face].tolist()) for face in faces)
    maps = make(broken=True)
    write_depth(maps, cloud_of(maps), tmp_path / "wall.usda", name="Wall")
    usd_stage = opened(tmp_path / "wall.usda")
    mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/Wall/Geom/Mesh"))
    assert len(mesh.GetDisplayColorPrimvar().ComputeFlattened()) == len(mesh.GetPointsAttr().Get()) == len(broken.points)


def test_a_mesh_of_noisy_depth_is_whole():
    noise = 0.6 * np.random.default_rng(4).standard_normal((16, 24)).astype(np.float32)
    maps = make(sigma=np.full((16, 24), 0.6, np.float32))
    noisy = DepthMaps(camera=CAMERA, mask=maps.mask, sigma=maps.sigma, depth=np.where(maps.mask, 6 + noise, 0))
    assert len(depth_mesh(noisy).quads) > 0.95 * len(depth_mesh(make()).quads)  # of four sides, one in 100 is beyond three σ
    blind = DepthMaps(camera=CAMERA, mask=maps.mask, depth=noisy.depth)
    assert len(depth_mesh(blind).quads) < 0.9 * len(depth_mesh(noisy).quads)


def test_points_without_neighbours_are_exported_alone(tmp_path):
    checker = np.where(np.indices((16, 24)).sum(axis=0) % 2, 1.0, 3.0).astype(np.float32)
    maps = DepthMaps(camera=CAMERA, mask=np.ones((16, 24), bool), depth=checker)
    with pytest.raises(AssetError, match="no neighbouring pixels lie on one surface"):
        write_depth(maps, None, tmp_path / "a.usda", name="a")
    assert list(tmp_path.iterdir()) == []
    write_depth(maps, None, tmp_path / "a.usda", name="a", geometry=Geometry.POINTS)
    assert opened(tmp_path / "a.usda").GetDefaultPrim().GetVariantSet("geo").GetVariantNames() == ["points"]


@pytest.mark.parametrize("suffix", [".usdc", ".glb"])
def test_a_mesh_of_few_pixels_is_told(relit, tmp_path, suffix):
    """As of laser stripes that lie apart."""
    maps = make()
    stripes = maps.mask & ((np.arange(24) % 3 == 0) | (np.arange(24) < 3))
    replace(maps, mask=stripes, depth=np.where(stripes, maps.depth, 0)).write(tmp_path / "depth.exr")
    outcome = relit.done("export", tmp_path, "--out", tmp_path / f"a{suffix}")
    assert f"the mesh holds 63 of {stripes.sum()} pixels with a depth" in " ".join((outcome.out + outcome.err).split())
    outcome = relit("export", tmp_path, "--out", tmp_path / f"a{suffix}", "--geometry", "points")
    assert outcome.code == 0 and "the mesh holds" not in outcome.out + outcome.err


def test_what_cannot_be_exported_is_said(tmp_path):
    maps = make()
    cloud = cloud_of(maps)
    empty = DepthMaps(camera=CAMERA, mask=np.zeros((16, 24), bool), depth=np.zeros((16, 24), np.float32))
    unknown = DepthMaps(camera=CAMERA, mask=np.ones((16, 24), bool), depth=np.full((16, 24), np.nan, np.float32))
    for found, given, geometry, words in (
            (empty, None, Geometry.POINTS, "no point"), (empty, None, Geometry.MESH, "no point"),
            (unknown, None, Geometry.POINTS, "no point"), (unknown, None, Geometry.MESH, "no point"),
            (maps, cloud._replace(points=2 * cloud.points), Geometry.MESH, "points.ply and depth.exr are not of one measurement"),
            (maps, cloud._replace(points=cloud.points + np.float32([0.5, 0, 0])), Geometry.POINTS, "measurement: .* of 381 points"),
            (empty, cloud, Geometry.POINTS, "not of one measurement"),
            (maps, PointCloud(cloud.points[:0], cloud.colours[:0]), Geometry.MESH, "not of one measurement"),
            (maps, cloud._replace(points=-cloud.points), Geometry.MESH, "not of one measurement: 0 of 381")):
        with pytest.raises(AssetError, match=words):
            write_depth(found, given, tmp_path / "a.usda", name="a", geometry=geometry)
    with pytest.raises(AssetError, match="suffix must be"):
        write_depth(maps, None, tmp_path / "a.obj", name="a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("with_cloud", [True, False])
def test_pixels_and_points_that_are_not_finite_are_left_out(tmp_path, with_cloud):
    maps = make()
    depth = maps.depth.copy()
    depth[8, 3:6] = np.nan, np.inf, 0.0
    holed = DepthMaps(camera=CAMERA, mask=maps.mask, depth=depth)
    given = cloud_of(maps)
    given.points[20], given.points[21], given.points[22] = np.nan, np.inf, (0.1, 0.0, 0.3)
    write_depth(holed, given if with_cloud else None, tmp_path / "a.usdc", name="a")
    for variant, prim in (("mesh", "Mesh"), ("points", "Points")):
        usd_stage = opened(tmp_path / "a.usdc", variant)
        points = np.array(UsdGeom.PointBased(usd_stage.GetPrimAtPath(f"/a/Geom/{prim}")).GetPointsAttr().Get())
        assert np.isfinite(points).all() and (variant == "mesh" or len(points) == 381 - 3)
        assert points[:, 2].max() < -1.1 and points[:, 2].min() > -1.3


@pytest.mark.parametrize(("geometry", "prim"), [((), "Mesh"), (("--geometry", "points"), "Points")])
def test_relit_export_takes_a_depth(relit, tmp_path, geometry, prim):
    maps = make()
    maps.write(tmp_path / "depth.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "grey.usdc", *geometry)
    assert outcome.code == 0 and "there is no points.ply beside it, which holds the colours" in outcome.out + outcome.err
    write_ply(cloud_of(maps), tmp_path / "points.ply")
    outcome = relit("export", tmp_path, "--out", tmp_path / "wall.usdc", *geometry)
    assert (outcome.code, outcome.err) == (0, "") and "grey" not in outcome.out
    assert Usd.Stage.Open(str(tmp_path / "wall.usdc")).GetPrimAtPath(f"/wall/Geom/{prim}")


def test_geometry_is_for_a_depth(relit, tmp_path, ball):
    ball.write(tmp_path / "maps.exr")
    assert "--geometry points: is for a depth" in relit.refused("export", tmp_path, "--out", tmp_path / "a.usda", "--geometry", "points")
