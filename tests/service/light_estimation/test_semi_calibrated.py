"""Brightness of lights from the object, lights that contradict the others, and other readings of a manifest."""

import numpy as np
import pytest

from service.light_estimation.explanations import Cause, Sample, better_explanation, fit_manifest
from service.light_estimation.lambertian import fit_lambertian, median_of, suspects
from service.light_estimation.semi_calibrated import check_directions, fit_intensities, light_from_elsewhere, uncertainty_of
from stage.errors import CalibrationError
from tests.marks import first_short
from tests.reference.colour import linear_to_srgb
from tests.scenes.captures import angles_degrees, ring
from tests.scenes.ellipsoid import ellipsoid
from tests.service.calibrate.solvers.balls import spread, unit

RNG = np.random.default_rng(3)
TILT = np.radians(RNG.uniform(0, 40, 300))
TURN = RNG.uniform(0, 2 * np.pi, 300)
NORMAL = np.stack([np.sin(TILT) * np.cos(TURN), np.sin(TILT) * np.sin(TURN), np.cos(TILT)])
LIGHTS = ring(10)
LEVEL = RNG.uniform(0.2, 0.8, 300)
READINGS = LEVEL * np.maximum(LIGHTS @ NORMAL, 0)


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


@first_short(("lights", "least_z"), [(4, 0.7), (8, 0.8), (20, 0.3), (40, -0.6)])
def test_exact_readings_give_the_brightness(lights, least_z):
    """With few lights no reading is in shadow, with many a third are; what is left is Lambertian to rounding."""
    directions, irradiance, readings, _ = scene(lights, least_z)
    found = fit_intensities(readings, np.ones(readings.shape[:2], bool), directions)
    assert relative_error(found, irradiance).max() < 1e-6
    np.testing.assert_allclose(found.irradiance.mean(axis=0), 1)


def stated(*given):
    """The stated uncertainty of the lights that were found."""
    return uncertainty_of(*given, light_from_elsewhere(*given))


@pytest.mark.long
def test_noise_is_averaged_and_stated():
    """1 % of the brightest reading, 1500 pixels: each light's mean is known to 0.1 %; the stated error is of that size."""
    directions, irradiance, readings, _ = scene(20, 0.3)
    noisy = readings + 0.01 * readings.max() * 0.3 * np.random.default_rng(1).standard_normal(readings.shape)
    given = np.maximum(noisy, 0), np.ones(readings.shape[:2], bool), directions
    found = fit_intensities(*given)
    error = relative_error(found, irradiance)
    assert error.max() < 0.005
    # the stated error is twice that of a sixth of the pixels, which is 2.4 times as large, and more where they face one way
    assert 0.05 < np.sqrt((error**2).mean()) / stated(*given, found.irradiance).mean() < 1


