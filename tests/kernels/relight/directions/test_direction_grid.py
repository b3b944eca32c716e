"""Light spread over a fixed grid of directions: its twin, what it keeps, and how well it interpolates."""

import numpy as np
import pytest

from kernels.relight.directions.direction_grid import PITCH_DEGREES, direction_grid, spread
from tests.kernels.relight.lights import AXES, scattered, turn
from tests.reference.direction_grid import cubic_spread

SUM = 1e-12
"""Relative: float64 sums of thousands of terms."""


def lobe(direction, middle, sharpness):
    return np.exp(sharpness * (direction @ middle - 1))


def test_no_direction_is_farther_than_a_diagonal_from_the_grid():
    direction = direction_grid().direction
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-15)
    away = np.degrees(np.arccos((scattered(3000, 2) @ direction.T).max(axis=1)))
    assert 0.6 * PITCH_DEGREES < away.max() < 1.03 * PITCH_DEGREES / np.sqrt(2)  # columns are rounded to a whole number
    assert len(direction) < 1.05 * 4 * np.pi / np.radians(PITCH_DEGREES) ** 2  # and not more of them than that asks for


def test_it_is_the_twin():
    samples = np.concatenate([scattered(200, 3), AXES.astype(float)])
    energy = np.random.default_rng(4).normal(size=(len(samples), 2))
    grid = direction_grid()
    np.testing.assert_allclose(spread(samples, energy), cubic_spread(samples, energy, grid.columns), atol=1e-12)


def test_energy_is_kept():
    energy = np.random.default_rng(5).gamma(1.0, 1.0, (5000, 3))
    np.testing.assert_allclose(spread(scattered(5000, 6), energy).sum(axis=0), energy.sum(axis=0), rtol=SUM)
    assert (spread(np.zeros((0, 3)), np.zeros((0, 3))) == 0).all()


def test_a_sample_in_a_direction_of_the_grid_stays_there():
    direction = direction_grid().direction
    np.testing.assert_allclose(spread(direction, np.eye(len(direction))[:, :9])[:, :9], np.eye(len(direction))[:, :9], atol=1e-10)


@pytest.mark.parametrize("sharpness, error", [(5, 3e-4), (30, 4e-3), (100, 2e-2)])
def test_responses_are_interpolated(sharpness, error):
    """A lobe exp(κ (cos θ - 1)): the error of cubic convolution is of the order of the pitch to the third power times the third derivative,
    (h √κ)³ / 30: 0.0002, 0.003 and 0.016."""
    direction, samples = direction_grid().direction, scattered(300, 7)
    weights = spread(samples, np.eye(len(samples)))
    for middle in (*AXES.astype(float), *scattered(5, 8)):
        got = weights.T @ lobe(direction, middle, sharpness)
        assert np.abs(got - lobe(samples, middle, sharpness)).max() < error


def test_broad_light_is_the_same_whichever_way_the_sky_is_turned():
    """Under 5000 samples of a smooth sky, the sum of a lobe of 20° does not depend on how its light falls on the grid."""
    samples = scattered(5000, 9)
    energy = (2 + samples @ [0.3, 0.8, -0.5])[:, None]
    middle = scattered(1, 10)[0]
    truth = (lobe(samples, middle, 30) * energy[:, 0]).sum()
    for seed in range(5):
        rotation = turn(seed)
        got = spread(samples @ rotation.T, energy)[:, 0] @ lobe(direction_grid().direction, rotation @ middle, 30)
        np.testing.assert_allclose(got, truth, rtol=1e-3)  # some of the error of one sample, which falls on either side
