"""Real pulsed time of flight with ground truth, where it is at hand: in the folder named by RELIT_TEST_DATA."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from kernels.tof.histogram.pileup import place, without_pileup
from kernels.tof.histogram.pulse_width import estimate_pulse
from kernels.tof.histogram.returns import find_returns
from stage.tof.calibration import TofCalibration, fit_line
from stage.tof.light_time import SPEED_OF_LIGHT

DATA = Path(os.environ.get("RELIT_TEST_DATA", "nowhere")) / "tmf8820_distance.json"
BIN_M = SPEED_OF_LIGHT * 9.1e-11 / 2

pytestmark = [pytest.mark.long, pytest.mark.skipif(not DATA.is_file(), reason=f"{DATA} is not at hand (RELIT_TEST_DATA)")]


def test_a_plane_at_159_poses_is_within_two_millimetres():
    """Scale and offset from every second pose, errors on the others; argmax and a constant leave 4.6 mm, its own ranges 19.3 mm."""
    poses = json.loads(DATA.read_text())
    truth = np.array([pose["dist_to_plane"] for pose in poses])
    counts = np.array([pose["hists"] for pose in poses], dtype=np.float32).sum(axis=1)  # the nine zones look at one plane
    histograms = without_pileup(place(counts, "cpu"))
    measured = find_returns(histograms, estimate_pulse(histograms, counts).pulse).position.numpy()[0] * BIN_M
    for half in (0, 1):
        fitted = np.arange(len(poses)) % 2 == half
        scale, offset = fit_line(measured[fitted], truth[fitted])
        error = TofCalibration(scale=scale, offset_m=offset).correct(measured[~fitted]) - truth[~fitted]
        assert np.sqrt(np.mean(error**2)) <= 2e-3
        assert scale == pytest.approx(1, abs=0.02)
