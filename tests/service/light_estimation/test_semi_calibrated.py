"""Brightness of lights from the object's own images: exact data, shadows, highlights, noise, and what cannot be told."""

import numpy as np
import pytest

from service.light_estimation.semi_calibrated import check_directions, fit_intensities
from stage.errors import CalibrationError
from tests.service.calibrate.solvers.balls import spread, unit


def scene(lights, least_z, *, pixels=1500, seed=0):
    """Directions, irradiance [lights, 3] over a factor of six, readings [lights, pixels, 3] of a coloured surface, normals."""
    rng = np.random.default_rng(seed)
    directions, normals = spread(lights, least_z), spread(pixels, 0.25)
    albedo = rng.uniform(0.1, 0.9, (pixels, 3))
    irradiance = rng.uniform(0.3, 2.0, (lights, 1)) * rng.uniform(0.8, 1.2, (lights, 3))
    shading = np.maximum(directions @ normals.T, 0)
    return directions, irradiance, albedo / np.pi * irradiance[:, None] * shading[..., None], normals


def relative_error(found, irradiance):
    return np.abs(found.irradiance / (irradiance / irradiance.mean(axis=0)) - 1)


@pytest.mark.parametrize(("lights", "least_z"), [(4, 0.7), (8, 0.8), (20, 0.3), (40, -0.6)])
def test_exact_readings_give_the_brightness(lights, least_z):
    """With few lights no reading is in shadow, with many a third are; what is left is Lambertian to rounding."""
    directions, irradiance, readings, _ = scene(lights, least_z)
    found = fit_intensities(readings, np.ones(readings.shape[:2], bool), directions)
    assert relative_error(found, irradiance).max() < 1e-6
    np.testing.assert_allclose(found.irradiance.mean(axis=0), 1)


def test_noise_is_averaged_and_stated():
    """1 % of the brightest reading, 1500 pixels: each light's mean is known to 0.1 %; the stated error is of that size."""
    directions, irradiance, readings, _ = scene(20, 0.3)
    noisy = readings + 0.01 * readings.max() * 0.3 * np.random.default_rng(1).standard_normal(readings.shape)
    found = fit_intensities(np.maximum(noisy, 0), np.ones(readings.shape[:2], bool), directions)
    error = relative_error(found, irradiance)
    assert error.max() < 0.005
    # the stated error leaves out that of the shape, which the lights share
    assert 0.3 < np.sqrt((error**2).mean()) / found.uncertainty.mean() < 5


def test_highlights_and_saturation_take_no_part():
    directions, irradiance, readings, normals = scene(20, 0.3)
    half = directions + unit(0, 0, 1)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    shiny = readings + 0.3 * irradiance[:, None] * np.maximum(half @ normals.T, 0)[..., None] ** 80
    limit = np.quantile(shiny, 0.97)
    usable = (shiny < limit).all(axis=-1)
    found = fit_intensities(np.minimum(shiny, limit), usable, directions)
    assert relative_error(found, irradiance).max() < 0.005  # the feet of the highlights, down-weighted


def test_one_factor_a_channel_is_free():
    directions, _, readings, _ = scene(8, 0.8)
    usable = np.ones(readings.shape[:2], bool)
    one, other = (fit_intensities(readings * factor, usable, directions) for factor in ([1, 1, 1], [5, 0.2, 1]))
    np.testing.assert_allclose(one.irradiance, other.irradiance, rtol=1e-9)


def test_directions_that_cannot_tell():
    with pytest.raises(CalibrationError, match="3 distant lights: brightness needs 4"):
        check_directions(spread(3, 0.5))
    turn = np.linspace(0, 2, 6)
    plane = np.stack([np.sin(turn), 0 * turn, np.cos(turn)], axis=-1)
    for directions in (plane, np.vstack([plane, unit(0, 1, 1)])):
        with pytest.raises(CalibrationError, match="all lights but one lie in one plane"):
            check_directions(directions)
    check_directions(np.vstack([plane, unit(0, 1, 1), unit(0.2, -1, 1)]))


def test_too_little_to_go_by():
    directions, _, readings, _ = scene(8, 0.8, pixels=200)
    usable = np.ones(readings.shape[:2], bool)
    with pytest.raises(CalibrationError, match="channel R: 0 pixels are lit"):
        fit_intensities(0 * readings, usable, directions)


def test_a_light_that_nothing_shows_is_left_out_of_the_others():
    directions, irradiance, readings, _ = scene(8, 0.8)
    readings[2] = 0
    found = fit_intensities(readings, np.ones(readings.shape[:2], bool), directions)
    assert np.isnan(found.irradiance[2]).all()
    others = np.delete(irradiance, 2, axis=0)
    np.testing.assert_allclose(np.delete(found.irradiance, 2, axis=0), others / others.mean(axis=0), rtol=1e-6)
    with pytest.raises(CalibrationError, match="under 4 or more lights"):
        fit_intensities(readings[2:6], np.ones((4, readings.shape[1]), bool), directions[2:6])
