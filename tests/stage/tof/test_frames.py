"""Frames of time of flight, simulated and read."""

import json
from dataclasses import replace

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.errors import CalibrationError, ImageError, ManifestError
from stage.tof.light_time import SPEED_OF_LIGHT, delay_s, range_of_delay_m, range_of_phase_m, toothed_wheel_speed_m_s
from stage.tof.raw_frames import is_pulsed, read_correlations, read_histograms
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
from tests.scenes.captures import write_exr

VIEW = tof.room(9, 12)
SCENE = TofScene(range_m=VIEW.distance, albedo=VIEW.albedo, cosine=VIEW.cosine)
CAMERA = Camera(projection="perspective", resolution=(12, 9), focal_px=(10, 10))
ROWS, COLS = 3, 4
RAW = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [5, 5]}


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


def cw(hz=20e6, delta=0.0):
    return {"type": "cw", "modulation_hz": hz, "reference_phase_rad": delta}


def pulsed(**more):
    return {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0, **more}


def capture(folder, frames, **more):
    (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "t", "camera": RAW, "frames": frames, **more}))
    return Capture.open(folder)


def save(folder, name, values):
    np.save(folder / name, values)
    return name


def test_correlations_come_from_arrays_and_images(tmp_path):
    values = np.arange(12.0).reshape(ROWS, COLS) + 0.5
    write_exr(tmp_path / "b.exr", values)
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": cw()}, {"image": "b.exr", "tof": cw(delta=1.0)}])
    assert not is_pulsed(found)
    frames = read_correlations(found)
    np.testing.assert_allclose(frames.images, np.stack([values.ravel()] * 2))
    assert list(frames.reference_phase_rad) == [0, 1]
    assert list(frames.scale) == [1, 1]


def test_unequal_exposures_become_scales(tmp_path):
    zero = np.zeros((ROWS, COLS))
    frames = [{"image": save(tmp_path, f"{n}.npy", zero), "exposure_s": s, "tof": cw(delta=n)} for n, s in enumerate((1.0, 3.0))]
    np.testing.assert_allclose(read_correlations(capture(tmp_path, frames)).scale, [2, 2 / 3])


def test_histograms_of_several_frames_are_added(tmp_path):
    counts = np.ones((ROWS, COLS, 8), np.uint16)
    frames = [{"image": save(tmp_path, f"{n}.npy", counts), "tof": pulsed(pulses=100, first_photon_only=True)} for n in range(2)]
    found = read_histograms(capture(tmp_path, frames))
    assert found.counts.shape == (ROWS * COLS, 8) and (found.counts == 2).all()
    assert found.pulses == 200 and found.first_photon_only


@pytest.mark.parametrize(("values", "message"), [
    (np.ones((COLS, ROWS)), "is (4, 3), the camera's image is (3, 4)"),
    (np.ones((ROWS, COLS), complex), "not an array of real numbers"),
    (np.array([{"a": 1}], dtype=object), "not an array of real numbers"),
])
def test_arrays_that_are_no_correlation_are_refused(values, message, tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": cw()}])
    with pytest.raises(ImageError) as caught:
        read_correlations(found)
    assert message in str(caught.value) and "a.npy" in str(caught.value)


def test_a_truncated_array_is_refused(tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", np.ones((ROWS, COLS))), "tof": cw()}])
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole[:-9])
    with pytest.raises(ImageError, match=r"not a whole \.npy"):
        read_correlations(found)


@pytest.mark.parametrize(("values", "message"), [
    (np.ones((ROWS, COLS)), "(rows, cols, bins)"),
    (np.ones((ROWS, COLS, 2)), "has 2 bins"),
    (-np.ones((ROWS, COLS, 8)), "negative or not finite"),
    (np.zeros((ROWS, COLS, 8)), "every histogram is empty"),
])
def test_arrays_that_are_no_histogram_are_refused(values, message, tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": pulsed()}])
    with pytest.raises(ImageError) as caught:
        read_histograms(found)
    assert message in str(caught.value)


def test_manifests_that_do_not_fit_together_are_refused(tmp_path):
    counts, plane = np.ones((ROWS, COLS, 8)), np.ones((ROWS, COLS))
    save(tmp_path, "a.npy", counts), save(tmp_path, "b.npy", counts), save(tmp_path, "c.npy", plane)
    mixed = capture(tmp_path, [{"image": "a.npy", "tof": pulsed()}, {"image": "c.npy", "tof": cw()}])
    with pytest.raises(ManifestError, match="cw and pulsed"):
        is_pulsed(mixed)
    with pytest.raises(ManifestError, match=r"bins of b\.npy are others"):
        read_histograms(capture(tmp_path, [{"image": "a.npy", "tof": pulsed()}, {"image": "b.npy", "tof": pulsed(start_s=1e-9)}]))
    with pytest.raises(ManifestError, match="pulses: is missing"):
        read_histograms(capture(tmp_path, [{"image": "a.npy", "tof": pulsed(first_photon_only=True)}]))
