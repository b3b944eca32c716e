"""Turns of all lights by slopes of normals, where these do not tell them."""

import numpy as np
import pytest

from service.solve.lights.slope_turn import turn_by_slopes
from stage.capture.camera import Camera

SIDE = 96


@pytest.mark.parametrize("seed", [0, 2, 6, 8, 9])
def test_noise_of_a_cylinder_is_no_turn_about_its_axis(seed):
    """Slopes of a cylinder that is turned about its axis are those of another height. Steps from turn to turn did not settle, and the last
    of them, of 23 to 72°, was accused where lights were right."""
    draw = np.random.default_rng(seed)
    place = (np.arange(SIDE) + 0.5) * 2 / SIDE - 1
    x, y = np.meshgrid(place, -place)
    across = np.radians(draw.uniform(0, 180))
    aside = x * np.cos(across) + y * np.sin(across)
    normal = np.stack([aside * np.cos(across), aside * np.sin(across), np.sqrt(np.maximum(1 - aside**2, 0.1))])
    normal += 0.03 * draw.normal(size=normal.shape)
    normal /= np.linalg.norm(normal, axis=0)
    camera = Camera(projection="orthographic", resolution=(SIDE, SIDE), pixel_size_m=2 / SIDE)
    assert turn_by_slopes(normal.reshape(3, -1), np.abs(aside) < 0.9, camera) is None
