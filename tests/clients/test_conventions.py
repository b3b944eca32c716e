"""Camera, light and units mean the same in every program: a ball with a known picture, before any asset is believed."""

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from benchmarks.clients.by_hand import write_by_hand
from benchmarks.clients.comparison import compare
from benchmarks.clients.render import Environment, Sun
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.clients.scenes import directions, uneven

pytestmark = pytest.mark.long

SIDE = 32
ALBEDO_MAP = np.array([0.4, 0.5, 0.7]) * (1 - np.linspace(0, 0.5, SIDE))[:, None, None] * (1 - np.linspace(0, 0.3, SIDE))[None, :, None]
"""Brighter at the top and at the left."""
TOLERANCE = 0.08
"""The least specular lobe that UsdPreviewSurface has (F0 .04, roughness 1) adds up to a tenth to the darkest channel; noise of 256 paths is
some percent of a pixel, and Mitsuba's `principled` has Burley's diffuse lobe."""
LOBE = np.array([0.10, 0.07, 0.05])


def ball(camera: Camera, radius: float, centre_z: float) -> SurfaceMaps:
    """Return a white-ish ball as the camera sees it."""
    rows, cols = np.mgrid[:SIDE, :SIDE] + 0.5
    if camera.projection == "perspective":
        assert camera.focal_px is not None and camera.principal_px is not None
        ray = np.stack([(cols - camera.principal_px[0]) / camera.focal_px[0], -(rows - camera.principal_px[1]) / camera.focal_px[1],
                        -np.ones((SIDE, SIDE))], axis=-1)
        a, b, c = (ray**2).sum(-1), -2 * centre_z * ray[..., 2], centre_z**2 - radius**2
        under = b * b - 4 * a * c
        point = ray * ((-b - np.sqrt(np.maximum(under, 0))) / (2 * a))[..., None]
    else:
        assert camera.pixel_size_m is not None
        x, y = (cols - SIDE / 2) * camera.pixel_size_m, (SIDE / 2 - rows) * camera.pixel_size_m
        under = radius**2 - x * x - y * y
        point = np.stack([x, y, centre_z + np.sqrt(np.maximum(under, 0))], axis=-1)
    normal = (point - [0, 0, centre_z]) / radius
    inside = (under > 0) & (normal[..., 2] > 0.2)
    return SurfaceMaps(camera=camera, mask=inside, normal=np.where(inside[..., None], normal, 0).astype(np.float32),
                       diffuse_albedo=ALBEDO_MAP.astype(np.float32), roughness=np.ones(inside.shape, np.float32),
                       specular=np.full(point.shape, 0.04, np.float32), height=np.where(inside, point[..., 2], 0).astype(np.float32))


CAMERAS = {
    "orthographic": (Camera(projection="orthographic", resolution=(SIDE, SIDE), pixel_size_m=0.01), 0.14, 0.3),
    "perspective, turned": (Camera(projection="perspective", resolution=(SIDE, SIDE), focal_px=(60, 60), principal_px=(19, 14),
                                   surface_z_m=-0.7,
                                   world_from_camera=((0, 0, 1, 0.5), (1, 0, 0, -2), (0, 1, 0, 0.25), (0, 0, 0, 1))), 0.12, -0.8),
}


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("kind", ["environment", "sun"])
def test_a_rough_ball_has_its_closed_form(client, camera, kind, programs, tmp_path):
    view, radius, centre_z = CAMERAS[camera]
    maps = ball(view, radius, centre_z)
    asset = write_by_hand(maps, tmp_path, "ball", metal=np.zeros(maps.mask.shape))
    normal = maps.normal.astype(float)
    if kind == "environment":
        light = Environment(uneven())
        d, omega = directions(64)
        cosine = np.maximum(np.einsum("rcx,hwx->rchw", normal, d), 0)
        irradiance = np.einsum("rchw,hwk,hw->rck", cosine, light.latlong, omega)
    else:
        light = Sun((0.48, 0.6, 0.64), (3.0, 2.0, 1.0))
        irradiance = np.maximum(normal @ np.array(light.direction), 0)[..., None] * np.array(light.irradiance)
    truth = ALBEDO_MAP / np.pi * irradiance
    picture = programs.render(client, asset, view, light, samples=256)
    shown = binary_erosion(maps.mask, np.ones((3, 3)))  # a vertex lies on a pixel's centre, so the mesh fills the outermost ones in part
    np.testing.assert_allclose(picture[shown][:, 3], 1, atol=1e-3)
    assert picture[~binary_dilation(maps.mask), 3].max() < 0.01
    ratio = picture[shown][:, :3].sum(axis=0) / truth[shown].sum(axis=0)
    np.testing.assert_allclose(ratio, 1 + LOBE / 2, atol=TOLERANCE)
    for channel in range(3):  # an environment that is turned or mirrored leaves less than .3 in some channel; noise takes .03
        assert np.corrcoef(picture[shown][:, channel], truth[shown][:, channel])[0, 1] > 0.95


def test_figures_of_a_picture_count_every_pixel():
    truth = np.ones((2, 2, 3))
    metal = np.array([[1.0, 1.0], [0.0, 0.0]])
    picture = np.where(metal[..., None] > 0, 0.0, 1.0) * np.ones(3)
    found = compare(picture, truth, np.ones((2, 2), bool), metal)
    assert (found.scale, found.metal, found.dielectric, found.mean_error) == (1, 0, 1, 0.5)
    assert found.rmse == pytest.approx(0.5**0.5)
    assert compare(truth * 0.5, truth, np.ones((2, 2), bool)).scale == 2
