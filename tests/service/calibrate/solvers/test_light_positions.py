"""Near lights from two balls: exact rays, rendered balls, and rays that meet nowhere."""

import numpy as np
import pytest

from service.calibrate.solvers.light_positions import nearest_point
from service.calibrate.solvers.mirror_ball import find_spot
from service.light_estimation.ball import view_ball
from service.light_estimation.ball_outline import ball_from_mask
from stage.capture.camera import Camera
from stage.errors import CalibrationError
from tests.reference.balls import mirror_of_near, render
from tests.service.calibrate.solvers.balls import box, unit


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


@pytest.mark.long
@pytest.mark.parametrize(("projection", "camera"), [
    ("orthographic", {"pixel_size": 0.001}), ("perspective", {"focal": 400.0})])
def test_lights_near_two_rendered_balls(projection, camera):
    """Each ray is known to 0.1° (tests of the spot): at 1 m from balls 0.24 m apart the light lies within
    0.1° · 1 m / sin(14°) = 7 mm along the ray, and 2 mm across it."""
    width, height = 320, 120
    model = Camera(projection=projection, resolution=(width, height), **(
        {"pixel_size_m": 0.001} if projection == "orthographic" else {"focal_px": (400.0, 400.0)}))
    z, radius = (0.0, 0.05) if projection == "orthographic" else (-0.42, 0.045)
    centres = [np.array([x, 0.004, z]) for x in (-0.1, 0.1)]
    balls = []
    for centre in centres:
        _, mask = render(mirror_of_near(np.ones(3)), centre=centre, radius=radius, width=width, height=height, **camera)
        balls.append(ball_from_mask(model, mask, radius_m=radius, z_m=z))
    for position in (np.array([0.1, 0.5, z + 0.6]), np.array([-0.6, 0.1, z + 0.5])):
        points, directions, sigmas = [], [], []
        for centre, ball in zip(centres, balls, strict=True):
            image, _ = render(mirror_of_near(position, degrees=2), centre=centre, radius=radius, width=width, height=height, **camera)
            view = view_ball(ball, model)
            spot = find_spot(box(image, view), None, ball, view)
            points.append(spot.point)
            directions.append(spot.direction)
            sigmas.append(spot.uncertainty_degrees)
        found = nearest_point(np.array(points), np.array(directions), np.array(sigmas))
        assert np.linalg.norm(found.position - position) < 0.01
        assert found.residual < 0.002 and found.uncertainty < 0.05 and found.flags == ()


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
