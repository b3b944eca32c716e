"""Disc lights: energy in closed form, evenness of the samples, and the same weighting as a lat-long map of the same sun."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.model.sources import disc_samples
from service.relight.weights.weighting import integrate, integrate_discs
from service.requests.relight import LightWeights
from tests.reference.relight import texel_directions, texel_solid_angles

AXES = np.concatenate([np.eye(3), -np.eye(3)])
"""Six lights whose cells are the faces of a cube."""
BOTH = pytest.mark.parametrize("weighting", list(LightWeights))


@pytest.mark.parametrize("angle", [0.0, 0.53, 10.0, 90.0, 180.0])
@pytest.mark.parametrize("middle", [(0, 0, 1), (0.6, -0.48, 0.64), (0, -1, 0)])
def test_samples_fill_the_disc_evenly(middle, angle):
    samples = disc_samples(np.array(middle, dtype=float), angle)
    assert np.allclose(np.linalg.norm(samples, axis=1), 1)
    cosine = samples @ middle
    rim = np.cos(np.radians(angle / 2))
    assert cosine.min() >= rim - 1e-12
    # equal areas: cosines are evenly spread between the rim and 1, and their mean, which is how cosine falls, is half way
    assert cosine.mean() == pytest.approx((1 + rim) / 2, abs=1e-12)
    across = samples - cosine[:, None] * np.array(middle)
    assert np.linalg.norm(across.mean(axis=0)) < 0.01 * np.sin(np.radians(angle / 2)) + 1e-12  # one part in 256, and its spiral


@BOTH
@pytest.mark.parametrize("angle", [0.0, 1.0, 60.0, 120.0, 180.0])
def test_a_facing_surface_gets_an_irradiance_of_one(weighting, angle):
    """L = E / (π sin²(a)), a half the angle, over a solid angle of 2π (1 − cos a)."""
    energy = integrate_discs(np.array([[0.48, 0.6, 0.64]]), np.array([angle]), AXES, weighting=weighting)
    half = np.radians(angle / 2)
    total = 1.0 if angle == 0 else 2 * np.pi * (1 - np.cos(half)) / (np.pi * np.sin(half) ** 2)
    assert energy.shape == (1, 6)
    assert energy.sum() == pytest.approx(total, rel=1e-12)


@BOTH
def test_a_small_disc_at_a_light_is_that_light(weighting):
    energy = integrate_discs(AXES, np.full(6, 0.01), AXES, weighting=weighting)
    # the disc's mean distance from the light, 6e-5 radians, goes to the neighbours where the weighting is smooth
    assert np.allclose(energy, np.eye(6), atol=1e-4)


@BOTH
def test_a_disc_is_shared_out_as_a_map_of_it(weighting):
    rng = np.random.default_rng(4)
    lights = rng.normal(size=(20, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True)
    middle, angle = np.array([0.36, 0.48, 0.8]), 40.0
    inside = texel_directions(360, 720) @ middle > np.cos(np.radians(angle / 2))
    radiance = inside / (np.pi * np.sin(np.radians(angle / 2)) ** 2)
    sky = np.repeat(radiance[..., None], 3, axis=2)
    theirs = integrate(sky, lights, np.eye(3)[None], weighting=weighting, device="cpu")[0, :, 0]
    ours = integrate_discs(middle[None], np.array([angle]), lights, weighting=weighting)[0]
    assert theirs.sum() == pytest.approx((radiance * texel_solid_angles(360, 720)).sum(), rel=1e-9)
    assert np.allclose(ours, theirs, atol=0.005 * ours.sum())  # texels cut the rim in steps, samples of a degree the borders


@BOTH
def test_a_disc_that_moves_changes_lights_without_a_jump(weighting):
    turn = np.radians(np.linspace(40, 50, 201))
    middles = np.stack([np.sin(turn), np.zeros_like(turn), np.cos(turn)], axis=1)
    energy = integrate_discs(middles, np.full(201, 2.0), AXES, weighting=weighting)
    assert energy[0].argmax() == 2 and energy[-1].argmax() == 0
    # the disc is 2 degrees wide and moves a twentieth of one: 3 % of its area at the middle, and two rows of samples
    assert np.abs(np.diff(energy, axis=0)).max() < 0.05


@pytest.mark.parametrize(("middles", "angles", "directions", "words"), [
    (np.zeros((1, 2)), np.zeros(1), AXES, r"middles are \(1, 2\)"),
    (np.zeros((1, 3)), np.zeros(2), AXES, r"angles \(2,\)"),
    (np.zeros((1, 3)), np.zeros(1), AXES[:0], r"directions are \(0, 3\)"),
])
def test_bad_calls(middles, angles, directions, words):
    with pytest.raises(ArrayError, match=words):
        integrate_discs(middles, angles, directions, weighting=LightWeights.CELLS)


def test_the_lat_long_map_of_the_reference_has_the_axes_of_openexr():
    # 4 columns: their centres lie 1/8, 3/8, 5/8, 7/8 of a turn from the left edge, which is -z; a quarter is +x, the middle +z
    d = texel_directions(2, 4)
    up, half = np.cos(np.pi / 4), 0.5
    assert np.allclose(d[0], [(half, up, -half), (half, up, half), (-half, up, half), (-half, up, -half)])
    assert np.allclose(d[1, 3], (-half, -up, -half))
    # the midpoint rule on sin over [0, π] is π/(2H)/sin(π/(2H)) too large: 1e-4 at 64 rows
    step = np.pi / (2 * 64)
    assert texel_solid_angles(64, 128).sum() == pytest.approx(4 * np.pi * step / np.sin(step), rel=1e-12)
