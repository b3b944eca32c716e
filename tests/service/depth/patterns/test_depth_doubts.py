"""relit depth on patterns that are bent, scattered, mirrored or declared wrongly: a right depth, a low confidence, or a sentence."""

import re

import numpy as np
import pytest

from kernels.status import Status
from stage.patterns.base import uniform_patterns
from stage.patterns.binary import binary_patterns
from stage.patterns.kary import kary_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from stage.patterns.ramp import ramp_patterns
from tests.marks import first_short
from tests.scenes.projected import Ball, Rig, Wall, World, trace, write_capture

RIG = Rig(camera=(120, 90), camera_focal=156.0, projector=(192, 144), projector_focal=252.0)
ROOM = World(shapes=(Wall((0, 0, -1.6), (0.2, 0.1, 1), texture=0.4), Ball((0.12, -0.05, -1.2), 0.16, 0.8)), rig=RIG)
WIDTH = RIG.projector[0]
GRAY = binary_patterns(WIDTH, "column")
GAMMA = (np.linspace(0, 1, 256) ** 2.2).tolist()


@pytest.fixture(scope="module")
def light():
    """The light of the room, which every capture of it shares."""
    return trace(ROOM)


def bent(light, **changes):
    """The room under a projector of gamma 2.2."""
    return World(shapes=ROOM.shapes, rig=RIG, gamma=2.2, **changes)


PHASES = {"three periods": phase_patterns("column", (16, 18, 21), 3),
          "one and Gray": (*phase_patterns("column", (16,), 3), *binary_patterns(WIDTH, "column", stripe_px=8)),
          "micro": micro_patterns(WIDTH, "column")}


@pytest.mark.long
@pytest.mark.parametrize("name", PHASES)
def test_the_response_is_taken_off_waves(relit, tmp_path, light, name):
    write_capture(tmp_path, bent(light), PHASES[name], light=light, response=GAMMA)
    maps, report, _ = relit.depth(tmp_path, code=None, unsure=True)
    error = np.abs(maps.depth - light.depth)[maps.mask]
    assert report["warnings"] == []
    assert maps.mask[light.lit].mean() > 0.6
    assert 0.5 < np.median(error / maps.sigma[maps.mask]) < 1.4 and (error > 5 * maps.sigma[maps.mask]).mean() < 0.01


@pytest.mark.long
@pytest.mark.parametrize("name", PHASES)
def test_bent_waves_are_found(relit, tmp_path, light, name):
    """Without the response σ holds the error, and a sentence says what to measure; a linear projector gives no sentence."""
    write_capture(tmp_path / "bent", bent(light), PHASES[name], light=light)
    maps, report, out = relit.depth(tmp_path / "bent", "--least-confidence", "0", code=None, unsure=True)
    error = np.abs(maps.depth - light.depth)[maps.mask]
    assert "relit calibrate response" in report["warnings"][0] and "projector.response" in out
    # where several periods are made to agree, the exponent takes over what the pixels' footprint rounds off the waves; without white it is
    # that of their second harmonic, which the footprint dims by a quarter
    seen = float(re.search(r"level\^([\d.]+\d|\d)", report["warnings"][0])[1])
    assert seen == pytest.approx(2.2, abs={"three periods": 0.25, "micro": 0.45}.get(name, 0.05))
    assert (error > 5 * maps.sigma[maps.mask]).mean() < 0.03
    write_capture(tmp_path / "linear", ROOM, PHASES[name], light=light)
    assert relit.depth(tmp_path / "linear").report["warnings"] == []


@first_short("name", ["one and Gray", "three periods"])
def test_a_response_that_waves_contradict_is_named_and_held_by_sigma(relit, tmp_path, light, name):
    """A linear projector is declared with gamma 2.2: up to 17 % of the depths were beyond five σ without a word."""
    write_capture(tmp_path, ROOM, PHASES[name], light=light, response=GAMMA)
    maps, report, _ = relit.depth(tmp_path, code=None, unsure=True)
    assert "projector.response: the projected waves look like its light to the power of 0.4" in report["warnings"][0]
    assert (np.abs(maps.depth - light.depth)[maps.mask] > 5 * maps.sigma[maps.mask]).mean() < 0.03


def test_the_response_is_taken_off_digits(relit, tmp_path, light):
    write_capture(tmp_path, bent(light), kary_patterns(WIDTH, "column", base=3, stripe_px=2), light=light, response=GAMMA)
    maps, *_ = relit.depth(tmp_path, code=None, unsure=True)
    assert maps.mask[light.lit].mean() > 0.6  # the others are undecided, and no answer is wrong
    assert (np.abs(maps.depth - light.depth)[maps.mask] > 5 * maps.sigma[maps.mask]).mean() < 0.01


@pytest.mark.long
def test_fog_is_no_surface(relit, tmp_path):
    """What shines through may be solved, and is right; the rest is kept beside it, and a sentence says why."""
    light = write_capture(tmp_path, World(shapes=ROOM.shapes, rig=RIG, fog=0.8, light=1.5, samples=2), GRAY)
    maps, report, _ = relit.depth(tmp_path, code=None, unsure=True)
    assert (maps.mask & (np.abs(maps.depth - light.depth) > 5 * maps.sigma)).mean() < 0.002
    scattered = maps.status == Status.MULTIPATH
    assert scattered.mean() > 0.3 and (maps.depth[scattered] != 0).mean() > 0.5
    assert "light comes by several ways" in report["warnings"][0]
    assert maps.confidence[scattered].max() < 0.2


