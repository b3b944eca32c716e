"""The USD camera sees every vertex on its own pixel."""

import dataclasses

import numpy as np
import pytest
from pxr import Usd, UsdGeom

from service.asset.content.mesh import height_mesh
from service.asset.usd.asset import write_asset
from service.asset.usd.scene import PARALLAX_PX
from tests.scenes.surfaces import make_ball, make_wave

POSE = ((0.0, 0.0, 1.0, 0.3), (1.0, 0.0, 0.0, -0.1), (0.0, 1.0, 0.0, 2.0), (0.0, 0.0, 0.0, 1.0))


SCENES = {
    "centred": make_ball(), "no scale": make_wave("orthographic"),
    "posed": make_wave("orthographic", pixel_size_m=0.01, world_from_camera=POSE),
    "posed without scale": make_wave("orthographic", world_from_camera=POSE), "perspective": make_wave("perspective"),
    "perspective posed": make_wave("perspective", world_from_camera=POSE), "no depth": make_wave("perspective", surface_z_m=None),
}


def pixels_of_vertices(usd_stage, name, resolution):
    """Where OpenUSD's frustum of a camera shows the vertices, [n, 2] pixels, and their depths between its planes, -1…1."""
    frustum = UsdGeom.Camera(usd_stage.GetPrimAtPath(f"/A/{name}")).GetCamera(Usd.TimeCode.Default()).frustum
    usd_mesh = UsdGeom.Mesh(usd_stage.GetPrimAtPath("/A/Geom/Mesh"))
    to_world = UsdGeom.XformCache().GetLocalToWorldTransform(usd_mesh.GetPrim())
    to_clip = np.array(to_world * frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix())  # row vectors
    points = np.array(usd_mesh.GetPointsAttr().Get(), dtype=np.float64)
    clip = np.column_stack([points, np.ones(len(points))]) @ to_clip
    x, y, depth = (clip[:, :3] / clip[:, 3:]).T
    return np.column_stack([(x + 1) / 2, (1 - y) / 2]) * resolution, depth


@pytest.mark.parametrize("scene", SCENES)
def test_vertices_project_onto_their_pixels(scene, tmp_path):
    maps = SCENES[scene]
    write_asset(maps, tmp_path / "a.usdc", name="A")
    shown, depth = pixels_of_vertices(Usd.Stage.Open(str(tmp_path / "a.usdc")), "Camera", maps.camera.resolution)
    wanted = np.column_stack([height_mesh(maps).st[:, 0], 1 - height_mesh(maps).st[:, 1]]) * maps.camera.resolution
    np.testing.assert_allclose(shown, wanted, atol=1e-3)  # apertures and points are float32
    assert depth.min() > -1 and depth.max() < 1  # nothing is clipped away


@pytest.mark.parametrize("scene", SCENES)
def test_a_far_perspective_camera_stands_in_for_an_orthographic_one(scene, tmp_path):
    maps = SCENES[scene]
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    if maps.camera.projection == "perspective":
        assert not usd_stage.GetPrimAtPath("/A/CameraPerspective")
        return
    assert UsdGeom.Camera(usd_stage.GetPrimAtPath("/A/CameraPerspective")).GetProjectionAttr().Get() == "perspective"
    shown, depth = pixels_of_vertices(usd_stage, "CameraPerspective", maps.camera.resolution)
    wanted = np.column_stack([height_mesh(maps).st[:, 0], 1 - height_mesh(maps).st[:, 1]]) * maps.camera.resolution
    assert np.linalg.norm(shown - wanted, axis=1).max() < PARALLAX_PX * 1.05  # float32 of the aperture and the points
    assert depth.min() > -1 and depth.max() < 1


def test_the_camera_does_not_widen_the_bounding_box(tmp_path):
    maps = dataclasses.replace(make_ball(), normal=None)
    write_asset(maps, tmp_path / "a.usdc", name="A")
    usd_stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(usd_stage.GetDefaultPrim())
    extent = height_mesh(maps).extent
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMin(), extent[0])
    np.testing.assert_allclose(box.ComputeAlignedRange().GetMax(), extent[1])
