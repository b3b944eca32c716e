"""Normals against a surface: a ramp over a step contradicts them, noise and drift do not."""

import numpy as np
import pytest

from service.scans.fusion.bands import Bands
from service.scans.fusion.joined_normals import compared, join_normals, unlike_noise
from tests.service.scans.mesh_files import lattice_faces

PIXEL = 2e-3
COUNT = 90
STEP = 6e-3


def sheet(height):
    """Vertices of a lattice with a spacing of half a pixel, and its faces."""
    u, v = (axis.ravel() * PIXEL / 2 for axis in np.meshgrid(np.arange(COUNT), np.arange(COUNT)))
    points = np.stack([u, v, height(u, v)], axis=1)
    return points, lattice_faces(COUNT, COUNT)


MIDDLE = COUNT * PIXEL / 4


def ramp(u, v):
    """A step as range images leave it: one pixel wide."""
    return STEP * np.clip((u - MIDDLE) / PIXEL, 0, 1)


def noisy(sigma, seed):
    """Noise that neighbours within a pixel share."""
    drawn = sigma * np.random.default_rng(seed).standard_normal((COUNT // 2, COUNT // 2))
    return np.kron(drawn, np.ones((2, 2))).ravel()


def test_bands_add_up_and_a_mean_of_equal_values_is_this_value():
    points, _ = sheet(lambda u, v: 0 * u)
    values = np.random.default_rng(0).standard_normal((len(points), 2))
    bands = Bands(points, np.tile([0.0, 0, 1], (len(points), 1)), np.ones(len(points)), PIXEL)
    counts = np.random.default_rng(1).random(len(points))
    assert np.allclose(np.sum(bands.of(values, counts), axis=0), values, atol=1e-12)
    assert np.allclose(bands.averaged(np.full((len(points), 1), 3.0), 8 * PIXEL, counts), 3.0)
    counts[points[:, 0] > MIDDLE] = 0
    split = np.where(points[:, :1] > MIDDLE, 5.0, 1.0)  # what does not count is nowhere in the mean
    assert np.allclose(bands.averaged(split, 8 * PIXEL, counts)[points[:, 0] < MIDDLE], 1.0, atol=1e-6)


@pytest.mark.parametrize("drift", [0.0, 4.0])
def test_a_ramp_over_a_step_contradicts_and_nothing_else_does(drift):
    points, faces = sheet(ramp)
    sigma = np.full(len(points), 2e-4)
    points[:, 2] += noisy(2e-4, 0)
    tilt = np.radians(drift)
    normals = np.tile([np.sin(tilt), 0, np.cos(tilt)], (len(points), 1))
    found = join_normals(points, faces, sigma, normals, np.full(len(points), np.radians(0.5)), pixel_m=PIXEL)
    on = (points[:, 0] > MIDDLE) & (points[:, 0] < MIDDLE + PIXEL)
    away = np.abs(points[:, 0] - MIDDLE - PIXEL / 2) > 5 * PIXEL  # averages reach over four pixels
    # the ramp moves with what is beside it, by less than the noise that is taken from there; its normals would ask for 3 mm
    assert np.abs(found.moved[on]).max() < sigma[0] and on.sum() <= found.contradicted < (~away).sum()
    for side in (points[:, 0] < MIDDLE, points[:, 0] > MIDDLE + PIXEL):
        true = np.where(points[side, 0] > MIDDLE, STEP, 0)
        before, after = (float(np.sqrt(np.mean((each[side, 2] - true) ** 2))) for each in (points, found.points))
        assert after < 0.6 * before
    assert abs(found.drift_degrees - drift) < 0.5 * drift + 0.5  # pixels have noise of 8°, a part is 22 wide; the ramp has 71°


def test_noise_alone_is_no_contradiction():
    points, _ = sheet(lambda u, v: 0 * u)
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    bands = Bands(points, normals, np.ones(len(points)), PIXEL)
    one, other = (0.4 * np.random.default_rng(seed).standard_normal((len(points), 3)) for seed in (0, 1))
    trust = compared(bands, one, other, PIXEL)
    assert trust.agree.mean() > 0.99 and trust.counts.mean() > 0.5
    assert not compared(bands, one + [0.6, 0, 0], 0.1 * other, PIXEL).agree.any()
    sigma = np.full(len(points), 1e-3)
    move = noisy(1e-3, 2)
    assert unlike_noise(bands, move, sigma, np.ones(len(points), dtype=bool), PIXEL).mean() < 0.01
    assert unlike_noise(bands, 2.5 * move, sigma, np.ones(len(points), dtype=bool), PIXEL).all()
