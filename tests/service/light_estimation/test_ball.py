"""Balls in images, and lights from the shading of grey ones."""

import numpy as np
import pytest

from service.light_estimation.ball import (
    Ball,
    ball_from_circle,
    ball_from_mask,
    ball_from_outline,
    fit_circle,
    fit_cone,
    intersect,
    project,
    view_ball,
)
from service.light_estimation.grey_ball import better_encoding, fit_brightness, fit_direction, received
from stage.capture.camera import Camera, Distortion
from stage.capture.light import DistantLight, PointLight
from stage.colour.colour import convert
from stage.colour.colour_spaces import linear_space
from stage.errors import CalibrationError
from tests.marks import first_short
from tests.reference.balls import lambertian, lambertian_near, render
from tests.scenes.captures import angles_degrees
from tests.service.calibrate.solvers.balls import HEIGHT, ORTHOGRAPHIC, PERSPECTIVE, SCENES, WIDTH, box, spread, unit


def coverage(geometry):
    return render(lambertian(unit(0, 0, 1)), width=WIDTH, height=HEIGHT, **geometry)[1]


def test_a_circle_through_its_points():
    turn = np.linspace(0, 4, 7)
    centre, radius = fit_circle(np.stack([1000.5 + 3 * np.cos(turn), -20 + 3 * np.sin(turn)], axis=-1))
    np.testing.assert_allclose([*centre, radius], [1000.5, -20, 3], rtol=1e-12)


@pytest.mark.parametrize("half_angle", [1e-3, 0.1, 1.0])
def test_a_cone_through_its_rays(half_angle):
    """r·c = cos α; a narrow cone keeps its digits: 1e-3 rad to one part in 1e6."""
    axis = unit(0.2, -0.1, -1)
    first = unit(*np.cross(axis, [0, 1, 0]))
    second = np.cross(axis, first)
    turn = np.linspace(0, 5, 9)[:, None]
    rays = np.cos(half_angle) * axis + np.sin(half_angle) * (np.cos(turn) * first + np.sin(turn) * second)
    found, angle = fit_cone(rays)
    assert angle == pytest.approx(half_angle, rel=1e-6)
    assert np.linalg.norm(found - axis) < 1e-6 * half_angle


@pytest.mark.parametrize("points", [np.column_stack([np.arange(9.0), np.arange(9.0)]), np.ones((5, 2))])
def test_points_on_a_line_are_no_circle(points):
    with pytest.raises(np.linalg.LinAlgError):
        fit_circle(points)


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("binary", "tolerance_px"), [(False, 0.02), (True, 0.05)])
def test_a_ball_from_its_mask(name, binary, tolerance_px):
    """Interpolated crossings of an anti-aliased mask err by 0.09 px at the most, those of a binary one by 0.5; over the 480
    points of a 60 px ball the centre averages that down to 0.01 and 0.03 px."""
    camera, geometry = SCENES[name]
    mask = coverage(geometry)
    ball = ball_from_mask(camera, mask > 0.5 if binary else mask, radius_m=geometry["radius"])
    assert np.hypot(*np.subtract(project(camera, ball.centre), project(camera, geometry["centre"]))) < tolerance_px
    assert ball.radius_px == pytest.approx(60, abs=2.5)  # perspective: the mean of an ellipse's axes
    assert abs(ball.centre[2] - geometry["centre"][2]) < 0.0015 * 0.8  # 0.1 px of 60
    assert ball.outline_error_px < 0.03


@pytest.mark.long
@pytest.mark.parametrize("name", SCENES)
def test_what_holds_the_ball_does_not_pull_it(name):
    camera, geometry = SCENES[name]
    clean = coverage(geometry)
    held = clean.copy()
    held[100:, 90:96] = 1  # a stand
    held[:30, :40] = 1  # another object
    held[70:75, 110:120] = 0  # a hole
    a, b = (ball_from_mask(camera, mask, radius_m=geometry["radius"]) for mask in (clean, held))
    assert np.hypot(*np.subtract(project(camera, a.centre), project(camera, b.centre))) < 0.05  # a few points near the stand


def test_a_typed_circle():
    ball = ball_from_circle(ORTHOGRAPHIC, 132.0, 73.0, 50.0, z_m=0.25)
    np.testing.assert_allclose(ball.centre, [0.012, 0.007, 0.25], atol=1e-12)
    assert ball.radius == pytest.approx(0.05) and ball.metric and ball.radius_px == pytest.approx(50)
    near = ball_from_circle(PERSPECTIVE, 120.0, 80.0, 60.0, radius_m=0.12)
    alpha = np.arctan(60 / 400)  # on the axis: the tangent rays' angle
    np.testing.assert_allclose(near.centre, [0, 0, -0.12 / np.sin(alpha)], atol=1e-9)
    unscaled = ball_from_circle(PERSPECTIVE, 120.0, 80.0, 60.0)
    assert not unscaled.metric
    np.testing.assert_allclose(unscaled.centre * 0.12, near.centre)


