"""Calibration of time-of-flight cameras, and the way of light from a source beside them."""

import json

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.errors import CalibrationError, ManifestError
from stage.tof.calibration import (
    Harmonics,
    PulseShape,
    Temperature,
    TofCalibration,
    fit_harmonics,
    fit_line,
    fit_temperature,
    read_calibration,
    write_calibration,
)
from stage.tof.raw_frames import read_source
from stage.tof.source import SourcePath
from tests.reference.tof import LIGHT

PERSPECTIVE = Camera(projection="perspective", resolution=(16, 12), focal_px=(14, 15))
FLAT = Camera(projection="orthographic", resolution=(16, 12), pixel_size_m=0.02)
SOURCE = (0.31, -0.12, 0.07)


def test_the_file_comes_back_as_it_was(tmp_path):
    calibration = TofCalibration(electrons_per_unit=2.0, read_noise_electrons=5.0, offset_m=0.02, scale=1.01,
                                 harmonics=(Harmonics(modulation_hz=20e6, cos=(0.1, 0.2), sin=(0, -0.1)),),
                                 temperature=Temperature(reference_c=25, metres_per_c=1e-3),
                                 pulse=PulseShape(time_s=(0, 1, 2), power=(0, 1, 0)))
    write_calibration(calibration, tmp_path / "c.json")
    assert read_calibration(tmp_path / "c.json") == calibration
    assert calibration.of_frequency(20e6 * (1 + 1e-9)) is calibration.harmonics[0]
    assert calibration.of_frequency(30e6) is None


@pytest.mark.parametrize(("change", "message"), [
    ({"electrons_per_unit": 1.0}, "go together"),
    ({"pulse_sigma_s": 1e-9, "pulse": {"time_s": [0, 1, 2], "power": [0, 1, 0]}}, "exclude each other"),
    ({"pulse": {"time_s": [0, 2, 1], "power": [0, 1, 0]}}, "time_s is out of order: entry 2 is not after entry 1"),
    ({"harmonics": [{"modulation_hz": 1e6, "cos": [0], "sin": [0, 1]}]}, "give as many"),
    ({"harmonics": [{"modulation_hz": 1e6, "cos": [0], "sin": [0]}] * 2}, "given twice"),
    ({"wiggle": 1}, "wiggle"),
])
def test_bad_files_are_refused(change, message, tmp_path):
    (tmp_path / "c.json").write_text(json.dumps({"schema": "relit.tof/1", **change}))
    with pytest.raises(ManifestError) as caught:
        read_calibration(tmp_path / "c.json")
    assert message in str(caught.value)


def test_harmonics_are_found_from_a_sweep():
    hz, distance = 20e6, np.linspace(0.5, 9.0, 300)
    true = 4 * np.pi * hz / LIGHT * distance
    error = 0.3 + 0.05 * np.cos(4 * true) - 0.02 * np.sin(8 * true)
    measured = np.mod(true + error, 2 * np.pi)
    found = fit_harmonics(measured, distance, hz)
    angle = measured[:, None] * np.arange(len(found.cos))
    assert np.abs(np.cos(angle) @ np.array(found.cos) + np.sin(angle) @ np.array(found.sin) - error).max() < 3e-3  # beyond the twelfth


@pytest.mark.parametrize("offset", [3.1, -3.0])
def test_an_offset_of_half_a_turn_is_one_offset(offset):
    distance = np.linspace(0.5, 9.0, 300)
    measured = np.mod(4 * np.pi * 20e6 / LIGHT * distance + offset, 2 * np.pi)
    assert np.cos(fit_harmonics(measured, distance, 20e6).cos[0] - offset) == pytest.approx(1)


def test_sweeps_that_say_too_little_are_refused():
    with pytest.raises(CalibrationError, match="need 50 of each"):
        fit_harmonics(np.zeros(10), np.zeros(10), 20e6)
    with pytest.raises(CalibrationError, match="% of a turn at 20 MHz"):
        fit_harmonics(np.linspace(0, 1, 100), np.linspace(0, 1, 100), 20e6)
    with pytest.raises(CalibrationError, match="no line"):
        fit_line(np.ones(3), np.ones(3))
    with pytest.raises(CalibrationError, match="two different temperatures"):
        fit_temperature(np.ones(3), np.ones(3))


def test_line_and_drift_are_found_and_taken_out():
    true = np.linspace(1, 5, 30)
    scale, offset = fit_line(true / 1.01 + 0.07, true)
    np.testing.assert_allclose(TofCalibration(scale=scale, offset_m=offset).correct(true / 1.01 + 0.07), true)
    warm = np.linspace(20, 50, 30)
    drift, offset = fit_temperature(0.05 + 1e-3 * (warm - 35), warm)
    calibration = TofCalibration(temperature=drift, offset_m=offset)
    np.testing.assert_allclose(calibration.correct(np.array([2.05 + 5e-3]), 40.0), 2.0)
    with pytest.raises(CalibrationError, match="a temperature drift: give both or neither"):
        calibration.correct(true)
    with pytest.raises(CalibrationError, match="no temperature drift"):
        TofCalibration().correct(true, 20.0)


def lines_of_sight(camera):
    x, y = camera.plane_coordinates()
    if camera.projection == "orthographic":
        return np.stack([x, y, 0 * x], axis=-1), np.broadcast_to([0.0, 0.0, -1.0], (*x.shape, 3))
    rays = np.stack([x, y, -np.ones_like(x)], axis=-1)
    return np.zeros_like(rays), rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@pytest.mark.parametrize("camera", [PERSPECTIVE, FLAT], ids=["perspective", "orthographic"])
def test_range_of_a_measured_path(camera):
    rng, (begin, ray) = np.random.default_rng(1), lines_of_sight(camera)
    truth = rng.uniform(0.2, 6.0, (12, 16))
    points = begin + truth[..., None] * ray
    leg = np.linalg.norm(points - SOURCE, axis=-1)
    path = SourcePath.of(camera, SOURCE)
    np.testing.assert_allclose(path.source_range_m(truth), leg, rtol=1e-12)
    np.testing.assert_allclose(path.half_path_m(truth), (truth + leg) / 2, rtol=1e-12)
    found, per_metre = path.range_of((truth + leg) / 2)
    np.testing.assert_allclose(found, truth, rtol=1e-10)
    step = 1e-6  # a central difference: its error is step² times a third derivative of the order of one
    np.testing.assert_allclose(per_metre, (path.range_of((truth + leg) / 2 + step)[0] - path.range_of((truth + leg) / 2 - step)[0])
                               / (2 * step), rtol=1e-6)


def test_a_path_shorter_than_to_the_source_has_no_point():
    path = SourcePath.of(PERSPECTIVE, SOURCE)
    assert (path.range_of(np.full((12, 16), 0.4 * np.linalg.norm(SOURCE)))[0] <= 0).all()


def test_a_source_at_the_camera_changes_nothing():
    assert SourcePath.of(PERSPECTIVE, None) is None and SourcePath.of(PERSPECTIVE, (0.0, 0.0, 0.0)) is None


def test_frames_share_one_source(tmp_path):
    frames = [{"image": f"{k}.npy", "tof": {"type": "cw", "modulation_hz": 2e7, "reference_phase_rad": k, "source_m": [0.05 * k, 0, 0]}}
              for k in range(2)]
    (tmp_path / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "two", "frames": frames,
                                                       "camera": PERSPECTIVE.model_dump(mode="json", exclude_none=True)}))
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", np.zeros((12, 16)))
    with pytest.raises(ManifestError, match=r"source_m: 0.npy and 1.npy have different sources"):
        read_source(Capture.open(tmp_path))
