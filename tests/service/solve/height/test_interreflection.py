from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from kernels.photometric.lambertian.readings import pad_lights
from service.solve.height.interreflection import arriving_light
from stage.capture.camera import Camera

SIDE, LONELY = 12, (2, 3)


def thrown(solved):
    """The light that a bent wall a metre before a perspective camera throws on itself; one pixel of the image has no height."""
    camera = Camera(projection="perspective", resolution=(SIDE, SIDE), focal_px=(SIDE, SIDE), surface_z_m=-1.0)
    across = np.linspace(-1, 1, SIDE)
    height = np.broadcast_to(-1 - 0.3 * np.abs(across), (SIDE, SIDE)).astype(np.float32).copy()
    height[LONELY] = 0
    slopes = np.stack([-0.3 * np.sign(across), np.zeros(SIDE), np.ones(SIDE)]) / np.hypot(0.3, 1)
    normal = np.repeat(slopes[:, None], SIDE, axis=1).reshape(3, -1).astype(np.float32)
    stack = SimpleNamespace(light_count=1, pick=lambda pixels: (np.ones((3, 8, len(pixels)), np.float16), None))
    given = SimpleNamespace(camera=camera, stack=stack, device="cpu")
    lights = pad_lights(np.array([[0.0, 0.0, 1.0]]), np.ones((1, 3)))
    return arriving_light(given, lights, normal, wp.array(height, device="cpu"), solved)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_solved_pixel_without_height_throws_no_light():
    """It would stand at the camera, in whose direction nothing points."""
    everywhere = np.ones((SIDE, SIDE), dtype=bool)
    others = everywhere.copy()
    others[LONELY] = False
    found, wanted = thrown(everywhere), thrown(others)
    assert wanted.light.min() >= 0 and wanted.light.max() > 0
    np.testing.assert_array_equal(found.light, wanted.light)
    np.testing.assert_array_equal(found.numbers, wanted.numbers)
    assert found.numbers[LONELY] == -1