def test_the_view_of_a_ball_is_the_sphere():
    camera = PERSPECTIVE
    ball = ball_from_circle(camera, 100, 80, 50, radius_m=0.1)
    view = view_ball(ball, camera)
    inside = view.inside
    np.testing.assert_allclose(np.linalg.norm(view.normal[inside], axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(view.point[inside] - ball.centre, axis=-1), ball.radius, atol=1e-12)
    assert ((view.normal * view.to_viewer).sum(-1)[inside] > 0).all()
    assert not view.normal[~inside].any()
    for row, col in np.argwhere(inside)[::500]:  # every point projects to its own pixel
        u, v = project(camera, view.point[row, col])
        assert (v - 0.5 - view.box[0].start, u - 0.5 - view.box[1].start) == pytest.approx((row, col), abs=1e-9)


def test_distortion_is_undone():
    camera = Camera(projection="perspective", resolution=(WIDTH, HEIGHT), focal_px=(400.0, 420.0), principal_px=(115.0, 83.0),
                    distortion=Distortion(model="brown_conrady", k=(-0.2, 0.05, 0.0), p=(0.001, -0.002)))
    centre, radius = np.array([0.04, -0.03, -0.9]), 0.11
    axis = unit(*centre)
    first = unit(*np.cross(axis, [0, 1, 0]))
    turn = np.linspace(0, 2 * np.pi, 50, endpoint=False)[:, None]
    alpha = np.arcsin(radius / np.linalg.norm(centre))
    rays = np.cos(alpha) * axis + np.sin(alpha) * (np.cos(turn) * first + np.sin(turn) * np.cross(axis, first))
    outline = np.array([project(camera, ray) for ray in rays])
    ball = ball_from_outline(camera, outline, error_px=0, radius_m=radius)
    np.testing.assert_allclose(ball.centre, centre, atol=1e-7)
    u, v = project(camera, centre)
    inside, point, _ = intersect(ball, camera, np.array([u]), np.array([v]))
    assert inside[0] and np.linalg.norm(point[0]) == pytest.approx(np.linalg.norm(centre) - radius, abs=1e-6)


@pytest.mark.parametrize(("circle", "words"), [((30, 80, 40), "is not wholly inside the 240x160 image"),
                                               ((100, 80, 0.5), "is not wholly"), ((100, 150, 40), "is not wholly"),
                                               ((float("nan"), 80, 40), "is not wholly")])
def test_circles_off_the_image(circle, words):
    with pytest.raises(CalibrationError, match=words):
        ball_from_circle(ORTHOGRAPHIC, *circle)


def test_masks_that_show_no_ball():
    empty = np.zeros((HEIGHT, WIDTH))
    with pytest.raises(CalibrationError, match="outline of 0 points"):
        ball_from_mask(ORTHOGRAPHIC, empty)
    rng = np.random.default_rng(1)
    with pytest.raises(CalibrationError, match="is not round"):
        ball_from_mask(ORTHOGRAPHIC, rng.random((HEIGHT, WIDTH)) > 0.999)
    half = empty.copy()
    half[80:] = 1
    with pytest.raises(CalibrationError, match=r"line|not round"):
        ball_from_mask(ORTHOGRAPHIC, half)


def exact(name):
    camera, geometry = SCENES[name]
    ball = Ball(geometry["centre"], geometry["radius"], True, 60.0, 0.0)
    return view_ball(ball, camera), geometry


def seen(shade, geometry):
    return render(shade, width=WIDTH, height=HEIGHT, samples=4, **geometry)[0]


def distant(direction):
    return DistantLight(type="distant", direction=tuple(direction), irradiance=(1, 1, 1))


@first_short("name", SCENES)
def test_brightness_of_far_lights(name):
    """Exact but for the curvature of the ball inside a pixel: (1/60)²/24 of the shading, 1e-5."""
    view, geometry = exact(name)
    for direction in spread(6, 0.0):
        image = seen(lambertian(direction, albedo=0.6, irradiance=2.5), geometry)
        colour = box(image, view) * [1.0, 0.5, 2.0]
        found = fit_brightness(colour, None, distant(direction), view)
        np.testing.assert_allclose(found.scale, 0.6 / np.pi * 2.5 * np.array([1, 0.5, 2]), rtol=5e-4)
        assert found.residual < 5e-3 and found.pixels > 2000


def test_brightness_of_a_near_light_with_a_lobe():
    view, geometry = exact("perspective")
    position, axis = geometry["centre"] + [0.3, 0.2, 0.5], unit(-0.3, -0.1, -0.5)
    light = PointLight(type="point", position_m=tuple(position), intensity=(1, 1, 1), axis=tuple(axis), anisotropy=2.0)
    image = seen(lambertian_near(position, albedo=0.6, intensity=1.7, axis=axis, anisotropy=2.0), geometry)
    found = fit_brightness(box(image, view), None, light, view)
    np.testing.assert_allclose(found.scale, 0.6 / np.pi * 1.7, rtol=5e-4)
    assert received(light, view).max() == pytest.approx(image[view.box].max() / (0.6 / np.pi * 1.7), rel=1e-3)


@pytest.mark.parametrize("name", SCENES)
def test_direction_from_shading_alone(name):
    view, geometry = exact(name)
    for direction in spread(6, -0.2):
        found = fit_direction(box(seen(lambertian(direction), geometry), view), None, view)
        assert angles_degrees(found.direction, direction) < 0.05  # the same curvature, one-sided for lights from the side


def test_noise_saturation_and_highlights():
    """Noise of 2 % of the peak over 8000 pixels: 0.02 % of brightness. The highlight covers a tenth of the lit pixels, and a
    Cauchy weight of its foot leaves 1 %. Saturated pixels, a quarter of them, take no part."""
    view, geometry = exact("orthographic")
    direction, rng = unit(0.4, 0.2, 0.8), np.random.default_rng(6)
    true = 0.5 / np.pi
    clean = seen(lambertian(direction), geometry)
    noisy = np.maximum(box(clean, view) + 0.02 * true * rng.standard_normal((*view.inside.shape, 3)), 0)
    np.testing.assert_allclose(fit_brightness(noisy, None, distant(direction), view).scale, true, rtol=2e-3)
    shading = fit_direction(noisy, None, view)
    assert angles_degrees(shading.direction, direction) < 4 * shading.uncertainty_degrees < 0.2
    shiny = box(seen(lambertian(direction, highlight=0.2), geometry), view)
    np.testing.assert_allclose(fit_brightness(shiny, None, distant(direction), view).scale, true, rtol=0.01)
    clipped = np.minimum(noisy, 0.85 * true)
    saturated = (clipped >= 0.85 * true).any(axis=-1)
    assert saturated.sum() > 500
    np.testing.assert_allclose(fit_brightness(clipped, saturated, distant(direction), view).scale, true, rtol=2e-3)


@pytest.mark.parametrize("rim", [0.2, 0.5])
def test_the_uncertainty_holds_what_a_ball_that_is_not_lambertian_makes(rim):
    """A ball that is brighter towards its outline, by 20 and by 50 %, turns lights from it by degrees; its readings hardly scatter."""
    view, geometry = exact("orthographic")
    for direction in spread(6, 0.3):
        image = box(seen(lambertian(direction), geometry), view) * (1 + rim * (1 - view.normal[..., 2:]))
        shading = fit_direction(image, None, view)
        off = angles_degrees(shading.direction, direction)
        assert off < 2 * shading.uncertainty_degrees + 0.05, (off, shading.uncertainty_degrees)


def test_balls_that_show_nothing():
    view, geometry = exact("orthographic")
    image = box(seen(lambertian(unit(0, 0, 1)), geometry), view)
    with pytest.raises(CalibrationError, match="0 pixels of the ball are in light"):
        fit_brightness(image, None, distant(unit(0, 0.1, -1)), view)
    with pytest.raises(CalibrationError, match="0 pixels of the ball are in light and unsaturated"):
        fit_brightness(image, np.ones(view.inside.shape, dtype=bool), distant(unit(0, 0, 1)), view)
    with pytest.raises(CalibrationError, match="the ball is dark"):
        fit_brightness(0 * image, None, distant(unit(0, 0, 1)), view)
    with pytest.raises(CalibrationError, match="pixels of the ball are in light"):
        fit_direction(0 * image, None, view)


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize(("declared", "recorded_as", "named"), [
    ("lin_rec709_scene", "lin_rec709_scene", None), ("srgb_texture", "srgb_texture", None),
    ("lin_rec709_scene", "srgb_texture", "srgb_texture"), ("lin_rec709_scene", "g22_rec709_scene", "g22_rec709_scene"),
    ("srgb_texture", "lin_rec709_scene", "lin_rec709_scene"),
])
def test_the_shading_tells_how_images_are_encoded(declared, recorded_as, named, noise):
    """Lambert's law holds under one encoding alone. The recorded values of a capture of two seconds are twice the radiance."""
    view, geometry = exact("orthographic")
    light = distant(unit(0.4, 0.3, 0.8))
    image = np.asarray(box(seen(lambertian(light.direction, albedo=0.8, irradiance=3.0), geometry), view) * [1.0, 0.5, 0.8])
    image = np.maximum(image * (1 + noise * np.random.default_rng(0).normal(size=image.shape)), 0).clip(0, 1).astype(np.float32)
    recorded = convert(image, linear_space(recorded_as), recorded_as)
    radiance = convert(recorded, declared, linear_space(declared)) / 2
    residual = fit_brightness(radiance, None, light, view).residual
    found = better_encoding(radiance, None, light, view, exposure=2.0, declared=declared, residual=residual)
    assert found is None if named is None else found is not None and found[0] == named and found[1] < 0.01 + 1.2 * noise
