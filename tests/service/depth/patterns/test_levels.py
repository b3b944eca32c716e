"""Frames that hold part of the next pattern are named, and no depth is believed: the scene and the images of tests/scenes/depth.py. What
moves during a sequence is told from what stands still, under projectors of any response: a dark strip that shifts half way."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.levels import EvenSums, check_levels
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect
from stage.patterns.phase import phase_patterns as waves
from tests.marks import first_short
from tests.scenes.captures import write_image, write_manifest
from tests.scenes.depth import (
    BLACK_WHITE,
    depth_of,
    depth_under,
    gray_patterns,
    grey_light,
    make_scene,
    manifest,
    phase_patterns,
    sample_of,
    shown,
)

NUMBERED = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8)]
SEVERAL = [*phase_patterns("column", 16.0), *phase_patterns("column", 18.0), *phase_patterns("column", 21.0)]
THREE = [*phase_patterns("column", 16.0, 3), *phase_patterns("column", 18.0, 3), *phase_patterns("column", 21.0, 3)]
NOISE = 0.003


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def mixed(result):
    """Whether frames are said to mix patterns."""
    return any("levels that no pattern has" in sentence for sentence in result.warnings)


def measured(folder, scene, patterns, part, *, gamma=1.0):
    """What relit depth makes of frames of which each holds this part of the next one, recorded by a camera of this exponent."""
    light = grey_light(scene, patterns)
    return depth_under(folder, patterns, ((1 - part) * light + part * np.roll(light, -1, axis=0)) ** gamma)


@pytest.mark.parametrize("patterns", [NUMBERED, SEVERAL], ids=["numbered", "several"])
@first_short("part", [0.2, 0.3])
def test_frames_that_mix_two_patterns_are_named(tmp_path, scene, patterns, part):
    result = measured(tmp_path, scene, patterns, part)
    assert not result.maps.mask.any() and mixed(result)


@first_short(("patterns", "gamma"), [(NUMBERED, 1.0), (SEVERAL, 1.0), (NUMBERED, 1.8)],
             ids=["numbered", "several", "a camera that is not linear"])
def test_whole_frames_raise_no_doubt(tmp_path, scene, patterns, gamma):
    result = measured(tmp_path, scene, patterns, 0.0, gamma=gamma)
    assert not mixed(result)
    assert gamma != 1.0 or result.maps.mask[~scene.shaded].mean() > 0.9


@pytest.mark.parametrize("patterns", [[*NUMBERED, *BLACK_WHITE], SEVERAL, THREE], ids=["numbered", "several", "three steps"])
@pytest.mark.parametrize(("gain", "more"), [(0.8, 0.0), (1.0, 0.1)], ids=["a lamp that fades", "light of the room that grows"])
def test_light_that_changes_between_frames_is_named(tmp_path, scene, patterns, gain, more):
    """It changes evenly over the sequence: of a wave as much as falls to its shifts, which σ holds."""
    order = np.linspace(0, 1, len(patterns))[:, None, None]
    light = grey_light(scene, patterns) * (1 + (gain - 1) * order) + more * scene.albedo[..., 1] * order
    result = depth_under(tmp_path, patterns, light)
    off = np.abs(result.maps.depth - scene.depth)[result.maps.mask] / result.maps.sigma[result.maps.mask]
    assert len(result.warnings) == 1 and "light has changed between the frames" in result.warnings[0]
    assert result.maps.mask[~scene.shaded].mean() > 0.9 and (off > 5).mean() < 0.02


@pytest.mark.parametrize(("gamma", "white", "named"), [(1.0, 1.0, False), (1 / 2.2, 1.0, True), (1.0, 0.7, True)],
                         ids=["linear", "encoded", "automatic exposure"])
def test_bits_that_are_not_half_bright_between_black_and_white_are_named(tmp_path, scene, gamma, white, named):
    """A Gray code without inverses, blurred by a pixel: encoding moves the edges of its stripes, and so does white of another exposure."""
    patterns = [*gray_patterns("column", inverse=False), *BLACK_WHITE]
    light = gaussian_filter1d(grey_light(scene, patterns), 1.0, axis=2)
    light[-1] *= white
    said = depth_under(tmp_path, patterns, light**gamma).warnings
    assert any("in the mean" in sentence and "column gray code" in sentence for sentence in said) == named


def test_three_steps_of_a_declared_response_raise_no_doubt(tmp_path, scene):
    """Three shifts do not even out the third harmonic of a response that is steep in the middle: their sums differ as it says."""
    def steep(level):
        return level**2 * (3 - 2 * level)

    projector = {**manifest([])["projector"], "response": steep(np.linspace(0, 1, 33)).tolist()}
    result = depth_under(tmp_path, THREE, grey_light(scene, THREE, response=steep), changes={"projector": projector})
    assert not mixed(result) and result.maps.mask[~scene.shaded].mean() > 0.9


def test_frames_that_are_clipped_are_not_called_mixed(tmp_path, scene):
    """8-bit files end at 255, whatever the manifest says: a white wall behind a dark sphere reaches it."""
    frames = []
    albedo = np.where(scene.depth < 1.3, 0.06, 0.7)
    for number, pattern in enumerate(THREE):
        light = albedo * (1.3 * (0.1 + 0.9 * shown(pattern, scene.uv)) * ~scene.shaded + 0.3)
        name = f"{number:02d}.png"
        write_image(tmp_path / name, np.repeat(np.rint(np.clip(light, 0, 1) * 255).astype(np.uint8)[..., None], 3, axis=-1))
        frames.append({"image": name, "pattern": pattern})
    write_manifest(tmp_path, manifest(frames, color_space="lin_rec709_scene"))
    assert not mixed(depth_of(tmp_path))


def stripes_said(*, part=0.0, blur_px=0.6, gamma=1.0, dimmed_white=1.0):
    """What is said of a Gray code with white and black, without inverses: a wall with a step and a texture, seen by 24 rows."""
    rng, patterns = np.random.default_rng(5), binary_patterns(320, "column", inverses=False)
    x = np.arange(180) + 0.2 * np.arange(24)[:, None]
    u = 12 + 1.6 * x - 20 * (x > 100)
    albedo = 0.5 + 0.3 * np.sin(0.5 * x) * np.cos(0.9 * np.arange(24)[:, None])
    light = np.stack([pattern.level(u, u, 320) for pattern in patterns]) ** gamma
    light[[pattern.code == "white" for pattern in patterns]] *= dimmed_white
    light = gaussian_filter1d((1 - part) * light + part * np.roll(light, -1, axis=0), blur_px, axis=2)
    frames = albedo * (0.7 * light + 0.04)
    sample = sample_of(frames + rng.normal(0, NOISE, frames.shape))
    return check_levels(sample, collect(patterns), PatternProjector((320, 240)), NoiseModel(NOISE, 0.0))


@pytest.mark.parametrize("part", [0.3, 0.45, 0.5, 0.6])
def test_stripes_of_mixed_frames_are_neither_dark_nor_bright(part):
    assert "levels that no pattern has" in (stripes_said(part=part) or "")


@pytest.mark.parametrize("scene", [{}, {"blur_px": 4.0}, {"gamma": 2.2}, {"gamma": 0.5}, {"dimmed_white": 0.6}],
                         ids=["sharp", "out of focus", "gamma", "inverse gamma", "a display that dims white"])
def test_stripes_of_whole_frames_raise_no_doubt(scene):
    assert stripes_said(**scene) is None


ROWS, COLS, EXTENT = 32, 120, 256
AT = np.arange(COLS) + np.zeros((ROWS, 1))
SHOT = NoiseModel(NOISE, 1e-4)
STRIPES = list(binary_patterns(EXTENT, "column", stripe_px=8))
both = pytest.mark.parametrize("patterns", [[*waves("column", (16.0,), 3), *STRIPES], STRIPES], ids=["waves and stripes", "stripes alone"])


def sums_of(patterns, seen, gamma=1.0, full=np.inf):
    """The even sums, and their sample, of frames of which `seen` gives albedos and columns of the projector; its argument: whether the
    frame is one of the second half."""
    values = []
    for number, pattern in enumerate(patterns):
        albedo, u = seen(number >= len(patterns) // 2)
        values.append(albedo * (0.8 * pattern.level(u, u, EXTENT) ** gamma + 0.05))
    values = np.array(values)
    values = values + np.random.default_rng(3).normal(0, 1, values.shape) * np.sqrt(SHOT.read**2 + SHOT.gain * values)
    sample = sample_of(values, full)
    return EvenSums.of(sample, collect(patterns), SHOT), sample


def moved(by_px, gamma=1.0, full=np.inf, patterns=STRIPES):
    """Where frames, in the second half of which a dark strip stands farther right, show motion; and where it does."""
    def seen(later):
        left = 50 + 3 * np.sin(np.arange(ROWS) / 4)[:, None] + by_px * later
        strip = np.abs(AT - left - 10) < 10
        return np.where(strip, 0.15, 0.6 + 0.2 * np.sin(0.4 * AT)), 20 + 1.6 * AT - 30 * strip

    sums, sample = sums_of(patterns, seen, gamma, full)
    return sums.moved(sample, SHOT), (np.abs(seen(False)[0] - seen(True)[0]) > 0.2).ravel()


@both
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_what_moves_is_found_and_what_stands_still_has_not_moved(gamma, patterns):
    """Six deviations of noise: none of 3840 pixels by chance."""
    found, truth = moved(4, gamma, patterns=patterns)
    assert found[truth].mean() > 0.9 and found[~truth].mean() < 0.01
    assert not moved(0, gamma, patterns=patterns)[0].any()


def test_clipped_highlights_that_stand_still_have_not_moved():
    """The mean of a wave whose crests are clipped falls below half of white at the brighter half of the surface."""
    assert not moved(0, full=0.5, patterns=[*waves("column", (16.0,), 3), *STRIPES])[0].any()


@pytest.mark.parametrize(("by_px", "everywhere"), [(0.0, False), (8.0, True)])
def test_a_whole_scene_that_moves_is_told_from_single_things(by_px, everywhere):
    """Stripes of paint pass by their own width in the middle of the sequence: every pixel changes."""
    sums, _ = sums_of(STRIPES, lambda later: (0.5 + 0.3 * np.sign(np.sin(np.pi * (AT - by_px * later) / 8)), 20 + 1.6 * AT))
    assert sums.everywhere is everywhere
