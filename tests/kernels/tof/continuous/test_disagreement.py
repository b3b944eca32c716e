"""Errors that nobody declared: the standard deviation covers what frequencies disagree by, and steps of the range, and nothing else."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.continuous.continuous import Noise, decode
from kernels.tof.continuous.decide import UNCALIBRATED_RAD, decide
from kernels.tof.continuous.disagreement import widen
from kernels.tof.continuous.steps import cover_steps
from kernels.tof.continuous.unwrap import unwrap
from tests.reference import tof

ROWS, COLS = 40, 50
SETTINGS = tof.even(tof.HZ, 4)


def plane(distance):
    distance = np.broadcast_to(distance, (ROWS, COLS)).astype(float)
    return tof.View(distance, np.full(distance.shape, 0.7), np.ones(distance.shape))


def solve(images, device):
    hz, delta = (np.array(column) for column in zip(*SETTINGS, strict=True))
    found = decode(images.reshape(len(SETTINGS), -1).astype(np.float32), hz, delta, noise=Noise(1.0, 5.0), device=device)

    def ranges(phases):
        return decide(phases, unwrap(phases, nearest_m=0.0, farthest_m=14.98, light_speed=tof.LIGHT), light_speed=tof.LIGHT,
                      agreement_rad=UNCALIBRATED_RAD)

    alone = ranges(found)
    widened = widen(found, alone, ROWS, COLS, light_speed=tof.LIGHT)
    return alone, ranges(widened.found), widened.further.numpy()[:ROWS * COLS], found.amplitude


def share(result, truth):
    solved = result.status.numpy()[:truth.size] == Status.OK
    return (np.abs(result.range.numpy()[:truth.size] - truth.ravel()) / result.sigma.numpy()[:truth.size])[solved]


def test_noise_alone_changes_little(device):
    view = plane(1.5 + 0.05 * np.arange(COLS))
    alone, after, further, _ = solve(tof.correlations(view, 1e5, SETTINGS, seed=1), device)
    assert np.mean(further > 0) < 0.06  # a quantile of two standard deviations, of windows that overlap
    assert np.median(share(after, view.distance)) == pytest.approx(np.median(share(alone, view.distance)), rel=0.05)


def test_wiggling_that_is_not_calibrated_is_covered(device):
    view = plane(1.5 + 0.05 * np.arange(COLS))
    alone, after, further, _ = solve(tof.correlations(view, 1e6, SETTINGS, seed=2, harmonics={3: 0.05}), device)
    assert np.mean(further > 0) > 0.8
    assert np.median(share(alone, view.distance)) > 3
    assert np.median(share(after, view.distance)) < 1.4 and np.mean(share(after, view.distance) > 5) < 0.03
    assert np.abs(after.range.numpy()[:ROWS * COLS] - view.distance.ravel()).max() < 0.2  # still the right wraps


def test_a_pixel_on_a_small_step_is_unsure_of_its_side(device):
    near, far = (tof.correlations(plane(d), 1e5, SETTINGS) for d in (2.0, 2.12))
    part = np.where(np.arange(COLS) < 25, 1.0, 0.0)
    part[25] = 0.6  # of the pixel's area; it ranges 5 cm behind its larger part
    mean = part * near + (1 - part) * far
    images = np.random.default_rng(3).poisson(mean) + np.random.default_rng(4).normal(0, 5, mean.shape)
    alone, after, _, amplitude = solve(images, device)
    sigma = cover_steps(after, amplitude, ROWS, COLS, spacing_m=1.87).numpy()[:ROWS * COLS].reshape(ROWS, COLS)
    before = alone.sigma.numpy()[:ROWS * COLS].reshape(ROWS, COLS)
    error = np.abs(after.range.numpy()[:ROWS * COLS].reshape(ROWS, COLS) - 2.0)[:, 25]
    edge = (after.status.numpy()[:ROWS * COLS].reshape(ROWS, COLS)[:, 25] == Status.OK)
    assert edge.mean() > 0.8 and np.mean((error > 5 * before[:, 25])[edge]) > 0.8 and np.mean((error > 5 * sigma[:, 25])[edge]) < 0.01
    quiet = np.abs(np.arange(COLS) - 25) > 3
    np.testing.assert_allclose(np.median(sigma[:, quiet] / before[:, quiet]), 1, atol=0.02)


def test_a_slope_is_no_step(device):
    alone, _, _, amplitude = solve(tof.correlations(plane(1.5 + 0.1 * np.arange(COLS)), 1e5, SETTINGS, seed=5), device)
    even = wp.ones_like(amplitude)
    np.testing.assert_array_equal(cover_steps(alone, even, ROWS, COLS, spacing_m=1.87).numpy(), alone.sigma.numpy())


def test_the_brighter_part_of_a_sloping_pixel_is_in_sigma(device):
    """Fields with edges inside of pixels, on a wall that recedes by 6 cm a pixel, in light whose noise is far below that."""
    fine = 1.5 + 0.06 / 8 * (np.arange(8 * COLS) + 0.5)
    albedo = np.where((np.arange(8 * COLS)[None] + 13 * np.arange(ROWS)[:, None]) // 37 % 2 > 0, 0.9, 0.15)
    view = tof.View(np.broadcast_to(fine, albedo.shape), albedo, np.ones(albedo.shape))
    mean = tof.correlations(view, 3e6, SETTINGS).reshape(len(SETTINGS), ROWS, COLS, 8).mean(axis=3)
    truth = np.broadcast_to(fine.reshape(COLS, 8).mean(axis=1), (ROWS, COLS))
    _, after, _, amplitude = solve(np.random.default_rng(6).poisson(mean), device)
    covered = after._replace(sigma=cover_steps(after, amplitude, ROWS, COLS, spacing_m=1.87))
    assert np.mean(share(after, truth) > 5) > 0.1 and np.mean(share(covered, truth) > 5) < 0.01


def test_another_size_is_refused(device):
    alone, _, _, amplitude = solve(tof.correlations(plane(2.0), 1e5, SETTINGS, seed=5), device)
    with pytest.raises(ArrayError, match="give the image's own size"):
        cover_steps(alone, amplitude, 400, 500, spacing_m=1.87)
