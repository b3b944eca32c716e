"""Where normals point along an outline, and which pixels a height shadows."""

import numpy as np
import pytest

from service.light_estimation.object_outline import cast_shadows, outline
from tests.scenes.ellipsoid import ellipsoid


def planes(scene):
    return np.where(scene.mask, np.moveaxis(scene.normal, -1, 0), 0)


def test_an_object_points_outwards_and_its_hollow_inwards():
    scene = ellipsoid()
    out = outline(planes(scene), scene.mask)
    assert out.outward > 0.85 and out.inward_part == 0 and out.pixels > 100
    into = outline(planes(ellipsoid(hollow=True)), scene.mask)
    assert into.outward == pytest.approx(-out.outward, abs=1e-6) and into.inward_part == 1


def test_the_border_of_the_image_is_no_outline():
    scene = ellipsoid()
    assert outline(planes(scene)[:, 20:50, 20:50], scene.mask[20:50, 20:50]).pixels == 0
    assert outline(planes(scene)[:, :, :36], scene.mask[:, :36]).pixels < outline(planes(scene), scene.mask).pixels


def test_a_wall_shadows_as_far_as_it_is_high():
    height = np.zeros((20, 60))
    height[:, 30] = 12.0
    mask, pixels = np.ones(height.shape, bool), 10 * 60 + np.arange(60)
    light = np.array([1.0, 0.0, 1.0]) / np.sqrt(2)  # from the right, 45 degrees up
    hidden = cast_shadows(height, mask, pixels, np.stack([light, light * [-1, 1, 1], [0, 0, 1.0], -light]))
    assert hidden.shape == (4, 60)
    # the height of the wall, less the lift of one pixel and a twentieth of the way; steps grow to 1.1 pixels there
    assert set(range(21, 29)) <= set(np.flatnonzero(hidden[0])) <= set(range(19, 29))
    assert set(range(32, 40)) <= set(np.flatnonzero(hidden[1])) <= set(range(32, 42))
    assert not hidden[2:].any()


def test_rows_run_down_and_y_up():
    height = np.zeros((60, 20))
    height[30] = 12.0
    up = np.array([0.0, 1.0, 1.0]) / np.sqrt(2)
    hidden = cast_shadows(height, np.ones(height.shape, bool), np.arange(60) * 20 + 10, up[None])
    assert hidden[0, 33:39].all() and not hidden[0, :30].any()


def test_outside_the_mask_nothing_casts_a_shadow():
    height = np.zeros((20, 60))
    height[:, 30] = 12.0
    mask = np.ones(height.shape, bool)
    mask[:, 30] = False
    assert not cast_shadows(height, mask, 10 * 60 + np.arange(29), np.array([[0.7, 0.0, 0.7]])).any()
