"""The USD camera sees every vertex on its own pixel."""

import dataclasses

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from service.asset.mesh import height_mesh
from service.usd.asset import write_asset
from tests.scenes.surfaces import make_ball, make_wave

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))


@pytest.mark.parametrize("maps", [
    make_ball(),
    make_wave("orthographic"),
    make_wave("orthographic", pixel_size_m=0.01, world_from_camera=POSE),
    make_wave("orthographic", world_from_camera=POSE),
    make_wave("perspective"),
    make_wave("perspective", world_from_camera=POSE),
    make_wave("perspective", surface_z_m=None),
], ids=["centred", "no scale", "posed", "posed without scale", "perspective", "perspective posed", "no depth"])
def test_vertices_project_onto_their_pixels(maps, tmp_path):
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    frustum = UsdGeom.Camera(usd_stage.GetPrimAtPath("/A/Camera")).GetCamera(Usd.TimeCode.Default()).frustum
    usd_mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/A/Geom/Mesh"))
    to_world = UsdGeom.XformCache().GetLocalToWorldTransform(usd_mesh.GetPrim())
    to_clip = np.array(to_world * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())  # row vectors

    points = np.array(usd_mesh.GetPointsAttr().Get(), dtype=np.float64)
    clip = np.column_stack([points, np.ones(len(points))]) @ to_clip
    x, y, depth = (clip[:, :3] / clip[:, 3:]).T
    width, height = maps.camera.resolution
    mesh = height_mesh(maps)
    np.testing.assert_allclose((x + 1) / 2 * width, mesh.st[:, 0] * width, atol=1e-3)  # apertures and points are float32
    np.testing.assert_allclose((1 - y) / 2 * height, (1 - mesh.st[:, 1]) * height, atol=1e-3)
    assert depth.min() > -1 and depth.max() < 1  # nothing is clipped away


def test_the_camera_does_not_widen_the_bounding_box(tmp_path):
    maps = dataclasses.replace(make_ball(), normal=None)
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(usd_stage.GetDefaultPrim())
    extent = height_mesh(maps).extent
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMin(), extent[0])
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMax(), extent[1])
