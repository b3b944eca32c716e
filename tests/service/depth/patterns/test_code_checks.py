"""Codes that are declared otherwise than they were shown are named, and right ones raise no doubt: a sphere before a plane, with shadow."""

from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.code_checks import check_codes, check_inverted
from service.depth.patterns.decoders import PatternProjector
from stage.capture.manifest import Frame
from stage.patterns.codes import collect
from tests.scenes.depth import BLACK_WHITE, PROJECTOR, gray_patterns, grey_light, make_scene, phase_patterns, sample_of

SIZE = PROJECTOR.width, PROJECTOR.height
NOISE = 0.004
GRAY = [*gray_patterns("column", stripe=2), *BLACK_WHITE]
WAVES = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8)]
THREE = [*phase_patterns("column", 18.0, 3), *gray_patterns("column", stripe=8, inverse=False), *BLACK_WHITE]
BINARY = [{**pattern, "code": "binary"} if pattern["code"] == "gray" else pattern for pattern in GRAY]


def kary(base, *, reflected=False):
    """Digits of an even number of stripes of 2 px, and white and black."""
    digits = int(np.ceil(np.log(SIZE[0] / 2) / np.log(base)))
    levels = [value / (base - 1) for value in range(base)]
    return [*({"code": "kary", "axis": "column", "base": base, "digit": digit, "digits": digits, "stripe_px": 2, "levels": levels,
               "reflected": reflected} for digit in range(digits)), *BLACK_WHITE]


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def said(scene, patterns, declared, size=SIZE):
    """The sentence of `check_codes` about these frames."""
    sample, collected, noise = sampled(scene, patterns, declared)
    return check_codes(sample, collected, PatternProjector(size), noise)


def sampled(scene, patterns, declared):
    """These frames with noise, of every second row, and what they are declared to be."""
    rng = np.random.default_rng(2)
    values = grey_light(scene, patterns)
    values = (values + rng.normal(0, NOISE, values.shape))[:, ::2]
    entries = [Frame.model_validate({"image": "a.png", "pattern": pattern}).pattern for pattern in declared]
    return sample_of(values), collect(entries), NoiseModel(NOISE, 0.0)


def changed(patterns, code, **fields):
    """Patterns with fields of those of one code changed by functions of the pattern."""
    return [{**pattern, **{name: change(pattern) for name, change in fields.items()}} if pattern["code"] == code else pattern
            for pattern in patterns]


@pytest.mark.parametrize("patterns", [
    GRAY, BINARY, WAVES, THREE, [*phase_patterns("row", 16.0), *gray_patterns("row", stripe=8)],
    [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=16)], kary(3), kary(4, reflected=True)],
    ids=["gray", "binary", "waves", "three", "rows", "wide", "3-ary", "4-ary, reflected"])
def test_right_declarations_raise_no_doubt(scene, patterns):
    assert said(scene, patterns, patterns) is None


@pytest.mark.parametrize(("patterns", "declared", "words"), [
    (GRAY, BINARY, "as those of a gray code"),
    (BINARY, GRAY, "as those of a binary code"),
    (WAVES, changed(WAVES, "phase", step=lambda p: -p["step"] % 4), "run against the stripes"),
    (THREE, changed(THREE, "phase", step=lambda p: -p["step"] % 3), "run against the stripes"),
    (WAVES, changed(WAVES, "phase", step=lambda p: (p["step"] + 1) % 4), "are offset by"),
    (BINARY, changed(BINARY, "binary", bit=lambda p: {4: 5, 5: 4}.get(p["bit"], p["bit"])), "the bits 4 and 5 are exchanged"),
    (WAVES, changed(WAVES, "phase", period_px=lambda p: 15.0), "look like waves of 1"),
    (BINARY, changed(BINARY, "binary", inverse=lambda p: p["inverse"] != (p["bit"] == 3)), "dark and bright of the bit 3 are exchanged"),
], ids=["gray as binary", "binary as gray", "reversed", "three reversed", "sine", "coarse bits", "period", "one bit and its inverse"])
def test_a_wrong_declaration_is_named(scene, patterns, declared, words):
    assert words in said(scene, patterns, declared)


@pytest.mark.parametrize("swap", list(combinations(range(6), 2)), ids=str)
def test_any_two_bits_that_are_exchanged_are_named(scene, swap):
    declared = changed(GRAY, "gray", bit=lambda p: dict([swap, swap[::-1]]).get(p["bit"], p["bit"]))
    assert f"the bits {swap[0]} and {swap[1]} are exchanged" in said(scene, GRAY, declared)


def xor(base_bit):
    return [{"code": "xor", "axis": "column", "bit": bit, "bits": 6, "base_bit": base_bit, "stripe_px": 2} for bit in range(6)]


@pytest.mark.parametrize("patterns", [
    gray_patterns("column", inverse=False), gray_patterns("column", stripe=4, inverse=False), gray_patterns("row", stripe=2, inverse=False),
    xor(0), xor(1), GRAY[:-2]], ids=["gray", "wide", "rows", "xor-02", "xor-04", "with inverses"])
