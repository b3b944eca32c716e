"""Grey ball: brightness and direction from renders of an independent ray caster, and balls in the dark."""

import numpy as np
import pytest

from service.light_estimation.ball import Ball, view_ball
from service.light_estimation.grey_ball import better_encoding, fit_brightness, fit_direction, received
from stage.capture.light import DistantLight, PointLight
from stage.colour.colour import convert
from stage.colour.colour_spaces import linear_space
from stage.errors import CalibrationError
from tests.reference.balls import lambertian, lambertian_near, render
from tests.scenes.captures import angles_degrees
from tests.service.calibrate.solvers.balls import HEIGHT, SCENES, WIDTH, box, spread, unit


def exact(name):
    camera, geometry = SCENES[name]
    ball = Ball(geometry["centre"], geometry["radius"], True, 60.0, 0.0)
    return view_ball(ball, camera), geometry


def seen(shade, geometry):
    return render(shade, width=WIDTH, height=HEIGHT, samples=4, **geometry)[0]


def distant(direction):
    return DistantLight(type="distant", direction=tuple(direction), irradiance=(1, 1, 1))


@pytest.mark.parametrize("name", SCENES)
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
