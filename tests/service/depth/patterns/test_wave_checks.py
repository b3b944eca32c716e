"""Waves without stripes that are declared otherwise than they were shown are named, and right ones raise no doubt: waves of a hilly field
and a post before it, in closed form, under shot noise, of a projector that is seen whole or in part."""

import numpy as np
import pytest

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.triangulate import ProjectorModel
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import Sample
from service.depth.patterns.wave_checks import bent_back, check_waves
from service.depth.patterns.wave_range import check_range
from stage.patterns.codes import collect
from stage.patterns.phase import phase_patterns
from tests.marks import first_short

EXTENT, ROW_EXTENT, ROWS, COLS = 400, 300, 24, 150
NOISE = NoiseModel(0.004, 1e-4)
BASELINE = 0.2


def rig(side=1):
    """The projector beside the camera, looking the same way: x right, y down, z forward of it."""
    turn = np.diag([1.0, -1.0, -1.0])
    return ProjectorModel((EXTENT, ROW_EXTENT), (500.0, 500.0), (EXTENT / 2, 150.0), (0, 0, 0), (0, 0),
                          np.column_stack([turn, [-side * BASELINE, 0, 0]]))


def seen(side=1, field=0.42):
    """Lines of sight and columns of a hilly field with a post before it; NaN beyond the projector."""
    x, y = np.meshgrid(np.linspace(-field, field, COLS), np.linspace(0.2, -0.2, ROWS))
    z = 1.5 + 0.12 * np.sin(5 * x + 2 * y) * np.cos(4 * y) - 0.3 * (np.abs(x - 0.1) < 0.02)
    u = EXTENT / 2 + 500 * (x - side * BASELINE / z)
    return x, y, np.where((u >= 0) & (u < EXTENT), u, np.nan)


def frames_of(patterns, *, side=1, field=0.42, gamma=1.0):
    """What a camera records of these patterns, as a sample."""
    rng = np.random.default_rng(7)
    x, y, u = seen(side, field)
    albedo = 0.55 + 0.35 * np.sign(np.sin(60 * x) * np.sin(50 * y))
    v = ROW_EXTENT / 2 - 500 * y / 2
    light = np.stack([np.nan_to_num(pattern.level(u, v, EXTENT) if pattern.axis == "column" else pattern.level(v, u, ROW_EXTENT)) ** gamma
                      for pattern in patterns])
    frames = albedo * (0.75 * light + 0.04)
    frames = frames + rng.normal(0, 1, frames.shape) * np.sqrt(NOISE.read**2 + NOISE.gain * frames)
    return Sample(frames.reshape(len(frames), 1, -1).astype(np.float32), None, x.astype(np.float32), y.astype(np.float32), np.isfinite(u))


def said(patterns, declared, *, calibrated=True, side=1, **seen_as):
    """Both sentences about frames of these patterns."""
    sample, projector = frames_of(patterns, side=side, **seen_as), PatternProjector((EXTENT, ROW_EXTENT))
    found = check_waves(sample, collect(list(declared)), projector, rig(side) if calibrated else None, NOISE)
    return (*found, bent_back(sample, collect(list(declared)), projector, NOISE))


def changed(patterns, **fields):
    return [pattern.model_copy(update={name: change(pattern) for name, change in fields.items()}) for pattern in patterns]


def reversed_steps(patterns):
    return changed(patterns, step=lambda p: -p.step % p.steps)


def offset(patterns, by):
    return changed(patterns, offset_rad=lambda p: p.offset_rad + by)


ONE, FOUR = phase_patterns("column", (EXTENT,), 3), phase_patterns("column", (EXTENT,), 4)
THREE, TWO = phase_patterns("column", (19.0, 22.0, 26.0), 3), phase_patterns("column", (EXTENT, 50.0), 4)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("patterns", [ONE, FOUR, THREE, TWO], ids=["one", "four steps", "three", "two"])
def test_right_waves_raise_no_doubt(patterns, side):
    wrong, unconfirmed, bent = said(patterns, patterns, side=side)
    assert wrong is None and bent is None and (unconfirmed is not None) == (patterns in (ONE, FOUR))  # nothing numbers one wave


