"""The bound on range against closed forms, against derivatives by differences, and against what no decoder reaches."""

from dataclasses import replace

import numpy as np
import pytest

from stage.tof.bound import range_bound_m
from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.simulate import HistogramCamera, TofScene, histograms

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