def test_inverted_bits_are_named(scene, patterns):
    """Neighbours still differ in one bit, and lie three stripes or more apart: of XOR-04 96 % of the pixels were solved, 93 % of them more
    than five deviations off."""
    right = [*patterns, *BLACK_WHITE]
    inverted = [{**pattern, "inverse": not pattern.get("inverse", False)} for pattern in patterns] + BLACK_WHITE
    negative = [*inverted[:-2], *BLACK_WHITE[::-1]]  # of all images
    assert check_inverted(*sampled(scene, right, right)) is None
    for shown in inverted, negative:
        assert "follow each other only if" in check_inverted(*sampled(scene, shown, right))
    if patterns[0]["code"] == "gray":
        for swap in combinations(range(4), 2):  # exchanged bits are not inverted ones
            declared = changed(right, "gray", bit=lambda p, swap=swap: dict([swap, swap[::-1]]).get(p["bit"], p["bit"]))
            assert check_inverted(*sampled(scene, right, declared)) is None


@pytest.mark.parametrize("base", [3, 4, 5])
@pytest.mark.parametrize("reflected", [False, True])
def test_digits_that_are_declared_otherwise_are_named(scene, base, reflected):
    right = kary(base, reflected=reflected)
    assert f"reflected is {str(reflected).lower()}" in said(scene, right, kary(base, reflected=not reflected))
    exchanged = changed(right, "kary", digit=lambda p: {0: 1, 1: 0}.get(p["digit"], p["digit"]))
    assert "the digits 0 and 1 are exchanged" in said(scene, right, exchanged)


@pytest.mark.parametrize("base", [3, 4, 5])
def test_digits_that_a_projector_shows_as_a_power_of_their_levels_are_named(scene, base):
    """Two thirds of the pixels of a code of base 4 were solved without a word, most of them at other stripes."""
    declared = kary(base)
    shows = changed(declared, "kary", levels=lambda p: [level**2.2 for level in p["levels"]])
    assert "look like light = level^2.2" in said(scene, shows, declared)


@pytest.mark.parametrize("step", [2.2, 3.0, 3.4])
def test_stripes_that_neighbouring_pixels_skip_raise_no_doubt(step):
    """Gray numbers three stripes apart may differ in one bit, as those of stripes side by side always do."""
    row, col = np.indices((64, int(SIZE[0] / step)))
    uv = np.stack([step * (col + 0.01 * row), row + 0.5], axis=-1)
    plane = SimpleNamespace(albedo=np.full((*row.shape, 3), 0.7), uv=uv, shaded=np.zeros(row.shape, bool), depth=np.ones(row.shape))
    fine = [*gray_patterns("column", stripe=1), *BLACK_WHITE]
    assert said(plane, fine, fine) is None


def test_stripes_along_the_image_rows_do_not_look_backwards(step=4.36, tilt=-0.0162, width=40):
    """Two pixels of a stripe half a period wide tell nothing of the direction: no depth of such right captures was believed."""
    row, col = np.indices((int(0.95 * SIZE[1] / step), width))
    v = step * (row + tilt * (col - width / 2)) + 0.5
    uv = np.stack([col + 0.5, np.clip(v, 0, SIZE[1] - 0.5)], axis=-1)
    plane = SimpleNamespace(albedo=np.full((*row.shape, 3), 0.7), uv=uv, shaded=(v < 0) | (v > SIZE[1] - 1), depth=np.ones(row.shape))
    right = [*phase_patterns("row", 16.0), *gray_patterns("row", stripe=8)]
    assert said(plane, right, right) is None
    assert said(plane, right, changed(right, "phase", step=lambda p: -p["step"] % 4)) is not None


@pytest.mark.parametrize(("width", "step", "rise"), [(20, 4.7, 12), (37, 2.0, 29), (20, 1.0, 12)])
def test_stairs_along_the_stripes_hide_no_wrong_period_and_raise_no_doubt(width, step, rise):
    """On a step an image row sees one place of each stripe: of 60 right stairs 14 were refused, and 18 passed with a period 6 % wrong."""
    row, col = np.indices((64, 160))
    v = 8 + step * (row + 0.5) + rise * (col // width % 3)
    uv = np.stack([col + 0.5, np.clip(v, 0, SIZE[1] - 0.5)], axis=-1)
    stairs = SimpleNamespace(albedo=np.full((*row.shape, 3), 0.7), uv=uv, shaded=v > SIZE[1] - 1, depth=np.ones(row.shape))
    right = [*phase_patterns("row", 16.0), *gray_patterns("row", stripe=8)]
    assert said(stairs, right, right) is None
    assert said(stairs, right, changed(right, "phase", period_px=lambda p: 17.0)) is not None


def test_stripes_beyond_the_projector_are_named(scene):
    assert "projector.resolution" in said(scene, GRAY, GRAY, (88, 96))