@pytest.mark.long
def test_a_mirror_is_doubted(relit, tmp_path):
    mirrors = World(samples=2, shapes=(Wall((0, 0, -1.6), (0.2, 0.1, 1), texture=0.3), Wall((0, -0.32, 0), (0, 1, 0), 0.5),
                                       Ball((0.0, -0.1, -1.2), 0.16, mirror=True)))
    patterns = (*phase_patterns("column", (16,), 4), *binary_patterns(320, "column", stripe_px=8))
    light = write_capture(tmp_path, mirrors, patterns)
    maps, *_ = relit.depth(tmp_path, code=None, unsure=True)
    known = np.isfinite(light.depth)
    wrong = known & (np.abs(maps.depth - light.depth) > 0.02 * light.depth) & np.isin(maps.status, [Status.OK, Status.UNSURE])
    doubted = maps.status == Status.UNSURE
    assert wrong.sum() > 300 and doubted[wrong].mean() > 0.4
    assert maps.confidence[wrong & doubted].max() < 0.2
    assert (doubted & ~wrong).mean() < 0.005


def changed(patterns=GRAY, **fields):
    """Patterns whose fields are changed by functions of themselves."""
    return [p.model_copy(update={name: change(p) for name, change in fields.items() if hasattr(p, name)}) for p in patterns]


DIGITS = kary_patterns(WIDTH, "column", base=3, reflected=False, stripe_px=4)
WAVES = (*phase_patterns("column", (16, 18, 21), 4), *uniform_patterns())


@pytest.mark.long
@pytest.mark.parametrize(("patterns", "declared", "words"), [
    (GRAY, changed(inverse=lambda p: not p.inverse), "patterns and inverses are exchanged"),
    (GRAY, changed(axis=lambda p: "row"), "columns and rows are exchanged"),
    (GRAY, changed(bit=lambda p: p.bits - 1 - p.bit), "the order of bits is reversed"),
    (GRAY, list(GRAY[::-1]), "the images are in reverse order"),
    (DIGITS, changed(DIGITS, levels=lambda p: p.levels[::-1]), "bright and dark levels of the digits are exchanged"),
    (DIGITS, changed(DIGITS, digit=lambda p: p.digits - 1 - p.digit), "the order of digits is reversed"),
    (WAVES, changed(WAVES, step=lambda p: {0: 2, 2: 0}.get(p.step, p.step)), "the steps 0 and 2 of the phases are exchanged"),
])
def test_a_wrong_declaration_is_named(relit, tmp_path, light, patterns, declared, words):
    write_capture(tmp_path, ROOM, patterns, light=light, declared=declared)
    maps, *_ = relit.depth(tmp_path, code=None, unsure=True)
    assert not maps.mask.any()
    maps, report, _ = relit.depth(tmp_path, "--least-confidence", "0", code=None, unsure=True)
    assert words in report["warnings"][0]
    assert np.percentile(maps.confidence[maps.mask], 99) < 0.2


@pytest.mark.long
def test_most_pixels_refused_is_said(relit, tmp_path, light):
    """A projector of another focal length than declared: columns and rows contradict each other."""
    patterns = (*binary_patterns(WIDTH, "column", references=False), *binary_patterns(RIG.projector[1], "row"))
    write_capture(tmp_path, ROOM, patterns, light=light, focal_px=[2 * RIG.projector_focal] * 2)
    maps, report, _ = relit.depth(tmp_path, code=None, unsure=True)
    assert any("lit pixels have a depth that can be trusted; most of the" in sentence for sentence in report["warnings"])
    assert not maps.mask.any() and maps.confidence.max() < 0.2  # those whose lines of sight meet do so by chance


def test_noisy_ramps_are_not_taken_for_another_order(relit, tmp_path, light):
    """Noise of weak light makes neighbours differ by as much as their deviations say: a fifth agree, and half if the images are one
    frame early."""
    noisy = World(shapes=ROOM.shapes, rig=RIG, read_noise=0.012, electrons=2000.0)
    write_capture(tmp_path, noisy, ramp_patterns("column"), light=light)
    _, report, out = relit.depth(tmp_path, "--read-noise", 0.012, "--photon-gain", 1 / 2000, code=None, unsure=True)
    assert "as declared" not in out and report["pixels"]["ok"] > 0


@pytest.mark.long
@pytest.mark.parametrize("patterns", [GRAY, DIGITS, WAVES,
                                      (*binary_patterns(WIDTH, "column"), *binary_patterns(RIG.projector[1], "row", references=False))])
def test_right_captures_raise_no_alarm(relit, tmp_path, light, patterns):
    write_capture(tmp_path, ROOM, patterns, light=light)
    maps, report, out = relit.depth(tmp_path, code=None, unsure=True)
    assert report["warnings"] == [] and "warning" not in out
    error = np.abs(maps.depth - light.depth)[maps.mask]
    assert maps.mask[light.lit].mean() > 0.85 and (maps.status == Status.UNSURE).mean() < 0.02
    assert 0.4 < np.median(error / maps.sigma[maps.mask]) < 1.4 and (error > 5 * maps.sigma[maps.mask]).mean() < 0.012
