"""What explains images better than their manifest; tests/service/solve/lights/test_diagnosis.py tries the whole way from a capture."""

import numpy as np
import pytest

from service.light_estimation.explanations import Cause, Sample, better_explanation, fit_manifest
from service.light_estimation.lambertian import fit_lambertian, median_of
from tests.scenes.captures import angles_degrees
from tests.scenes.ellipsoid import ellipsoid


def sample(count=16, every=5, **changes):
    scene = ellipsoid(count=count)
    given = Sample(scene.images[:, scene.mask][:, ::every], np.ones((count, len(scene.images[0, scene.mask][::every])), bool),
                   scene.directions, scene.irradiance, np.ones(count), "lin_rec709_scene")
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
    seen = np.where(recorded < 0.0031308, 12.92 * recorded, 1.055 * np.maximum(recorded, 1e-9) ** (1 / 2.4) - 0.055)
    found = explain(given._replace(radiance=seen / exposure[:, None, None], exposure=exposure))
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
    assert found.spread == pytest.approx(np.log(right.irradiance).std(axis=0).max(), rel=0.2)  # over the lights that were measured
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
