"""Spikes of a height: put back where they are few, refused where they are many, and never seen in steep but sound surfaces."""

import dataclasses

import numpy as np
import pytest

from service.asset.content.mesh import height_mesh
from service.asset.content.repair import repair_heights
from service.errors import AssetError
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_sheet

ORTHOGRAPHIC = Camera(projection="orthographic", resolution=(80, 60), pixel_size_m=0.002)
PERSPECTIVE = Camera(projection="perspective", resolution=(80, 60), focal_px=(150.0, 160.0), surface_z_m=-0.4)
cameras = pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PERSPECTIVE], ids=["orthographic", "perspective"])


def plane(camera: Camera, tilt=(0.5, -0.8, 1.0)) -> SurfaceMaps:
    """A tilted plane, in two parts of which the right one stands 30 pixels before the left."""
    n = np.asarray(tilt) / np.linalg.norm(tilt)
    x, y = camera.plane_coordinates()
    part = np.where(np.arange(80) < 50, 1, 2) * np.ones((60, 1), int)
    if camera.projection == "orthographic":
        z = -(n[0] * x + n[1] * y) / n[2] + 0.06 * (part == 2)
    else:
        z = (n[2] * -0.4) / (n[2] - n[0] * x - n[1] * y) * np.where(part == 2, 0.8, 1)
    return SurfaceMaps(camera=camera, mask=np.ones(part.shape, bool), height=z.astype(np.float32), part=part.astype(np.uint8),
                       normal=np.broadcast_to(n.astype(np.float32), (*part.shape, 3)))


def spiked(maps: SurfaceMaps, count: int, seed: int = 0) -> tuple[SurfaceMaps, np.ndarray]:
    """The maps with single pixels moved by 5 to 50 pixels along the line of sight, and where."""
    rng = np.random.default_rng(seed)
    where = np.zeros(maps.mask.shape, bool)
    where.reshape(-1)[rng.choice(where.size, count, replace=False)] = True
    pixel = 0.002 if maps.camera.projection == "orthographic" else 0.4 / 150
    moved = rng.uniform(5, 50, where.shape) * rng.choice([-1, 1], where.shape) * pixel
    return dataclasses.replace(maps, height=np.where(where, maps.height + moved, maps.height).astype(np.float32)), where


@cameras
def test_spikes_are_put_back_along_the_normals(camera):
    maps = plane(camera)
    bad, where = spiked(maps, 60)
    bad.height[30:32, 20:23] -= 0.05  # a spike of six pixels
    where[30:32, 20:23] = True
    repaired = repair_heights(bad)
    assert repaired.spikes == where.sum()
    assert f"{where.sum()} pixels stood off" in repaired.warnings[0]
    np.testing.assert_array_equal(repaired.maps.height[~where], maps.height[~where])  # nothing else is touched, to the bit
    # relief is linear on a plane for an orthographic camera; ln of depth bends by (slope / 150)² a pixel, over three pixels
    np.testing.assert_allclose(repaired.maps.height, maps.height, atol=2e-8 if camera.projection == "orthographic" else 2e-4)
    assert height_mesh(repaired.maps).centred == maps.mask.sum()


def test_a_few_spikes_are_no_warning():
    maps = plane(ORTHOGRAPHIC)
    repaired = repair_heights(spiked(maps, 3)[0])
    assert (repaired.spikes, repaired.warnings) == (3, ())


@cameras
def test_a_height_of_another_surface_is_refused(camera):
    with pytest.raises(AssetError, match=r"more than 5% of the pixels.*--method svbrdf"):
        repair_heights(spiked(plane(camera), 600)[0])


def test_islands_are_told():
    mask = np.zeros((40, 40), bool)
    mask[:20] = True
    mask[24::4, ::4] = True
    maps = make_sheet(mask, normal=np.broadcast_to(np.float32([0, 0, 1]), (40, 40, 3)))
    repaired = repair_heights(maps)
    assert repaired.maps is maps
    (warning,) = repaired.warnings
    assert warning.startswith(f"geometry: {4 * 10} pixels are left out") and "fewer than 8 pixels" in warning


@cameras
@pytest.mark.parametrize("noise_degrees", [0, 4])
def test_steep_surfaces_are_left_alone(camera, noise_degrees):
    """A plane of 72 degrees with a break, and a sphere to its limb, with normals that are wrong by some degrees."""
    steep = plane(camera, (2.5, 1.5, 1.0)) if camera.projection == "orthographic" else plane(camera)
    x, y = ORTHOGRAPHIC.plane_coordinates()
    r2 = (x**2 + y**2) / 0.055**2
    normal = np.stack([x / 0.055, y / 0.055, np.sqrt(np.maximum(1 - r2, 0))], axis=-1)
    height = (0.055 * normal[..., 2]).astype(np.float32)
    ball = SurfaceMaps(camera=ORTHOGRAPHIC, mask=r2 < 1, normal=normal.astype(np.float32), height=height)
    for maps in (steep, ball):
        wrong = maps.normal + np.random.default_rng(1).normal(size=maps.normal.shape) * np.radians(noise_degrees)
        wrong /= np.linalg.norm(wrong, axis=-1, keepdims=True)
        repaired = repair_heights(dataclasses.replace(maps, normal=wrong.astype(np.float32)))
        assert (repaired.spikes, repaired.warnings) == (0, ())


def test_without_normals_nothing_is_judged():
    maps = dataclasses.replace(plane(ORTHOGRAPHIC), normal=None)
    assert repair_heights(spiked(maps, 30)[0]).spikes == 0
    with pytest.raises(AssetError, match="no height layer"):
        repair_heights(dataclasses.replace(maps, height=None))
