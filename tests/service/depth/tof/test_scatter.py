"""Pixels of a time-of-flight camera that each have a zero of their own: said, and held by σ."""

import numpy as np
import pytest

from tests.reference import tof
from tests.scenes.tof import cw_frames, pulsed_frames, write
from tests.service.depth.tof.test_tof import VIEW, run

SETTINGS = tof.even(tof.HZ, 4)
OWN_M = 0.08
"""Standard deviation of the zeros, metres: some times what photons leave."""


def frames(kind, view):
    if kind == "phases":
        return cw_frames(tof.correlations(view, 40_000, SETTINGS, seed=4), SETTINGS)
    return pulsed_frames(tof.histogram(view, 6000, background=0.5, seed=4))


@pytest.mark.parametrize("kind", ["phases", pytest.param("timers", marks=pytest.mark.long)])
def test_zeros_of_pixels_are_said_and_held(tmp_path, kind):
    own = np.random.default_rng(1).normal(0, OWN_M, VIEW.distance.shape)
    _, maps, report = run(write(tmp_path / "own", frames(kind, VIEW._replace(distance=VIEW.distance + own))))
    assert report["found"]["pixel_scatter_m"] == pytest.approx(OWN_M, rel=0.25)
    assert any("timers or phases" in sentence for sentence in report["warnings"])
    off = np.abs(maps.range - VIEW.distance)[maps.mask] / maps.sigma[maps.mask]
    assert np.median(off) < 1.4 and np.mean(off > 5) < 0.03


@pytest.mark.parametrize("kind", ["phases", pytest.param("timers", marks=pytest.mark.long)])
def test_a_common_zero_raises_no_doubt(tmp_path, kind):
    _, _, report = run(write(tmp_path / "right", frames(kind, VIEW)))
    assert "pixel_scatter_m" not in report["found"]
