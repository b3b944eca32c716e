"""The light of the ground that an object lies on."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from kernels.photometric.lambertian.readings import pad_lights
from service.requests.solve import Method, SolveRequest
from service.solve.height.ground import Ground
from service.solve.height.interreflection import patches_of
from service.solve.solve import solve
from stage.capture.camera import Camera
from tests.reference.sampling import lattice
from tests.scenes.captures import angles_degrees, distant, write_lit
from tests.scenes.on_ground import ball_on_ground

SIDE, LIGHTS = 32, lattice(8, 45.0)
DISTANCE, HIGH = 4.0, 0.08
CAMERAS = {"perspective": Camera(projection="perspective", resolution=(SIDE, SIDE), focal_px=(DISTANCE * SIDE, DISTANCE * SIDE),
                                 surface_z_m=-DISTANCE),
           "orthographic": Camera(projection="orthographic", resolution=(SIDE, SIDE), pixel_size_m=1 / SIDE)}


def light_on_speck(camera, normal, *, ground, up=(0.0, 0.0, 1.0)):
    """What the ground sends to a pixel in the middle of the image. `ground`: its albedo; `up`: its normal. A pixel at the border belongs to
    the object, too, and lies HIGH below the other, so that the ground is 1.5 HIGH below that."""
    middle = SIDE // 2 * (SIDE + 1)
    mask, height = np.zeros((SIDE, SIDE), bool), np.full((SIDE, SIDE), -DISTANCE, np.float32)
    mask.flat[[middle, middle + SIDE // 2 - 1]] = True
    height.flat[middle] += HIGH
    readings = np.where(mask, 0.2, ground / np.pi * np.maximum(LIGHTS @ up, 0)[:, None, None]).reshape(len(LIGHTS), -1).astype(np.float16)
    stack = SimpleNamespace(light_count=len(LIGHTS), pick=lambda pixels: (np.tile(readings[:, pixels], (3, 1, 1)), None))
    given = SimpleNamespace(camera=camera, stack=stack, device="cpu", mask=mask)
    lights = pad_lights(LIGHTS, np.ones((len(LIGHTS), 3)))
    normals = np.repeat(np.asarray(normal, np.float32)[:, None], SIDE**2, axis=1)
    on_device = wp.array(height, device="cpu")
    patches = patches_of(given, lights, normals, on_device, mask)
    below = Ground.of(given, lights, patches)
    return None if below is None else below.light_on(patches, on_device)[:, 0]


@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("tilt", [0.0, 40.0])
def test_an_even_ground_sends_light_by_its_form_factor(camera, tilt):
    """In closed form a plane without end sends (1 - n·up) / 2 of its radiance. Tolerance: the ground is 150 times as far as it is deep, and
    what lies beyond is .2 % of that; groups of blocks and the size of the nearest, a quarter of their depth, take 4 % away."""
    up = np.array([0.0, np.sin(np.radians(tilt)), np.cos(np.radians(tilt))])
    normal = np.array([0.8, 0.0, 0.6])
    none, seen, around, far = light_on_speck(camera, normal, ground=0.5, up=up)
    whole = np.broadcast_to(0.5 / np.pi * np.maximum(LIGHTS @ up, 0) * (1 - normal @ up) / 2, far.shape)
    assert not none.any() and (seen > 0).all() and (seen < around).all() and (around < far).all()
    assert far == pytest.approx(whole, rel=0.05)


def test_dark_ground_sends_nothing():
    assert light_on_speck(CAMERAS["orthographic"], [0.6, 0.0, 0.8], ground=0.005) is None


def test_without_ground_nothing_is_sent():
    mask = np.ones((4, 4), bool)
    assert Ground.of(SimpleNamespace(mask=mask), None, None) is None


@pytest.mark.parametrize("tilt", [0.0, pytest.param(45.0, marks=pytest.mark.long)])
def test_a_ball_keeps_its_shape_on_white_ground(tmp_path, tilt):
    """Light of the ground makes the ball look flatter, by 7 and 11° in the mean, at 7 standard errors of normals (95th percentile), where
    the images do not show the ground. Those that do give a half of that at most. A speck of the ground counts as object: it is solved, and
    of no part."""
    lights = lattice(16, 65.0)
    scene = ball_on_ground(28, lights, ground=0.7, tilt_degrees=tilt)
    mask, errors = scene.mask.copy(), []
    mask[2, 2] = True
    for name, images in (("lit", scene.images), ("dark", scene.images * scene.mask)):
        folder = write_lit(tmp_path / name, images, [distant(light, 1.0) for light in lights], mask=mask,
                           camera={"projection": "orthographic", "resolution": [28, 28]})
        maps = solve(SolveRequest(capture=folder, out=folder / "out", device="cpu", method=Method.SVBRDF)).maps
        error = angles_degrees(maps.normal, scene.normal)[scene.mask]
        errors.append((error.mean(), np.percentile(error / maps.sigma[scene.mask], 95)))
        told = json.loads((folder / "out" / "report.json").read_text())["found"]["bounced_light"]
        assert ("from_ground" in told) == (name == "lit")
    (lit, surely), (dark, _) = errors
    assert lit < dark / 2 and surely < 2.5
