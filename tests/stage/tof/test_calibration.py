"""Calibration of a time-of-flight camera: the file, and the fits."""

import json

import numpy as np
import pytest

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
from tests.reference.tof import LIGHT


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