@pytest.mark.parametrize(("patterns", "declared", "words"), [
    (ONE, reversed_steps(ONE), "steps run backwards"),
    (ONE, offset(ONE, -np.pi / 2), "check offset_rad"),
    (FOUR, offset(FOUR, np.pi), "check offset_rad"),
    *(pytest.param(*more, marks=pytest.mark.long) for more in (
        (THREE, reversed_steps(THREE), "if their steps run backwards"), (THREE, offset(THREE, -np.pi / 2), "offset is changed by π/2"))),
    (THREE, changed(THREE, period_px=lambda p: {22.0: 21.4}.get(p.period_px, p.period_px)), "as waves of 22 px"),
    (TWO, changed(TWO, period_px=lambda p: {50.0: 52.0}.get(p.period_px, p.period_px)), "check period_px"),
], ids=["reversed", "sine", "four, half a turn", "three reversed", "three, sine", "period", "period of two"])
def test_a_wrong_declaration_is_named(patterns, declared, words):
    assert words in said(patterns, declared)[0]


def test_what_one_wave_does_not_tell_is_said():
    """In a narrow field the projector's borders are not seen, and other offsets give other depths before camera and projector."""
    wrong, unconfirmed, _ = said(ONE, ONE, field=0.06)
    assert wrong is None and "nothing in the capture confirms" in unconfirmed


@pytest.mark.parametrize("part", [0.1, 0.2, 0.3])
def test_frames_of_one_wave_that_mix_two_patterns_are_not_silent(part):
    """Each frame holds that part of the next: the wave is shifted, and stays a wave. The span that is said holds the shift."""
    mixed = 1 - part + part * np.exp(-2j * np.pi / 3)
    shift = np.angle(mixed)
    wrong, unconfirmed, _ = said(offset(ONE, shift), ONE)
    assert wrong is not None or "hold part of the next" in unconfirmed


def test_a_wave_that_runs_backwards_is_said_without_calibration():
    wrong, unconfirmed, _ = said(ONE, reversed_steps(ONE), calibrated=False)
    assert wrong is None and "run against the image" in unconfirmed


@pytest.mark.parametrize("periods", [(ROW_EXTENT,), (19.0, 22.0, 26.0)], ids=["one", "three"])
def test_waves_of_the_rows_keep_what_is_said_of_the_columns(periods):
    rows = phase_patterns("row", periods, 3)
    wrong, unconfirmed, _ = said([*ONE, *rows], [*reversed_steps(ONE), *rows], calibrated=False)
    assert wrong is None and unconfirmed.startswith("frames[].pattern: the column phases run")


@pytest.mark.long
@pytest.mark.parametrize("gamma", [1.5, 2.1])
def test_bent_waves_are_bent_back_by_the_exponent_that_makes_them_agree(gamma):
    """Grid of 0.05 in the exponent; what is left is that of half a step, 0.004 rad, and noise."""
    wrong, _, found = said(THREE, THREE, gamma=gamma)
    assert wrong is None and found.exponent == pytest.approx(gamma, abs=0.051) and found.left_rad < 0.03
    assert "if their steps run backwards" in said(THREE, reversed_steps(THREE), gamma=gamma)[0]


@pytest.mark.parametrize("gamma", [1.0, 1.8])
@first_short("declared", [250, 320, EXTENT, 500])
def test_waves_that_go_on_beyond_the_projector_are_named(declared, gamma):
    """A projector of 400 columns, seen from about 20 to 390; the waves repeat after 5 434."""
    sample, projector = frames_of(THREE, gamma=gamma), PatternProjector((declared, ROW_EXTENT))
    bent = bent_back(sample, collect(list(THREE)), projector, NOISE) or projector
    found = check_range(sample, collect(list(THREE)), bent, NOISE)
    if declared >= EXTENT:
        assert found is None
    else:
        assert found is not None and f"beyond the {declared} columns" in found and "projector.resolution" in found
        assert 330 < float(found.split("about ")[1].split(":")[0]) <= EXTENT


@pytest.mark.parametrize("period", [EXTENT, 1.1 * EXTENT, 1.5 * EXTENT])
@pytest.mark.parametrize("declared", [250, 300, EXTENT, 500])
def test_one_wave_that_goes_on_beyond_the_projector_is_named(declared, period):
    wave = phase_patterns("column", (period,), 3)
    found = check_range(frames_of(wave), collect(list(wave)), PatternProjector((declared, ROW_EXTENT)), NOISE)
    if declared >= EXTENT:
        assert found is None
    else:
        assert found is not None and f"beyond the {declared} columns" in found