@pytest.mark.long
@pytest.mark.parametrize("material", ["rough", "flat", "velvet"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_stated_uncertainty_holds_what_other_reflection_than_lamberts_makes(material, seed):
    """A broad lobe, light that falls by the power 0.8 of the cosine, and a rim: lights are 1 to 10 % off, and were sure to 0.05 %."""
    rng = np.random.default_rng(seed)
    directions, normals = spread(12, 0.4), spread(1500, 0.3)
    turned = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    directions[:, :2] = directions[:, :2] @ turned + 0.1 * rng.normal(size=(12, 2))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosine = np.maximum(directions @ normals.T, 0)
    half = directions + unit(0, 0, 1)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lobe = np.maximum(half @ normals.T, 0) ** 8
    shading = {"rough": cosine + 0.35 * (cosine > 0) * lobe, "flat": cosine**0.8, "velvet": cosine * (1.5 - normals[:, 2])}[material]
    if material == "velvet":
        shading = shading * (1 + 0.5 * (1 - cosine))
    irradiance = rng.uniform(0.5, 2.0, (12, 3))
    readings = rng.uniform(0.2, 0.8, (1500, 3)) * irradiance[:, None] * shading[..., None]
    given = readings, np.ones(readings.shape[:2], bool), directions
    found = fit_intensities(*given)
    ratio = relative_error(found, irradiance) / stated(*given, found.irradiance)
    assert np.median(ratio) < 2 and np.mean(ratio > 5) < 0.05, np.median(ratio)  # what all parts have in common is not seen


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


@pytest.mark.long
@pytest.mark.parametrize("part", [1 / 30, 1 / 10, 0])
def test_a_dim_light_is_told_from_one_that_does_not_burn(part):
    """Noise is a thousandth of the bright readings: a thirtieth is known to 3 % of itself a reading, and no pixel shows a dark light."""
    directions, irradiance, readings, _ = scene(8, 0.8)
    factor = np.where(np.arange(8) == 2, part * irradiance.mean() / irradiance[2].mean(), 1)[:, None]
    noise = 1e-3 * np.quantile(readings, 0.99) * np.random.default_rng(1).standard_normal(readings.shape)
    given = readings * factor[:, None] + noise, np.ones(readings.shape[:2], bool), directions
    found = fit_intensities(*given)
    burning = np.isfinite(found.irradiance).all(axis=1)
    assert burning.tolist() == [number != 2 or part > 0 for number in range(8)]
    true = (irradiance * factor)[burning]
    off = np.abs(found.irradiance[burning] / (true / true.mean(axis=0)) - 1)
    assert off.max() < 0.1 and np.delete(off, 2, axis=0).max() < 0.01
    assert (off / stated(*given, found.irradiance)[burning]).max() < 5


@pytest.mark.long
@pytest.mark.parametrize(("room", "bounced", "least"), [(0.1, 0, 0.03), (0, 0, 0), (0.03, 0, 0.01), (0, 1, 0.03)])
def test_light_from_elsewhere_is_measured_and_held(room, bounced, least):
    """From above, and from what lies around: lamps of a sixth of the others' strength were 10 % off at a twelfth of their uncertainty."""
    directions, irradiance, readings, normals = scene(12, 0.5)
    albedo = readings.max(axis=0) / (irradiance[:, None] * np.maximum(directions @ normals.T, 0)[..., None]).max(axis=0)
    added = room * irradiance.mean() * albedo * (1 + normals[:, 1:2]) / 2
    given = readings + added + bounced * albedo * readings.mean(axis=1, keepdims=True), np.ones(readings.shape[:2], bool), directions
    found = fit_intensities(*given)
    level = light_from_elsewhere(*given, found.irradiance)
    assert level.max() < 1e-3 if not least else (least < level).all() and (level < 4 * least).all()  # half of the room is dark
    assert (relative_error(found, irradiance) / stated(*given, found.irradiance)).max() < 2


def test_consistent_lights_are_no_suspects():
    noisy = READINGS * (1 + 0.02 * RNG.standard_normal(READINGS.shape))
    assert suspects(READINGS, LIGHTS, NORMAL) == [] and suspects(noisy, LIGHTS, NORMAL) == []


def test_a_light_of_another_strength_is_found_with_its_misfit():
    off = READINGS.copy()
    off[3] *= 1.5
    off[7] *= 0.7
    found = suspects(off, LIGHTS, NORMAL)
    assert [each.light for each in found] == [3, 7]
    assert [each.misfit for each in found] == pytest.approx([0.5, 0.3], abs=1e-9)  # the median over lights is the level


def test_lights_that_few_pixels_see_are_not_judged():
    assert suspects(READINGS[:, :10] * 2, LIGHTS, NORMAL[:, :10]) == []
    behind = LIGHTS * [1, 1, -1]
    assert suspects(READINGS, behind, NORMAL) == []


def sample(count=16, every=5, **changes):
    scene = ellipsoid(count=count)
    given = Sample(scene.images[:, scene.mask][:, ::every], np.ones((count, len(scene.images[0, scene.mask][::every])), bool),
                   scene.directions, scene.irradiance, np.ones(count), "lin_rec709_scene",
                   tuple(f"{number:03d}.exr" for number in range(count)))
    return given._replace(**changes)


def explain(given):
    return better_explanation(given, fit_manifest(given))


def test_a_right_manifest_needs_no_other_explanation():
    assert explain(sample()) is None
    assert fit_manifest(sample()).facing == 1
    assert fit_manifest(sample()).misfit() < 0.03  # noise of 0.003 of the brightest, most readings are a fifth of it


def test_exposures_are_part_of_what_was_recorded():
    """Encoded values are radiance times exposure: lights of very different exposure decode to what one curve explains."""
    given = sample()
    exposure = np.exp(np.random.default_rng(2).normal(size=16))
    recorded = given.radiance * exposure[:, None, None]
    recorded /= recorded.max()
    found = explain(given._replace(radiance=linear_to_srgb(recorded) / exposure[:, None, None], exposure=exposure))
    assert found is not None and found.cause is Cause.ENCODED and found.left < 0.03


def test_values_above_one_are_not_encoded():
    given = sample()
    bright = given._replace(radiance=3 * np.maximum(given.radiance / given.radiance.max(), 0) ** (1 / 2.2))
    found = explain(bright)
    assert found is None or found.cause is not Cause.ENCODED


def test_missing_brightness_is_measured_with_how_far_the_normals_are_off():
    right = sample()
    found = explain(right._replace(irradiance=np.ones((16, 3))))
    assert found is not None and found.cause is Cause.IRRADIANCE
    truth, wrong = fit_manifest(right), fit_manifest(right._replace(irradiance=np.ones((16, 3))))
    off = np.median(angles_degrees(truth.normal.T, wrong.normal.T))
    assert found.degrees == pytest.approx(off, rel=0.25)  # what the semi-calibrated fit leaves


@pytest.mark.parametrize("count", [3, 4, 5])
def test_few_lights_contradict_nothing(count):
    given = sample(count)
    assert explain(given._replace(irradiance=np.ones((count, 3)))) is None


def test_a_mirror_is_not_explained_by_its_lights():
    """Readings that are all highlights fit no Lambertian surface; they are not blamed on the manifest."""
    given = sample()
    half = given.directions + [0, 0, 1]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    normal = fit_manifest(given).normal
    shine = np.maximum(half @ normal, 0) ** 60
    assert explain(given._replace(radiance=(shine[..., None] * given.irradiance[:, None, :]))) is None


@pytest.mark.long
def test_false_directions_are_seen_beside_a_background_that_few_lights_reach():
    """As in JPEG files, where a dark background reads 0 under most lights and a code or two under some."""
    count = 80
    given = sample(count)
    background = np.zeros((count, 30, 3))
    background[:7] = 1e-3 * given.radiance.max()
    radiance = np.concatenate([given.radiance, background], axis=1)
    wrong = given._replace(radiance=radiance, usable=np.ones(radiance.shape[:2], bool),
                           directions=given.directions[np.random.default_rng(3).permutation(count)])
    found = explain(wrong)
    assert found is not None and found.cause is Cause.DIRECTIONS


def test_dark_and_unusable_pixels_leave_no_misfit():
    given = sample()
    dark = given._replace(radiance=np.zeros_like(given.radiance))
    assert np.isnan(fit_manifest(dark).misfit()) and explain(dark) is None
    blind = given._replace(usable=np.zeros_like(given.usable))
    assert not fit_manifest(blind).lit.any() and explain(blind) is None


def test_the_fit_leaves_highlights_and_shadows_out():
    given = sample()
    clean = given.radiance[..., 0] / given.irradiance[:, None, 0]
    spoilt = clean.copy()
    spoilt[2, ::2] *= 4
    spoilt[5, ::3] = 0
    found = fit_lambertian(spoilt, given.usable, given.directions)
    truth = fit_lambertian(clean, given.usable, given.directions)
    assert np.median(angles_degrees(found.normal.T, truth.normal.T)) < 0.5  # Cauchy weights leave an outlier a hundredth


def test_the_median_counts_chosen_values_alone():
    values, chosen = np.array([[1.0, 5.0], [2.0, 6.0], [9.0, 7.0]]), np.array([[True, False], [True, False], [True, False]])
    assert median_of(values, chosen).tolist() == [2.0, 0.0]
