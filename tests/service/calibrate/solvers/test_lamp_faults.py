"""Images of a primary that are copies, show another primary, or are encoded otherwise than declared; and those that are right."""

import warnings

import numpy as np
import pytest

from service.calibrate.solvers.lamp_faults import check_images, other_encoding
from service.calibrate.solvers.lamp_readings import card_template
from service.light_estimation.ball import Ball, view_ball
from stage.capture.camera import Camera
from stage.errors import CalibrationError
from tests.reference.balls import lambertian, render

DRIVES = np.array([1.0, 0.75, 0.5, 0.25])
RED, GREEN = np.array([2.1, 0.1, 0.02]), np.array([0.1, 1.7, 0.2])
SIGMA = 0.004
UP = np.array([0.0, 0.0, 1.0])


def swept(colours, light):
    """Names, drives, pixels and noisy readings of images, as check_images takes them."""
    values = np.asarray(colours) * np.asarray(light)[:, None] + np.random.default_rng(3).normal(0, SIGMA, (len(light), 3))
    names = [f"{number}.png" for number in range(len(light))]
    return names, DRIVES[:len(light)].tolist(), [each.tobytes() for each in values], values, np.full_like(values, SIGMA)


def test_a_copy_of_an_image_is_refused():
    names, drives, pixels, values, sigmas = swept([RED] * 4, DRIVES)
    assert check_images(names, drives, pixels, values, sigmas) is None
    pixels[0], values[0] = pixels[1], values[1]
    with pytest.raises(CalibrationError, match=r"0.png and 1.png are the same image, at the levels 1 and 0.75"):
        check_images(names, drives, pixels, values, sigmas)
    check_images(names, [1.0, 1.0, 0.5, 0.25], pixels, values, sigmas)  # one image that is listed twice says nothing wrong


def test_images_of_a_dead_band_may_be_alike():
    """As where a program draws them, without noise."""
    names, drives, pixels, values, sigmas = swept([RED] * 4, [1.0, 0.5, 0.0, 0.0])
    pixels[2], values[2] = pixels[3], values[3]
    check_images(names, drives, pixels, values, sigmas)


@pytest.mark.parametrize("place", [0, 2])
def test_an_image_of_another_primary_is_refused(place):
    colours = [RED] * 4
    colours[place] = GREEN
    with pytest.raises(CalibrationError, match=rf"{place}.png, at the level {DRIVES[place]:g}, has another colour .* by 8. degrees"):
        check_images(*swept(colours, DRIVES))


def test_lamps_that_redden_as_they_are_dimmed_are_not_refused():
    colours = [(1.0, 0.8 * warm, 0.6 * warm**2) for warm in (1.0, 0.85, 0.65, 0.4)]
    assert check_images(*swept(colours, DRIVES)) == "its colour changes with the level, by 18 degrees"
    said = check_images(*swept([RED, GREEN], DRIVES[:2]))  # which of two is wrong cannot be told
    assert said is not None and "its colour changes with the level" in said


@pytest.mark.parametrize(("gamma", "named"), [(1.0, False), (1 / 2.2, True)])
def test_a_ball_tells_that_images_are_encoded(gamma, named):
    """A red lamp, whose other channels are dark, in a room with some light."""
    camera = Camera(projection="orthographic", resolution=(64, 56), pixel_size_m=0.001)
    view = view_ball(Ball(centre=np.zeros(3), radius=0.022, metric=True, outline_error_px=0.0, radius_px=22.0), camera)
    direction = np.array([0.36, 0.48, 0.8])
    shown = render(lambertian(direction, albedo=0.18), samples=4, centre=np.zeros(3), radius=0.022, pixel_size=0.001, width=64,
                   height=56)[0][view.box][..., None]
    random = np.random.default_rng(1)
    seen, dark = (np.clip(0.02 + light * RED + random.normal(0, 0.0005, (*shown.shape[:2], 3)), 0, None)**gamma for light in (shown, 0))
    said = other_encoding(seen, dark, None, direction, view, exposure=1.0, declared="lin_rec709_scene")
    assert (said is not None and "lin_rec709_scene is declared, but as" in said) if named else said is None


def test_images_that_are_darker_than_the_dark_one_are_refused_without_a_warning():
    with warnings.catch_warnings(), pytest.raises(CalibrationError, match="the target is dark"):
        warnings.simplefilter("error")
        card_template(np.random.default_rng(2).normal(-1e-3, 1e-4, (20, 20, 3)), None, UP, UP)
