"""Patterns are what their manifest entries say, and the examples of Nayar's lecture 3-5 come out."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from stage.patterns.binary import BinaryPattern, XorPattern, binary_patterns, gray_of, xor_patterns
from stage.patterns.codes import Pattern, draw
from stage.patterns.kary import digits_of, kary_patterns, palette
from stage.patterns.modulated import ModulatedPattern, modulated_patterns
from stage.patterns.phase import PhasePattern, micro_patterns, phase_patterns
from stage.patterns.ramp import RampPattern, ramp_patterns

SIZE = (24, 10)


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
