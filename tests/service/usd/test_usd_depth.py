"""Depths as USD: points and meshes with colours, nothing bridged over a break."""

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdValidation

from service.asset.depth_mesh import depth_mesh
from service.asset.errors import AssetError
from service.usd.depth_asset import write_depth_mesh, write_depth_points
from stage.camera import Camera
from stage.depth_maps import DepthMaps
from stage.ply import PointCloud

SUFFIXES = (".usda", ".usdc", ".usdz")
CAMERA = Camera.model_validate({"projection": "perspective", "resolution": [24, 16], "focal_px": [40.0, 40.0]})


def make(broken=False):
    depth = np.full((16, 24), 1.2, np.float32) + 0.002 * np.arange(24, dtype=np.float32)
    if broken:
        depth[:, 12:] += 0.8
    mask = np.ones((16, 24), bool)
    mask[0, 0] = False
    return DepthMaps(camera=CAMERA, mask=mask, depth=np.where(mask, depth, 0), provenance={"relit:capture": "wall"})


def cloud_of(maps, normals=False):
    points = CAMERA.points(-maps.depth)[maps.mask]
    colours = np.linspace(0, 255, 3 * len(points)).reshape(-1, 3).astype(np.uint8)
    return PointCloud(points, colours, np.tile(np.float32([0, 0, 1]), (len(points), 1)) if normals else None)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("write", [write_depth_points, write_depth_mesh])
@pytest.mark.parametrize("known", [True, False])
def test_validators_find_nothing(tmp_path, suffix, write, known):
    maps = make()
    write(maps, cloud_of(maps, normals=True) if known else None, tmp_path / f"wall{suffix}", name="Wall")
    usd_stage = Usd.Stage.Open(str(tmp_path / f"wall{suffix}"))
    errors = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators()).Validate(usd_stage)
    assert [(e.GetName(), e.GetMessage()) for e in errors] == []
    assert UsdGeom.GetStageMetersPerUnit(usd_stage) == 1.0
    beside = set() if suffix == ".usdz" else {"wall_layers"}
    assert {path.name for path in tmp_path.iterdir()} == {f"wall{suffix}", *beside}


def test_points_keep_place_colour_and_normal(tmp_path):
    maps = make()
    cloud = cloud_of(maps, normals=True)
    write_depth_points(maps, cloud, tmp_path / "wall.usdc", name="Wall")
    usd_stage = Usd.Stage.Open(str(tmp_path / "wall.usdc"))
    points = UsdGeom.Points(usd_stage.GetPrimAtPath("/Wall/Geom/Points"))
    assert (np.array(points.GetPointsAttr().Get()) == cloud.points).all()
    assert (np.array(points.GetNormalsAttr().Get()) == cloud.normals).all()
    level = cloud.colours / 255
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    assert np.abs(np.array(points.GetDisplayColorAttr().Get()) - linear).max() < 1e-4
    assert np.allclose(points.GetWidthsAttr().Get(), 1.5 * maps.depth[maps.mask] / 40, rtol=1e-5)


def test_a_mesh_is_not_bridged_over_a_break(tmp_path):
    whole, broken = depth_mesh(make()), depth_mesh(make(broken=True))
    assert whole.centred == broken.centred == 16 * 24 - 1
    assert np.ptp(whole.points[whole.quads][..., 2], axis=1).max() < 0.1 and np.isin(whole.cols[whole.quads], [11, 12]).all(axis=1).any()
    faces = [*broken.quads, *broken.triangles]
    assert all(np.ptp(broken.points[face, 2]) < 0.1 for face in faces)
    assert not any({11, 12} <= set(broken.cols[face].tolist()) for face in faces)
    maps = make(broken=True)
    write_depth_mesh(maps, cloud_of(maps), tmp_path / "wall.usda", name="Wall")
    usd_stage = Usd.Stage.Open(str(tmp_path / "wall.usda"))
    mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/Wall/Geom/Mesh"))
    assert len(mesh.GetDisplayColorAttr().Get()) == len(mesh.GetPointsAttr().Get()) == len(broken.points)


def test_what_cannot_be_exported_is_said(tmp_path):
    maps = make()
    empty = DepthMaps(camera=CAMERA, mask=np.zeros((16, 24), bool), depth=np.zeros((16, 24), np.float32))
    with pytest.raises(AssetError, match="no point"):
        write_depth_points(empty, None, tmp_path / "a.usda", name="a")
    with pytest.raises(AssetError, match="no three of them are neighbours"):
        write_depth_mesh(empty, None, tmp_path / "a.usda", name="a")
    checker = np.where(np.indices((16, 24)).sum(axis=0) % 2, 1.0, 3.0).astype(np.float32)
    with pytest.raises(AssetError, match="no neighbouring pixels lie on one surface"):
        write_depth_mesh(DepthMaps(camera=CAMERA, mask=np.ones((16, 24), bool), depth=checker), None, tmp_path / "a.usda", name="a")
    with pytest.raises(AssetError, match="suffix must be"):
        write_depth_mesh(maps, None, tmp_path / "a.obj", name="a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("geometry", "prim"), [((), "Mesh"), (("--geometry", "points"), "Points")])
def test_relit_export_takes_a_depth(relit, tmp_path, geometry, prim):
    make().write(tmp_path / "depth.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "wall.usdc", *geometry)
    assert (outcome.code, outcome.err) == (0, "")
    usd_stage = Usd.Stage.Open(str(tmp_path / "wall.usdc"))
    assert usd_stage.GetPrimAtPath(f"/wall/Geom/{prim}")


def test_geometry_is_for_a_depth(relit, tmp_path, ball):
    ball.write(tmp_path / "maps.exr")
    outcome = relit("export", tmp_path, "--out", tmp_path / "a.usda", "--geometry", "points")
    assert outcome.code == 2 and "--geometry points: is for a depth" in outcome.err
    outcome = relit("export", tmp_path / "nothing", "--out", tmp_path / "a.usda")
    assert outcome.code == 2 and "run `relit solve` or `relit depth` first" in outcome.err
