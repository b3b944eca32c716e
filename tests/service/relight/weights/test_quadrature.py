"""Kernel quadrature: against the least expected error over all sets of lights, closed forms, and the other two weightings."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels.errors import ArrayError
from kernels.relight.model.beyond import share_beyond
from kernels.relight.weights.cells import integrate_cells
from service.relight.weights.quadrature import integrate_kernel, layer_parts, share_kernel
from service.relight.weights.triangulation import share_smooth
from service.relight.weights.weighting import integrate_smooth
from tests.kernels.relight.lights import AXES, CUBE, STILL, SUM, dodecahedron, icosahedron, ring, scattered, sun, turn
from tests.marks import first_short
from tests.reference.relight import best_weights, matern, rotation_about_y, samples, texel_directions, texel_solid_angles
from tests.reference.sampling import lattice

ROUNDING = 1e-9
"""Error of the inverse of a well-conditioned matrix, relative to the sum of the weights."""
SAMPLED = 2e-3
"""Part of the whole energy by which a light is off because a map is cut into 2048 samples; it is .0004 where an even sky is bright."""
DOME = lattice(300, 180)[lattice(300, 180)[:, 2] > 0]


def lobes(rng, rows=64, cols=128):
    """A map of three soft lights over a dim sky."""
    radiance = np.full((rows, cols, 3), 0.05)
    for _ in range(3):
        middle = rng.normal(size=3)
        towards = texel_directions(rows, cols) @ (middle / np.linalg.norm(middle))
        radiance += np.exp(20 * (towards - 1))[..., None] * rng.uniform(0.5, 2, 3)
    return radiance


@pytest.mark.parametrize("directions", [AXES, scattered(40, 1), lattice(128, 180), lattice(60, 45), DOME],
                         ids=["axes", "scattered", "even", "cone", "dome"])
def test_light_from_a_captured_direction_is_that_image(directions):
    for light in range(0, len(directions), 5):
        given = share_kernel(directions[light][None], np.array([[2.0]]), directions)[:, 0]
        np.testing.assert_allclose(given, 2.0 * (np.arange(len(directions)) == light), atol=10 * ROUNDING)


@pytest.mark.parametrize("seed", range(4))
def test_no_other_weights_that_are_not_negative_expect_less_error(seed):
    """Truth: the best of the solutions on each of the 255 sets of lights."""
    rng = np.random.default_rng(seed)
    directions, towards, energy = CUBE + 0.2 * scattered(8, seed), CUBE[:3] + 0.4 * scattered(3, seed + 50), rng.random((3, 1))
    directions, towards = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (directions, towards))
    assert (share_beyond(directions, towards) == 0).all()
    given = share_kernel(towards, energy, directions)[:, 0]
    np.testing.assert_allclose(given, best_weights(towards, energy[:, 0], directions), atol=ROUNDING)


@pytest.mark.long
@pytest.mark.parametrize("directions", [scattered(300, 3), lattice(128, 180), DOME])
def test_many_lights_meet_the_conditions_of_the_best_weights(directions):
    """Karush, Kuhn and Tucker: the derivative of the expected error is the same at all lights in use, and no less at the others."""
    towards = directions[::17] + 0.05 * scattered(len(directions[::17]), 9)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    energy = np.random.default_rng(1).random((len(towards), 3)) ** 4  # other lights are held at zero in each channel
    given = share_kernel(towards, energy, directions)
    assert (given == 0).any(axis=0).all() and given.min() >= 0
    slope = matern(directions, directions) @ given - matern(directions, towards, of=directions) @ energy
    for channel in range(3):
        used, rounding = given[:, channel] > 0, 1e-8 * energy[:, channel].sum()
        assert np.ptp(slope[used, channel]) < rounding
        assert slope[~used, channel].min() > slope[used, channel].max() - rounding


@settings(max_examples=40, deadline=None)
@given(count=st.integers(1, 40), seed=st.integers(0, 1000))
def test_energy_is_kept_and_no_weight_is_negative(count, seed):
    rng = np.random.default_rng(seed)
    towards, energy = scattered(30, seed + 1), rng.gamma(0.3, 1.0, (30, 3))
    given = share_kernel(towards, energy, scattered(count, seed))
    assert given.min() >= 0
    np.testing.assert_allclose(given.sum(axis=0), energy.sum(axis=0), rtol=SUM)


@pytest.mark.parametrize("directions", [AXES, CUBE, icosahedron(), dodecahedron(), ring(8, 0), ring(2, 30)])
def test_symmetric_lights_share_an_even_sky_equally(directions):
    given = integrate_kernel(np.full((90, 180, 3), 2.5), directions, STILL)[0]
    np.testing.assert_allclose(given, 2.5 * 4 * np.pi / len(directions), rtol=0.02)  # samples of 5° do not have the lights' symmetry
    assert given.sum(axis=0) == pytest.approx(2.5 * texel_solid_angles(90, 180).sum(), rel=SUM)


@first_short("seed", range(3))
@pytest.mark.parametrize("lights, part", [(lattice(60, 180), 0.1), (None, 0.75)], ids=["even", "scattered"])
def test_shading_is_integrated_more_exactly_than_by_cells_and_smooth(lights, part, seed):
    """Truth: ∫ L (1 + n·ω)³ dω over the texels, for 20 normals. Scattered lights leave holes, whose light is shared as by smooth."""
    environment, normals = lobes(np.random.default_rng(seed)), scattered(20, seed + 9)
    directions = scattered(60, seed) if lights is None else lights

    def shading(towards):
        return (1 + towards @ normals.T) ** 3

    light = (environment * texel_solid_angles(64, 128)[..., None]).reshape(-1, 3)
    truth = light.T @ shading(texel_directions(64, 128).reshape(-1, 3))

    def error(energy):
        return float(np.sqrt(np.mean((energy[0].T @ shading(directions) - truth) ** 2) / np.mean(truth**2)))

    kernel = error(integrate_kernel(environment, directions, STILL))
    for other in (integrate_smooth, integrate_cells):
        assert kernel < part * error(other(environment, directions, STILL, device="cpu").energy)


@pytest.mark.parametrize("times", [0.0, 1.0, 8.0, 50.0, 500.0])
def test_a_sun_takes_no_light_from_the_sky(times):
    """Matt normals that face away from a sun of so many times the irradiance of an even sky: a sixth to a half of the light was left to
    them at 50 times, none at 500. The bounds are those of 96 lights in place of all directions: 8 % of the sky, and what lights on both
    sides of a shadow line let through, 1/1500 of the sun."""
    directions, normals = lattice(96, 180), scattered(400, 7)
    environment = np.ones((90, 180, 3))
    environment[30, 50] += times * np.pi / texel_solid_angles(90, 180)[30, 0]
    away = normals[normals @ texel_directions(90, 180)[30, 50] < -0.3]
    light = np.maximum(away @ directions.T, 0) @ integrate_kernel(environment, directions, STILL)[0] / np.pi
    assert light.min() > 0.92 and light.max() < 1.08 + times / 1500


def test_layers_end_where_there_is_light_on_both_sides():
    radiance = np.array([6400.0, 3200.0, 80.0, 2.0])
    parts = [[100 / 6400, 6300 / 6400], [100 / 3200, 3100 / 3200], [1, 0], [1, 0]]
    np.testing.assert_allclose(layer_parts(radiance, np.ones(4)), parts, rtol=ROUNDING)
    np.testing.assert_allclose(layer_parts(np.array([5.0, 4.0]), np.ones(2)), [[1], [1]], rtol=ROUNDING)
    assert layer_parts(np.ones(0), np.ones(0)).shape == (0, 1)  # of a black map
    steradians = np.array([0.001, 0.001, 1.0, 1.0])  # the bright light has a tenth of the energy
    np.testing.assert_allclose(layer_parts(steradians * radiance, steradians), np.ones((4, 1)), rtol=ROUNDING)


@pytest.mark.parametrize("directions", [lattice(128, 180), scattered(128, 4), DOME], ids=["even", "scattered", "dome"])
@first_short("environment", [lobes(np.random.default_rng(7), 100, 200), np.ones((90, 180, 3)) + sun(90, 180, 30, 50, 5e3)])
def test_a_map_is_cut_finely_enough(directions, environment):
    """Truth: every texel by itself, in the same layers."""
    rotation = turn(3)
    rows = list(samples(environment, rotation, down=1, across=1))
    towards, solid_angle, radiance = (np.concatenate([row[k] for row in rows]) for k in range(3))
    layers = layer_parts(solid_angle * radiance.sum(axis=1), solid_angle).T[..., None] * solid_angle[:, None] * radiance
    truth = sum(share_kernel(towards, layer, directions) for layer in layers)
    given = integrate_kernel(environment, directions, rotation[None])[0]
    np.testing.assert_allclose(given, truth, atol=SAMPLED * truth.sum(axis=0).max())


@pytest.mark.long
def test_texels_of_a_coarse_map_are_areas():
    environment = np.random.default_rng(2).random((6, 12, 3))
    directions = scattered(50, 5)
    rows = list(samples(environment, np.eye(3), down=60, across=60))
    towards, solid_angle, radiance = (np.concatenate([row[k] for row in rows]) for k in range(3))
    truth = share_kernel(towards, solid_angle[:, None] * radiance, directions)
    given = integrate_kernel(environment, directions, STILL)[0]
    np.testing.assert_allclose(given, truth, atol=SAMPLED * truth.sum(axis=0).max())


def test_turning_the_map_is_turning_the_lights_back():
    environment, directions, rotation = lobes(np.random.default_rng(1)), scattered(30, 2), turn(5)
    np.testing.assert_allclose(integrate_kernel(environment, directions, rotation[None]),
                               integrate_kernel(environment, directions @ rotation, STILL), atol=1e-7)


def test_weights_of_a_frame_do_not_depend_on_other_frames():
    environment, directions = lobes(np.random.default_rng(1)), lattice(96, 180)
    rotations = np.stack([rotation_about_y(15.0 * k) for k in range(6)])
    whole = integrate_kernel(environment, directions, rotations)
    for frame in range(6):
        np.testing.assert_array_equal(whole[frame], integrate_kernel(environment, directions, rotations[frame][None])[0])


def test_light_from_beyond_is_shared_by_the_lights_around_the_hole():
    below = np.array([[0.1, 0.0, -1.0], [0.0, -0.3, -0.9]])
    below /= np.linalg.norm(below, axis=1, keepdims=True)
    energy = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 0.5]])
    np.testing.assert_allclose(share_kernel(below, energy, DOME), share_smooth(below, energy, DOME), atol=SUM)


@pytest.mark.parametrize("directions", [AXES[:1], AXES[:2], AXES[:3], ring(12, 0), ring(9, 40)],
                         ids=["one", "two", "three", "ring", "cone"])
def test_few_lights_or_lights_in_one_plane_need_no_triangles(directions):
    towards, energy = scattered(50, 3), np.random.default_rng(3).random((50, 3))
    with pytest.raises(ArrayError):
        share_smooth(towards, energy, directions)
    given = share_kernel(towards, energy, directions)
    assert given.min() >= 0
    np.testing.assert_allclose(given.sum(axis=0), energy.sum(axis=0), rtol=SUM)
    pole = share_kernel(np.array([[0.0, 1.0, 0.0]]), np.ones((1, 1)), ring(12, 0))[:, 0]
    np.testing.assert_allclose(pole, 1 / 12, atol=ROUNDING)


def test_the_first_of_lights_in_one_place_gets_all():
    environment, directions = lobes(np.random.default_rng(3)), scattered(30, 8)
    alone = integrate_kernel(environment, directions, STILL)[0]
    both = integrate_kernel(environment, np.concatenate([directions, directions]), STILL)[0]
    np.testing.assert_array_equal(both, np.concatenate([alone, np.zeros_like(alone)]))


def test_two_lights_close_together_share_what_one_of_them_would_get():
    """A thousandth of a radian apart, as two readings of one lamp's direction are."""
    directions = scattered(40, 6)
    close = np.concatenate([directions, directions[:1] + [0.0, 1e-3, 0.0]])
    close[-1] /= np.linalg.norm(close[-1])
    environment = lobes(np.random.default_rng(4))
    alone, twice = (integrate_kernel(environment, each, STILL)[0] for each in (directions, close))
    twice[0] += twice[-1]
    np.testing.assert_allclose(twice[:-1], alone, atol=5e-3 * alone.sum())  # the range follows the nearest six, of which one is closer
