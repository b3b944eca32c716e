"""Frames of waves whose steps, periods or loops are declared in another order are named, and what else is wrong with frames is not taken
for it: the scene of test_wave_checks.py, in closed form, under shot noise."""

import numpy as np
import pytest

from service.depth.patterns.wave_order import check_order
from stage.patterns.codes import collect
from stage.patterns.phase import phase_patterns
from tests.service.depth.patterns.test_wave_checks import EXTENT, NOISE, changed, frames_of, said

SETS = {"one": ((EXTENT,), 4), "one of eight": ((50.0,), 8), "two": ((EXTENT, 50.0), 3), "three": ((19.0, 22.0, 26.0), 4)}


def patterns_of(name):
    periods, steps = SETS[name]
    return list(phase_patterns("column", periods, steps))


def interleaved(patterns, steps):
    """The same patterns, all periods of a step before the next step."""
    return [pattern for step in range(steps) for pattern in patterns[step::steps]]


def order_said(sample, declared):
    return check_order(sample, collect(list(declared)), NOISE)


@pytest.mark.parametrize("gamma", [0.45, 1.0, 2.2])
@pytest.mark.parametrize("name", SETS)
def test_right_orders_and_other_faults_raise_no_doubt_of_the_order(name, gamma):
    patterns = patterns_of(name)
    sample = frames_of(patterns, gamma=gamma)
    values = sample.values
    flicker = (1 + 0.1 * np.sin(2.2 * np.arange(len(values)))).astype(np.float32)[:, None, None]
    dim = np.where(np.arange(len(values)) == 1, np.float32(0.3), np.float32(1))[:, None, None]
    for seen in (values, 0.8 * values + 0.2 * np.roll(values, -1, axis=0), values * flicker, values * dim, np.roll(values, 1, axis=0)):
        assert order_said(sample._replace(values=seen), patterns) is None


@pytest.mark.parametrize("gamma", [0.45, 0.55, 2.2, 2.6])
@pytest.mark.parametrize("steps", [4, 5])
def test_bent_waves_of_which_half_a_turn_is_seen_are_not_taken_for_other_steps(steps, gamma):
    patterns = list(phase_patterns("column", (EXTENT,), steps))
    sample = frames_of(patterns, gamma=gamma)
    for first, last in ((0, 55), (36, 109), (54, 91), (54, 109), (72, 127)):
        mask = sample.mask.copy()
        mask[:, :first], mask[:, last:] = False, False
        assert order_said(sample._replace(mask=mask), patterns) is None


@pytest.mark.parametrize("gamma", [1.0, 2.2])
@pytest.mark.parametrize("name", ["one", "one of eight", "three"])
def test_exchanged_steps_are_named(name, gamma):
    """Four steps whose 1 and 2 are exchanged are the same waves, run backwards, as those whose 0 and 3 are: the sentence names both
    exchanges. Among eight steps one exchange alone fits."""
    patterns = patterns_of(name)
    declared = changed(patterns, step=lambda pattern: {1: 2, 2: 1}.get(pattern.step, pattern.step))
    found = order_said(frames_of(patterns, gamma=gamma), declared)
    assert ("the steps 1 and 2 are exchanged" if name == "one of eight" else "the steps 0 and 3 or 1 and 2 are exchanged") in found


@pytest.mark.parametrize("gamma", [1.0, 1.2])
@pytest.mark.parametrize("more", [-1, 1])
@pytest.mark.parametrize("name", ["one", "one of eight", "three"])
def test_steps_that_are_another_part_of_a_period_are_named(name, more, gamma):
    """A last frame that shows the first pattern again (both ends of a period), and one that is left out: nearly all depths of a wave with
    Gray code were off by more than five sigma."""
    patterns = patterns_of(name)
    steps = SETS[name][1] + more
    shown = changed(patterns, steps=lambda pattern: steps, step=lambda pattern: pattern.step % steps)
    assert f"a step is 1/{steps} of a period: check step and steps" in order_said(frames_of(shown, gamma=gamma), patterns)


@pytest.mark.parametrize("name", ["two", "three"])
def test_exchanged_loops_are_named(name):
    """Three steps of one wave fit any phase, but all periods have one mean."""
    patterns, steps = patterns_of(name), SETS[name][1]
    assert "--order axis,step,period" in order_said(frames_of(interleaved(patterns, steps)), patterns)
    assert "--order axis,period,step" in order_said(frames_of(patterns), interleaved(patterns, steps))


@pytest.mark.long
@pytest.mark.parametrize("order", [(26.0, 22.0, 19.0), (22.0, 19.0, 26.0), (26.0, 19.0, 22.0)])
def test_exchanged_periods_are_named(order):
    patterns = patterns_of("three")
    to = dict(zip((19.0, 22.0, 26.0), order, strict=True))
    assert "if their periods are 19, 22, 26 px, in the order" in said(patterns, changed(patterns, period_px=lambda p: to[p.period_px]))[0]


@pytest.mark.long
def test_a_wrong_period_is_not_taken_for_steps_that_run_backwards():
    patterns = list(phase_patterns("column", (42.0, 45.0, 48.0), 4))
    declared = changed(patterns, period_px=lambda pattern: {48.0: 49.0}.get(pattern.period_px, pattern.period_px))
    assert "of 49 px fit the others as waves of 48 px" in said(patterns, declared)[0]
