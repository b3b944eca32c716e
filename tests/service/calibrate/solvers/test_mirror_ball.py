"""Directions of lights from one mirror ball, positions from several."""

import numpy as np
import pytest

from service.calibrate.solvers.mirror_ball import find_spot, nearest_point
from service.light_estimation.ball import Ball, ball_from_mask, project, view_ball
from stage.errors import CalibrationError
from tests.reference.balls import mirror_of_far, render
from tests.reference.light_directions import least_error_degrees
from tests.scenes.captures import angles_degrees
from tests.service.calibrate.solvers.balls import HEIGHT, SCENES, WIDTH, box, spread, unit


def seen(shade, geometry, samples=8):
    return render(shade, width=WIDTH, height=HEIGHT, samples=samples, **geometry)


def exact(name):
    """The true ball, for tests of the spot alone."""
    camera, geometry = SCENES[name]
    ball = Ball(geometry["centre"], geometry["radius"], True, 60.0, 0.0)
    return ball, view_ball(ball, camera), geometry


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_directions_in_front(name):
    """A 60 px ball: 1 px is 1.9° of reflection. A spot of a dozen pixels has its centroid to 0.03 px, the outline's centre
    from an anti-aliased mask is known to 0.02 px: together under 0.1°. Where the spot is half way to the rim, twice that."""
    camera, geometry = SCENES[name]
    _, mask = seen(mirror_of_far(unit(0, 0, 1)), geometry)
    ball = ball_from_mask(camera, mask)
    view = view_ball(ball, camera)
    for direction in spread(8, 0.2):
        image, _ = seen(mirror_of_far(direction), geometry)
        spot = find_spot(box(image, view), None, ball, view)
        assert angles_degrees(spot.direction, direction) < 0.1
        assert spot.flags == ()
        assert spot.uncertainty_degrees < 0.35
        assert spot.spot_degrees == pytest.approx(1.5 * np.sqrt(2), rel=0.45)  # a lobe of 1.5° a side, cut at its foot


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_directions_behind(name):
    """Towards the rim the ball shows more of the world in each pixel: at 115° from the view axis 1 px is 3.5°."""
    ball, view, geometry = exact(name)
    for direction in spread(8, -0.5)[4:]:
        image, _ = seen(mirror_of_far(direction), geometry)
        spot = find_spot(box(image, view), None, ball, view)
        assert angles_degrees(spot.direction, direction) < max(0.1, spot.uncertainty_degrees)


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_a_saturated_spot_with_noise(name):
    """Clipped four times over: the centroid of the plateau and its foot. The plateau's edge is quantised: 0.2°."""
    ball, view, geometry = exact(name)
    rng = np.random.default_rng(2)
    for direction in spread(5, 0.3):
        image, _ = seen(mirror_of_far(direction, degrees=3), geometry)
        image = np.clip(4 * image / image.max() + 0.003 * rng.standard_normal(image.shape), 0, 1)
        radiance = box(image, view)
        spot = find_spot(radiance, radiance[..., 0] >= 1, ball, view)
        assert angles_degrees(spot.direction, direction) < 0.2
        assert spot.flags == ()


def test_the_centroid_lies_on_the_ball_where_the_spot_is():
    ball, view, geometry = exact("perspective")
    direction = unit(0.4, 0.3, 0.8)
    image, _ = seen(mirror_of_far(direction), geometry)
    spot = find_spot(box(image, view), None, ball, view)
    assert np.linalg.norm(spot.point - ball.centre) == pytest.approx(ball.radius)
    assert np.hypot(*(np.array(project(SCENES["perspective"][0], spot.point)) - spot.uv)) < 0.02
    peak = np.unravel_index(np.argmax(image), image.shape)
    assert np.abs(spot.uv - [peak[1] + 0.5, peak[0] + 0.5]).max() < 1


def test_the_noise_of_a_ball_is_no_part_of_the_spot():
    """With a level under the noise the spot would grow over the ball: the floor rises to what noise does not reach."""
    ball, view, geometry = exact("orthographic")
    direction = unit(0.2, 0.1, 1)
    image, _ = seen(mirror_of_far(direction, degrees=3, floor=0.05), geometry)
    noisy = image + 0.02 * np.random.default_rng(3).standard_normal(image.shape)
    spot = find_spot(box(noisy, view), None, ball, view, level=0.01)
    assert spot.pixels < 60 and angles_degrees(spot.direction, direction) < 0.2


def test_a_second_light_is_flagged():
    ball, view, geometry = exact("orthographic")
    one, other = unit(0.5, 0, 1), unit(-0.5, 0.2, 1)
    for strength, flags in ((0.7, ("several spots",)), (0.2, ())):
        image = seen(mirror_of_far(one), geometry)[0] + strength * seen(mirror_of_far(other), geometry)[0]
        spot = find_spot(box(image, view), None, ball, view)
        assert angles_degrees(spot.direction, one) < 0.2 and spot.flags == flags


def test_of_two_saturated_spots_the_larger_is_the_light():
    ball, view, geometry = exact("orthographic")
    small, large = unit(0.5, 0, 1), unit(-0.5, 0.2, 1)
    image = np.minimum(5 * seen(mirror_of_far(small, degrees=1), geometry)[0]
                       + 5 * seen(mirror_of_far(large, degrees=4), geometry)[0], 1)
    radiance = box(image, view)
    assert angles_degrees(find_spot(radiance, radiance[..., 0] >= 1, ball, view).direction, large) < 0.3


def test_flags_of_an_unsure_light():
    ball, view, geometry = exact("orthographic")
    behind = unit(0.8, 0, -0.95)  # 140 degrees from the view axis
    image, _ = seen(mirror_of_far(behind, degrees=3), geometry)
    assert "near the rim" in find_spot(box(image, view), None, ball, view).flags
    image, _ = seen(mirror_of_far(unit(0.3, 0.1, 1), degrees=0.2), geometry)
    assert "small spot" in find_spot(box(image, view), None, ball, view).flags


def test_no_light():
    ball, view, _ = exact("orthographic")
    rng = np.random.default_rng(4)
    h, w = view.inside.shape
    for image in (np.zeros((h, w, 3)), np.full((h, w, 3), 0.3), 0.1 + 0.01 * rng.standard_normal((h, w, 3))):
        with pytest.raises(CalibrationError, match="no bright spot"):
            find_spot(image, None, ball, view)


@pytest.mark.parametrize(("light", "words"), [
    (mirror_of_far(unit(0, 0, 1), degrees=60, floor=0.001), r"covers \d+% of the ball|no bright spot"),
    (mirror_of_far(unit(0.3, 0, 1), degrees=25), r"covers \d+% of the ball: shorten the exposure"),
    (mirror_of_far(unit(0.25, 0, -1), degrees=4), "at the rim of the ball"),
], ids=["drowned", "large", "behind the object"])
def test_a_spot_that_tells_no_direction(light, words):
    ball, view, geometry = exact("orthographic")
    image, _ = seen(light, geometry)
    with pytest.raises(CalibrationError, match=words):
        find_spot(box(image, view), None, ball, view)


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
        {12: 2.66, 16: 2.31, 24: 1.88}[count], abs=0.03)  # the table of docs/lights.md
