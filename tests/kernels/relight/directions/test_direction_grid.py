"""Light spread over a fixed grid of directions: its twin, what it keeps, and how well it interpolates."""

import numpy as np
import pytest

from kernels.relight.directions.direction_grid import PITCH_DEGREES, direction_grid, spread
from tests.kernels.relight.lights import AXES, scattered
from tests.reference.direction_grid import cubic_spread

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


@pytest.mark.parametrize("sharpness, error", [(5, 3e-4), (30, 4e-3), (100, 2e-2)])
def test_responses_are_interpolated(sharpness, error):
    """A lobe exp(κ (cos θ - 1)): the error of cubic convolution is of the order of the pitch to the third power times the third derivative,
    (h √κ)³ / 30: 0.0002, 0.003 and 0.016."""
    direction, samples = direction_grid().direction, scattered(300, 7)
    weights = spread(samples, np.eye(len(samples)))
    for middle in (*AXES.astype(float), *scattered(5, 8)):
        got = weights.T @ lobe(direction, middle, sharpness)
        assert np.abs(got - lobe(samples, middle, sharpness)).max() < error
