"""Near lights from two balls: exact rays, rendered balls, and rays that meet nowhere."""

import numpy as np
import pytest

from service.calibrate.solvers.mirror_ball import nearest_point
from stage.errors import CalibrationError
from tests.reference.light_directions import least_error_degrees
from tests.service.calibrate.solvers.balls import unit


def rays_to(position, points):
    way = position - points
    return way / np.linalg.norm(way, axis=1, keepdims=True)


@pytest.mark.parametrize("balls", [2, 3, 5])
def test_exact_rays_meet(balls):
    rng = np.random.default_rng(balls)
    points, position = rng.normal(size=(balls, 3)), np.array([0.3, -2.0, 4.0])
    found = nearest_point(points, rays_to(position, points), np.full(balls, 0.1))
    np.testing.assert_allclose(found.position, position, atol=1e-12)
    assert found.residual < 1e-12 and found.flags == ()


def test_the_stated_uncertainty_is_that_of_many_trials():
    """First-order propagation against 2000 perturbed pairs of rays: the ratio of two such spreads errs by 1/√(2·2000·3)."""
    rng = np.random.default_rng(5)
    points, position = np.array([[-0.2, 0, -1], [0.2, 0.05, -1.0]]), np.array([0.5, 0.8, 0.3])
    exact = rays_to(position, points)
    sigma = 0.1
    found = nearest_point(points, exact, np.full(2, sigma))
    error = []
    for _ in range(2000):
        shaken = exact + np.radians(sigma) * rng.normal(size=(2, 3))
        shaken /= np.linalg.norm(shaken, axis=1, keepdims=True)
        error.append(nearest_point(points, shaken, np.full(2, sigma)).position - position)
    assert np.sqrt((np.array(error) ** 2).sum(axis=1).mean()) == pytest.approx(found.uncertainty, rel=0.05)


def test_rays_that_meet_nowhere():
    points = np.array([[-0.1, 0, 0], [0.1, 0, 0.0]])
    with pytest.raises(CalibrationError, match="from parallel: the light is too far"):
        nearest_point(points, np.array([unit(0, 0.3, 1), unit(0, 0.3, 1.001)]), np.ones(2))
    with pytest.raises(CalibrationError, match="meet behind"):
        nearest_point(points, np.array([unit(-1, 0, 1), unit(1, 0, 1)]), np.ones(2))


def test_rays_that_miss_each_other_are_flagged():
    points = np.array([[-0.1, 0, 0], [0.1, 0.1, 0.0]])
    found = nearest_point(points, np.array([unit(0.3, 0, 1), unit(-0.3, 0, 1)]), np.full(2, 0.1))
    assert found.flags == ("rays miss",) and found.residual == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("count", [12, 16, 24])
def test_what_all_lights_share_is_left(count):
    """One of 3 × 3 numbers is a common strength, which turns no light: eight of 2n are those of the table. A turn, three, is left where the
    strengths are known, and a little more by readings of half a per cent."""
    assert least_error_degrees(count, table_degrees=5.0, strength=10.0) == pytest.approx(5 * (8 / (2 * count)) ** 0.5, rel=0.01)
    known = least_error_degrees(count, table_degrees=5.0, strength=0.001)
    assert known == pytest.approx(5 * (3 / (2 * count)) ** 0.5, rel=0.02)
    assert least_error_degrees(count, table_degrees=5.0, strength=0.1) == pytest.approx(
        {12: 2.66, 16: 2.31, 24: 1.88}[count], abs=0.03)  # the table of docs/methods.md
