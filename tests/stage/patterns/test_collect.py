"""Frames are sorted into codes whatever their order, and incomplete codes are named."""

import random

import pytest
from pydantic import TypeAdapter, ValidationError

from stage.errors import ManifestError
from stage.patterns.binary import BinaryCode, BinaryPattern, binary_patterns, xor_patterns
from stage.patterns.codes import Pattern, collect
from stage.patterns.kary import KaryCode, kary_patterns
from stage.patterns.modulated import ModulatedCode, modulated_patterns
from stage.patterns.phase import PhaseCode, PhasePattern, phase_patterns
from stage.patterns.ramp import RampCode, ramp_patterns


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
