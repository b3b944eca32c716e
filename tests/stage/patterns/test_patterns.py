"""Pattern codes: drawn, planned, and found again among the frames of a capture."""

import random

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from stage.errors import ManifestError
from stage.patterns import planner
from stage.patterns.base import digit_count
from stage.patterns.binary import BinaryCode, BinaryPattern, XorPattern, binary_patterns, gray_of, xor_patterns
from stage.patterns.codes import Pattern, collect, draw
from stage.patterns.kary import KaryCode, digits_of, kary_patterns, palette
from stage.patterns.modulated import ModulatedCode, ModulatedPattern, modulated_patterns
from stage.patterns.phase import PhaseCode, PhasePattern, micro_patterns, phase_patterns
from stage.patterns.ramp import RampCode, RampPattern, ramp_patterns

SIZE = (24, 10)
RIG = planner.Rig(0.2, 1.5, 2000)


def transitions(codes: np.ndarray, bits: int) -> int:
    return sum(int((np.diff(codes >> bit & 1) != 0).sum()) for bit in range(bits))


def test_seven_stripes_change_ten_times_in_binary_and_six_in_gray():
    stripes_of_lecture = np.arange(1, 8)
    assert transitions(stripes_of_lecture, 3) == 10
    assert transitions(gray_of(stripes_of_lecture), 3) == 6


def test_ternary_stripes_are_01_to_21():
    words = ["".join(map(str, column[::-1])) for column in digits_of(np.arange(1, 8), 3, 2, reflected=False).T]
    assert words == ["01", "02", "10", "11", "12", "20", "21"]


@pytest.mark.parametrize("base", [2, 3, 4, 5])
def test_reflected_neighbours_differ_in_one_digit_by_one(base):
    digits = digits_of(np.arange(base**4), base, 4, reflected=True)
    assert (np.abs(np.diff(digits, axis=1)).sum(axis=0) == 1).all()
    assert len({tuple(column) for column in digits.T}) == base**4


def test_reflected_binary_is_gray():
    numbers = np.arange(64)
    digits = digits_of(numbers, 2, 6, reflected=True)
    np.testing.assert_array_equal((digits << np.arange(6)[:, None]).sum(axis=0), gray_of(numbers))


