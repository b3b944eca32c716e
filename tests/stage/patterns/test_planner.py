"""Counts of Nayar's lecture 3-5, and formulae against simulated noise."""

import numpy as np
import pytest

from stage.patterns import planner
from stage.patterns.base import digit_count

RIG = planner.Rig(0.2, 1.5, 2000)


def test_the_lectures_counts():
    assert planner.point_count(640, 480) == 307200
    assert planner.point_count(640, 480) / 30 / 3600 == pytest.approx(2.84, abs=0.01)  # nearly 3 hours at 30 fps
    assert planner.line_count(640) / 30 == pytest.approx(21.3, abs=0.1)
    assert planner.kary_count(255) == 8 and planner.kary_count(256) == 9
    assert planner.kary_count(7) == 3
    assert planner.kary_count(7, 3) == 2 and planner.kary_count(8, 3) == 2 and planner.kary_count(9, 3) == 3
    assert (planner.RATIO_COUNT, planner.PHASE_COUNT) == (2, 3)


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 242, 243, 244, 1 << 20])
@pytest.mark.parametrize("base", [2, 3, 10])
def test_digits_are_enough_and_not_more(count, base):
    digits = digit_count(count, base)
    assert base**digits >= count and (digits == 1 or base ** (digits - 1) < count)


@pytest.mark.parametrize("steps", [3, 4, 8])
def test_phase_precision_is_that_of_simulated_noise(steps):
    rng, noise, period, n = np.random.default_rng(0), 0.02, 16.0, 20000
    u = rng.uniform(0, 16, n)
    angles = 2 * np.pi * np.arange(steps) / steps
    readings = 1 + np.cos(2 * np.pi * u / period - angles[:, None]) + noise * rng.normal(size=(steps, n))
    phase = np.arctan2((readings * np.sin(angles)[:, None]).sum(0), (readings * np.cos(angles)[:, None]).sum(0))
    error = np.angle(np.exp(1j * (phase - 2 * np.pi * u / period))) * period / (2 * np.pi)
    assert planner.phase_sigma((period,), steps, noise) == pytest.approx(error.std(), rel=0.03)


def test_ramp_precision_is_that_of_simulated_noise():
    rng, noise, n = np.random.default_rng(0), 0.005, 20000
    x = rng.uniform(0, 1, n)
    up, down = 2 * x + noise * rng.normal(size=n), 2 * (1 - x) + noise * rng.normal(size=n)  # amplitude 1
    error = 640 * (up / (up + down) - x)
    assert planner.ramp_sigma(640, noise) == pytest.approx(np.sqrt((error**2).mean()), rel=0.03)


def test_depth_precision_is_the_derivative_of_triangulation():
    disparity = RIG.focal_px * RIG.baseline_m / RIG.distance_m
    step = 1e-4
    derivative = RIG.focal_px * RIG.baseline_m * (1 / (disparity - step) - 1 / disparity) / step
    assert planner.depth_sigma(RIG, 0.1) == pytest.approx(0.1 * derivative, rel=1e-5)


COST = planner.Cost("line", 8, 10, 0.3)


def test_a_line_of_the_table():
    row, = planner.tabulate([COST], frame_rate=30, rig=RIG)
    assert row[:3] == COST[:3] and row.seconds == pytest.approx(1 / 3)
    assert row.depth_sigma_m == planner.depth_sigma(RIG, 0.3)
    assert planner.tabulate([COST], frame_rate=30)[0].depth_sigma_m is None


@pytest.mark.parametrize("call, words", [
    (lambda: planner.tabulate([COST], frame_rate=0), "the frame rate is 0"),
    (lambda: planner.tabulate([COST], frame_rate=1, rig=planner.Rig(0, 1, 1)), "the baseline is 0"),
    (lambda: planner.kary_count(0), "0 stripes"),
])
def test_what_cannot_be_planned_is_one_sentence(call, words):
    with pytest.raises(ValueError, match=words):
        call()
