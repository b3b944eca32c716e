"""The simulator against an independent one, and its captures as files."""

from dataclasses import replace

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.errors import CalibrationError
from stage.tof.light_time import SPEED_OF_LIGHT, delay_s, range_of_delay_m, range_of_phase_m, toothed_wheel_speed_m_s
from stage.tof.raw_frames import read_correlations, read_histograms
from stage.tof.simulate import (
    CorrelationCamera,
    HistogramCamera,
    TofScene,
    correlation_images,
    histograms,
    range_bound_m,
    write_correlations,
    write_histograms,
)
from tests.reference import tof

VIEW = tof.room(9, 12)
SCENE = TofScene(range_m=VIEW.distance, albedo=VIEW.albedo, cosine=VIEW.cosine)
CAMERA = Camera(projection="perspective", resolution=(12, 9), focal_px=(10, 10))


def test_mean_correlations_are_those_of_the_twin():
    camera = CorrelationCamera(phases=5, harmonics=(0.02, 0.1), ambient_electrons=0)
    second = TofScene(range_m=VIEW.distance, albedo=VIEW.albedo, cosine=VIEW.cosine, second_m=1.4, second_part=0.3)
    twin = tof.correlations(VIEW, 1e5, tof.even(tof.HZ, 5), harmonics={2: 0.02, 3: 0.1}, second=(1.4, 0.3))
    np.testing.assert_allclose(correlation_images(second, camera), np.maximum(twin, 0), rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("pulses", [None, 3000])
def test_mean_histograms_are_those_of_the_twin(pulses):
    camera = HistogramCamera(pulses=pulses, start_s=2e-9)
    twin = tof.histogram(VIEW, 4000, pulses=pulses, start_s=2e-9)
    np.testing.assert_allclose(histograms(SCENE, camera), twin, rtol=1e-9, atol=1e-9)


def test_noise_has_the_variance_that_the_model_says():
    flat = TofScene(range_m=np.full((200, 200), 2.0), albedo=np.full((200, 200), 0.5), cosine=np.ones((200, 200)))
    small = TofScene(range_m=np.full((100, 100), 2.0), albedo=np.full((100, 100), 0.5), cosine=np.ones((100, 100)))
    camera = CorrelationCamera(ambient_electrons=100)
    random = np.random.default_rng(0)
    for mean, image in zip(correlation_images(flat, camera), correlation_images(flat, camera, random), strict=True):
        assert image.var() == pytest.approx(mean[0, 0] + 25, rel=0.03)
    counts = histograms(small, HistogramCamera(pulses=2000), random)
    np.testing.assert_allclose(counts.mean(axis=(0, 1)), histograms(small, HistogramCamera(pulses=2000))[0, 0], rtol=0.02, atol=0.02)
    assert counts.sum(axis=-1).max() <= 2000


def test_captures_are_read_back(tmp_path):
    sensor = CorrelationCamera(full_well=2e5)
    images = correlation_images(SCENE, sensor)
    assert images.max() == 2e5
    write_correlations(tmp_path / "cw", "room", images, CAMERA, sensor)
    capture = Capture.open(tmp_path / "cw")
    assert capture.manifest.saturation == 2e5
    np.testing.assert_allclose(read_correlations(capture).images, images.reshape(12, -1), rtol=1e-6)
    counter = HistogramCamera(pulses=1000)
    write_histograms(tmp_path / "pulsed", "room", histograms(SCENE, counter), CAMERA, counter)
    assert read_histograms(Capture.open(tmp_path / "pulsed")).pulses == 1000


def test_scenes_that_cannot_be_are_refused():
    one = np.ones((2, 2))
    with pytest.raises(CalibrationError, match="not above zero"):
        TofScene(range_m=0 * one, albedo=one, cosine=one)
    with pytest.raises(CalibrationError, match="must be one image"):
        TofScene(range_m=one, albedo=one[0], cosine=one)
    with pytest.raises(CalibrationError, match="second return"):
        TofScene(range_m=one, albedo=one, cosine=one, second_m=-1.0)


def test_light_takes_its_time():
    assert delay_s(2000) == pytest.approx(6.671e-6, abs=1e-9)
    assert range_of_delay_m(delay_s(2 * 7.0)) == pytest.approx(7.0)
    assert range_of_phase_m(np.pi, 30e6) == pytest.approx(2.498, abs=5e-4)
    assert toothed_wheel_speed_m_s(8633, 720, 12.68) == pytest.approx(3.153e8, rel=1e-3)


WALL = TofScene(range_m=np.linspace(4.0, 4.5, 6)[None], albedo=np.full((1, 6), 0.5), cosine=np.full((1, 6), 0.9))
FINE = HistogramCamera(bins=1200, bin_s=5e-11, background=0.0)


def test_without_background_it_is_the_pulse_over_the_root_of_the_photons():
    photons = 4000 * 0.45 / WALL.range_m**2
    np.testing.assert_allclose(range_bound_m(WALL, FINE), 0.5 * SPEED_OF_LIGHT * 1.2e-9 / np.sqrt(photons), rtol=1e-3)  # bins of σ/24


def test_coarse_bins_and_background_cost():
    coarse = range_bound_m(WALL, HistogramCamera(background=0.0))
    assert (coarse > range_bound_m(WALL, FINE)).all()
    assert (range_bound_m(WALL, HistogramCamera(background=5.0)) > coarse).all()


@pytest.mark.parametrize("pulses", [None, 60])
def test_it_is_the_curvature_of_the_likelihood(pulses):
    """Second derivatives of the expected log likelihood, by differences of time and strength."""
    camera = HistogramCamera(background=0.3, pulses=pulses)
    counts = histograms(WALL, camera)[0, 2]
    left = 0.0 if pulses is None else pulses - np.concatenate([[0.0], np.cumsum(counts)[:-1]])

    def likelihood(range_m, strength):
        scene = TofScene(range_m=np.array([[range_m]]), albedo=np.array([[1.0]]), cosine=np.array([[1.0]]))
        mean = histograms(scene, replace(camera, pulses=None, signal_photons=strength * range_m**2))[0, 0]
        if pulses is None:
            return float((counts * np.log(mean) - mean).sum())
        return float((counts * np.log(-np.expm1(-mean / pulses)) - (left - counts) * mean / pulses).sum())

    range_m = float(WALL.range_m[0, 2])
    here, steps = np.array([range_m, 4000 * 0.45 / range_m**2]), np.diag([1e-3, 1e-2])
    fisher = np.zeros((2, 2))
    for i in range(2):
        for j in range(2):
            terms = [a * b * likelihood(*(here + a * steps[i] + b * steps[j])) for a in (1, -1) for b in (1, -1)]
            fisher[i, j] = -sum(terms) / (4 * steps[i, i] * steps[j, j])
    assert range_bound_m(WALL, camera)[0, 2] == pytest.approx(np.linalg.inv(fisher)[0, 0] ** 0.5, rel=1e-3)


def test_what_lies_outside_the_histogram_has_no_bound():
    assert np.isinf(range_bound_m(replace(WALL, range_m=WALL.range_m + 100), HistogramCamera())).all()