@pytest.mark.parametrize("axis", ["column", "row"])
def test_images_follow_the_contract(axis):
    """Each code, pixel by pixel, from its definition in words."""
    width, height = SIZE
    extent = width if axis == "column" else height
    for pattern in (BinaryPattern(code="binary", axis=axis, bit=1, bits=5),
                    BinaryPattern(code="gray", axis=axis, bit=1, bits=5, stripe_px=2),
                    BinaryPattern(code="gray", axis=axis, bit=0, bits=5, inverse=True),
                    RampPattern(code="ramp", axis=axis, direction="up"), RampPattern(code="ramp", axis=axis, direction="down"),
                    PhasePattern(code="phase", axis=axis, period_px=7.5, step=1, steps=3),
                    XorPattern(code="xor", axis=axis, bit=3, bits=5, base_bit=1),
                    XorPattern(code="xor", axis=axis, bit=0, bits=5, base_bit=1)):
        image = draw(pattern, SIZE)
        assert image.shape == (height, width) and image.dtype == np.float32
        for row, column in ((0, 0), (3, 5), (9, 23), (6, 17)):
            u = (column if axis == "column" else row) + 0.5
            c = int(u // getattr(pattern, "stripe_px", 1))
            match pattern:
                case BinaryPattern():
                    word = c ^ (c >> 1) if pattern.code == "gray" else c
                    expected = (word >> pattern.bit & 1) != pattern.inverse
                case XorPattern():
                    word = c ^ (c >> 1)
                    expected = (word >> pattern.bit & 1) ^ ((word >> 1 & 1) if pattern.bit > 1 else 0)
                case RampPattern():
                    expected = u / extent if pattern.direction == "up" else 1 - u / extent
                case PhasePattern():
                    expected = (1 + np.cos(2 * np.pi * u / 7.5 - 2 * np.pi / 3)) / 2
            assert image[row, column] == pytest.approx(float(expected), abs=1e-6), pattern


@pytest.mark.parametrize("base_bit, widest", [(0, 2), (1, 4)])
def test_xor_stripes_are_all_narrow(base_bit, widest):
    patterns = xor_patterns(256, "column", base_bit=base_bit, inverses=False)[:-2]
    for pattern in patterns:
        edges = np.flatnonzero(np.diff(draw(pattern, (256, 1))[0]))
        assert np.diff(edges).max() <= widest, pattern


def test_colours_have_three_channels_and_white_and_black_one():
    coarse, fine, white, black = (draw(pattern, (9, 2)) for pattern in kary_patterns(9, "column", base=3, colors=palette(3)))
    assert coarse.shape == fine.shape == (2, 9, 3) and white.shape == black.shape == (2, 9)
    np.testing.assert_array_equal(coarse[0, ::3], np.eye(3))  # the coarser digit over its three stripes
    assert (white == 1).all() and (black == 0).all()


@pytest.mark.parametrize("axis", ["column", "row"])
def test_modulated_patterns_vary_along_both_axes(axis):
    pattern = ModulatedPattern(code="modulated", axis=axis, period_px=20, step=1, steps=4,
                               carrier_period_px=8, carrier_step=2, carrier_steps=3)
    x, y = np.arange(24) + 0.5, np.arange(10)[:, None] + 0.5
    u, v = (x, y) if axis == "column" else (y, x)
    expected = (1 + np.cos(2 * np.pi * u / 20 - np.pi / 2)) / 2 * (1 + np.cos(2 * np.pi * v / 8 - 4 * np.pi / 3)) / 2
    np.testing.assert_allclose(draw(pattern, SIZE), expected, atol=1e-6)


def test_every_generated_entry_is_one_of_the_manifest():
    for patterns in (binary_patterns(100, "row"), xor_patterns(100, "row", base_bit=1),
                     kary_patterns(100, "column", base=4), ramp_patterns("column"),
                     phase_patterns("column", (16, 18, 21), 4), micro_patterns(200, "column", periods=4),
                     modulated_patterns("row", 100)):
        for pattern in patterns:
            data = pattern.model_dump(mode="json")
            assert TypeAdapter(Pattern).validate_python(data) == pattern
        assert len(set(patterns)) == len(patterns)


def test_micro_phase_shifting_takes_two_more_images_than_periods():
    patterns = micro_patterns(1280, "column", periods=5, mean_period_px=16)
    assert len(patterns) == 7
    assert all(abs(pattern.period_px / 16 - 1) <= 0.15 for pattern in patterns)


@pytest.mark.parametrize("call, words", [
    (lambda: binary_patterns(8, "column", stripe_px=0), "stripes of 0 px have no width"),
    (lambda: xor_patterns(8, "column", base_bit=3), "base bit 3 does not exist in 3 bits"),
    (lambda: kary_patterns(8, "column", base=1), "base 1"),
    (lambda: palette(9), "9 colours are not told apart"),
    (lambda: phase_patterns("column", (16, 16)), "periods 16, 16 are not several different ones"),
    (lambda: micro_patterns(100, "column", periods=2), "2 periods cannot tell the places apart"),
])
def test_what_cannot_be_drawn_is_one_sentence(call, words):
    with pytest.raises(ValueError, match=words):
        call()


def test_the_lectures_counts():
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
    assert row.cost == COST and row.seconds == pytest.approx(1 / 3)
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


def test_any_order_and_other_frames_between():
    patterns = [*binary_patterns(64, "column"), *xor_patterns(64, "row", base_bit=1)[:-2], None,
                *kary_patterns(64, "row", base=4)[:-2], *ramp_patterns("row")[:-2],
                *phase_patterns("column", (16, 18), 3), *modulated_patterns("row", 64)]
    random.Random(0).shuffle(patterns)
    found = collect(patterns)
    assert patterns[found.white].code == "white" and patterns[found.black].code == "black"
    assert {type(code) for code in found.codes if code.axis == "column"} == {BinaryCode, PhaseCode}
    assert {type(code) for code in found.codes if code.axis == "row"} == {BinaryCode, KaryCode, RampCode, ModulatedCode}
    for code in found.codes:
        match code:
            case BinaryCode():
                assert [patterns[f].bit for f in code.frames] == list(range(6)) == [patterns[f].bit for f in code.inverses]
                assert all(patterns[f].inverse for f in code.inverses) and not any(patterns[f].inverse for f in code.frames)
                assert code.base_bit == (1 if code.name == "xor" else 0)
            case KaryCode():
                assert [patterns[f].digit for f in code.frames] == [0, 1, 2]
            case RampCode():
                assert (patterns[code.up].direction, patterns[code.down].direction) == ("up", "down")
            case PhaseCode():
                assert len(code.frames) == 6
                assert all((patterns[f].period_px, patterns[f].step / 3) == (period, shift)
                           for f, period, shift in zip(code.frames, code.periods_px, code.shifts, strict=True))
            case ModulatedCode():
                assert [[(patterns[f].step, patterns[f].carrier_step) for f in row] for row in code.frames] == [
                    [(step, carrier) for carrier in range(3)] for step in range(4)]


def drop(patterns, test):
    return [pattern for pattern in patterns if not test(pattern)]


GRAY = binary_patterns(64, "column")


@pytest.mark.parametrize("patterns, words", [
    (drop(GRAY, lambda p: getattr(p, "bit", None) == 2 and not p.inverse), "column gray code of 6 bits has no frame of bit 2"),
    (drop(GRAY, lambda p: getattr(p, "bit", None) == 2 and p.inverse), "has inverses, but none of bit 2"),
    ([*GRAY, GRAY[3]], r"frames 3 and 14 show one pattern \(column gray bit 4 of 6"),
    ([*GRAY, BinaryPattern(code="gray", axis="column", bit=0, bits=6, stripe_px=2)], "disagree about stripe_px"),
    (kary_patterns(64, "row", base=4)[1:], "row kary code of 3 digits has no frame of digit 2"),
    (modulated_patterns("row", 64)[:-1], "no frame of step 3, carrier step 2"),
    ([PhasePattern(code="phase", axis="row", period_px=8, step=0, steps=3)] * 2, "row phase of 8 px, step 0 of 3"),
])
def test_incomplete_codes_are_one_sentence(patterns, words):
    with pytest.raises(ManifestError, match=words):
        collect(list(patterns))


@pytest.mark.parametrize(("data", "words"), [
    ({"code": "gray", "axis": "column", "bit": 4, "bits": 4}, "bit 4 does not exist in 4 bits"),
    ({"code": "gray", "axis": "column", "bit": -1, "bits": 4}, "bit"),
    ({"code": "binary", "axis": "diagonal", "bit": 0, "bits": 4}, "axis"),
    ({"code": "binary", "axis": "row", "bit": 0, "bits": 4, "stripe_px": 0}, "stripe_px"),
    ({"code": "kary", "axis": "row", "base": 1, "digit": 0, "digits": 1, "levels": [0]}, "base"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 2, "digits": 2, "levels": [0, 1]}, "digit 2 does not exist"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1}, "either levels or colors"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1, "levels": [0, 1], "colors": [[1, 0, 0], [0, 1, 0]]},
     "either"),
    ({"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 1, "levels": [0, 1]}, "levels has 2 entries, base is 3"),
    ({"code": "kary", "axis": "row", "base": 2, "digit": 0, "digits": 1, "levels": [0, 1.5]}, "levels"),
    ({"code": "ramp", "axis": "row", "direction": "left"}, "direction"),
    ({"code": "phase", "axis": "row", "period_px": 20, "step": 3, "steps": 3}, "step 3 does not exist"),
    ({"code": "phase", "axis": "row", "period_px": 20, "step": 0, "steps": 2}, "steps"),
    ({"code": "phase", "axis": "row", "period_px": 0, "step": 0, "steps": 3}, "period_px"),
    ({"code": "white", "axis": "row"}, "axis"),
])
def test_impossible_patterns_are_refused(data, words):
    with pytest.raises(ValidationError, match=words):
        TypeAdapter(Pattern).validate_python(data)


def test_a_black_stripe_is_a_colour():
    colors = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    data = {"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 1, "colors": colors}
    pattern = TypeAdapter(Pattern).validate_python(data)
    assert pattern.colors == ((0, 0, 0), (1, 0, 0), (0, 1, 0))
