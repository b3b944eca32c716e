"""Surfaces that break inside the mask."""

import numpy as np
import pytest

from tests.kernels.surface import shapes
from tests.kernels.surface.test_integrate import solve, worst


def shape_error(height, truth, part):
    """Standard deviation of the error within one part: its shape, whatever its depth."""
    return (height - truth)[part].std()


def test_torn_sheet_is_found_up_to_its_tip(device):
    shape = shapes.torn_sheet(96)
    plain = worst(solve(shape, device), shape)
    assert plain > 0.3
    broken = solve(shape, device, discontinuities=True)
    assert worst(broken, shape) < 1e-3  # only the first pixels of the tear, less than 0.01 pixel open, hold together


def test_tear_is_found_under_noise(device):
    shape = shapes.torn_sheet(96)
    noise = np.random.default_rng(0).normal(0, 0.01, shape.normal.shape)
    noisy = shape._replace(normal=(shape.normal + noise).astype(np.float32))
    assert worst(solve(noisy, device, discontinuities=True), shape) < 0.01


def test_ball_keeps_its_shape_before_a_wall(device):
    shape, ball = shapes.ball_before_wall(192)
    plain = solve(shape, device).height.numpy()
    broken = solve(shape, device, discontinuities=True).height.numpy()
    for part in (ball, ~ball):
        assert shape_error(broken, shape.z, part) < 0.4 * shape_error(plain, shape.z, part)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_smooth_surface_stays(noise, device):
    shape = shapes.bumps(128, shapes.ragged_mask(128, 128))
    normal = shape.normal + np.random.default_rng(0).normal(0, 1, shape.normal.shape) * noise
    shape = shape._replace(normal=normal.astype(np.float32))
    plain = solve(shape, device).height.numpy()
    broken = solve(shape, device, discontinuities=True).height.numpy()
    ours, theirs = ((h - shape.z)[shape.mask].std() for h in (broken, plain))
    assert ours < 1.1 * theirs
