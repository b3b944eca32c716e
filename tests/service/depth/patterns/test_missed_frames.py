"""Frames that the projector missed are named, and no depth is believed: the scene and the images of tests/scenes/depth.py."""

import numpy as np
import pytest

from tests.marks import first_short
from tests.scenes.captures import write_image
from tests.scenes.depth import AMBIENT, BLACK_WHITE, depth_under, gray_patterns, grey_light, make_scene, phase_patterns

NUMBERED = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8)]
INVERSES = gray_patterns("column", stripe=2)
PLAIN = [*BLACK_WHITE, *gray_patterns("column", stripe=2, inverse=False)]
WAVES = [*phase_patterns("column", 16.0, 3), *phase_patterns("column", 18.0, 3), *phase_patterns("column", 21.0, 3)]
KARY = [*BLACK_WHITE, *({"code": "kary", "axis": "column", "base": 3, "digits": 4, "digit": digit, "stripe_px": 2, "levels": [0, 0.5, 1]}
                        for digit in reversed(range(4)))]
BINARY = [{**pattern, "code": "binary"} for pattern in INVERSES]
BINARY_PLAIN = [*BLACK_WHITE, *(pattern for pattern in BINARY if not pattern["inverse"])]
XOR = [{**pattern, "code": "xor", "base_bit": 0} for pattern in INVERSES]
NOISE = 0.003


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def measured(folder, scene, patterns, *, dark=(), again=(), copies=None, columns=None, noise=NOISE):
    """What relit depth says of frames of which some are dark, some show once more what the frame before shows, and some are the files of
    others, and what it makes of some columns of them."""
    light = grey_light(scene, patterns)
    for number in dark:
        light[number] = scene.albedo[..., 1] * AMBIENT
    for number in again:
        light[number] = light[number - 1]
    light += np.random.default_rng(4).normal(0, noise, light.shape)
    for number, source in (copies or {}).items():
        light[number] = light[source]
    mask = np.zeros(scene.depth.shape, np.uint8)
    mask[:, columns or slice(None)] = 255
    write_image(folder / "mask.png", mask)
    result = depth_under(folder, patterns, light, noise=0, changes={"mask": "mask.png"})
    return [warning for warning in result.warnings if "missed" in warning or "copy" in warning], result.maps.mask


@first_short(("patterns", "number"), [(NUMBERED, 1), (NUMBERED, 7), (INVERSES, 8), (INVERSES, 3), (PLAIN, 5), (WAVES, 4),
                                       (KARY, 5)],
             ids=["wave", "bit", "bit with inverse", "inverse", "bit without inverse", "one of several waves", "digit"])
def test_a_dark_frame_is_named(tmp_path, scene, patterns, number):
    said, solved = measured(tmp_path, scene, patterns, dark=[number])
    assert f"{number:02d}.exr shows no stripes" in said[0] and not solved.any()


@first_short(("patterns", "number"), [(NUMBERED, 2), (NUMBERED, 10), (INVERSES, 7), (BINARY, 6), (PLAIN, 5), (WAVES, 3),
                                       (KARY, 5)],
             ids=["wave", "bit", "inverse", "bit of a binary code", "bit without inverse", "next wave", "digit"])
def test_a_frame_that_shows_the_pattern_before_is_named(tmp_path, scene, patterns, number):
    said, solved = measured(tmp_path, scene, patterns, again=[number])
    assert f"{number:02d}.exr and {number - 1:02d}.exr show the same" in said[0] and not solved.any()


@pytest.mark.parametrize(("patterns", "copies"), [(INVERSES, {6: 4, 7: 5}), (INVERSES, {8: 2, 9: 3}), (INVERSES, {7: 5, 6: 4, 8: 4, 9: 5}),
                                                   (PLAIN, {6: 4}), (KARY, {5: 3})],
                         ids=["pair", "pair of an earlier one", "two pairs", "bit", "digit"])
def test_copies_of_earlier_frames_are_named(tmp_path, scene, patterns, copies):
    said, solved = measured(tmp_path, scene, patterns, copies=copies)
    number = min(copies)
    assert f"{number:02d}.exr and {copies[number]:02d}.exr are the same" in said[0] and not solved.any()


@first_short("patterns", [INVERSES, PLAIN, BINARY, XOR, WAVES, KARY, NUMBERED],
             ids=["inverses", "without inverses", "binary", "XOR", "waves", "digits", "numbered"])
def test_rendered_frames_without_noise_are_no_copies(tmp_path, scene, patterns):
    said, solved = measured(tmp_path, scene, patterns, columns=slice(30, 50), noise=0)
    assert not said and solved.any()


@first_short("columns", [None, slice(10, 16), slice(40, 50), slice(44, 56), slice(55, 85), slice(60, 75), slice(30, 75)], ids=str)
@first_short("patterns", [NUMBERED, INVERSES, PLAIN, BINARY, BINARY_PLAIN, XOR, WAVES, KARY, phase_patterns("column", 128.0),
                          phase_patterns("column", 128.0, 3)],
             ids=["numbered", "inverses", "without inverses", "binary", "binary without inverses", "XOR", "waves", "digits",
                  "one wave", "one wave of three steps"])
def test_bits_that_narrow_things_do_not_show_are_not_missed(tmp_path, scene, patterns, columns):
    said, solved = measured(tmp_path, scene, patterns, columns=columns)
    assert not said and solved.any()
