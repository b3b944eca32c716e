"""Frames that hold part of the next pattern are named, and no depth is believed: the scene and the images of tests/scenes/depth.py."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from kernels.structured.pattern_frames import NoiseModel
from service.depth.depth import depth
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.levels import check_levels
from service.depth.patterns.pattern_checks import Sample
from service.requests.depth import DepthRequest
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect
from tests.scenes.captures import write_image, write_images, write_manifest
from tests.scenes.depth import AMBIENT, entries_of, gray_patterns, make_scene, manifest, phase_patterns, shown

NUMBERED = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8)]
SEVERAL = [*phase_patterns("column", 16.0), *phase_patterns("column", 18.0), *phase_patterns("column", 21.0)]
THREE = [*phase_patterns("column", 16.0, 3), *phase_patterns("column", 18.0, 3), *phase_patterns("column", 21.0, 3)]
NOISE = 0.003


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def measured(folder, scene, patterns, part, *, gamma=1.0):
    """What relit depth makes of frames of which each holds this part of the next one, recorded by a camera of this exponent."""
    rng = np.random.default_rng(4)
    light = np.array([scene.albedo[..., 1] * (0.8 * shown(pattern, scene.uv) * ~scene.shaded + AMBIENT) for pattern in patterns])
    light = ((1 - part) * light + part * np.roll(light, -1, axis=0)) ** gamma
    write_manifest(folder, manifest(write_images(folder, light + rng.normal(0, NOISE, light.shape), entries_of(patterns))))
    return depth(DepthRequest(capture=folder, out=folder / "out", device="cpu"))


@pytest.mark.parametrize("patterns", [NUMBERED, SEVERAL], ids=["numbered", "several"])
@pytest.mark.parametrize("part", [0.2, 0.3])
def test_frames_that_mix_two_patterns_are_named(tmp_path, scene, patterns, part):
    result = measured(tmp_path, scene, patterns, part)
    assert not result.maps.mask.any()
    assert any("levels that no pattern has" in sentence for sentence in result.warnings)


@pytest.mark.parametrize(("patterns", "gamma"), [(NUMBERED, 1.0), (SEVERAL, 1.0), (NUMBERED, 1.8)],
                         ids=["numbered", "several", "a camera that is not linear"])
def test_whole_frames_raise_no_doubt(tmp_path, scene, patterns, gamma):
    result = measured(tmp_path, scene, patterns, 0.0, gamma=gamma)
    assert not any("levels that no pattern has" in sentence for sentence in result.warnings)
    assert gamma != 1.0 or result.maps.mask[~scene.shaded].mean() > 0.9


def test_three_steps_of_a_declared_response_raise_no_doubt(tmp_path, scene):
    """Three shifts do not even out the third harmonic of a response that is steep in the middle: their sums differ as it says."""
    level = np.array([shown(pattern, scene.uv) for pattern in THREE])
    light = scene.albedo[..., 1] * (0.8 * level**2 * (3 - 2 * level) * ~scene.shaded + AMBIENT)
    light = light + np.random.default_rng(4).normal(0, NOISE, level.shape)
    data, levels = manifest(write_images(tmp_path, light, entries_of(THREE))), np.linspace(0, 1, 33)
    data["projector"]["response"] = (levels**2 * (3 - 2 * levels)).tolist()
    write_manifest(tmp_path, data)
    result = depth(DepthRequest(capture=tmp_path, out=tmp_path / "out", device="cpu"))
    assert not any("levels that no pattern has" in sentence for sentence in result.warnings)
    assert result.maps.mask[~scene.shaded].mean() > 0.9


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
    result = depth(DepthRequest(capture=tmp_path, out=tmp_path / "out", device="cpu"))
    assert not any("levels that no pattern has" in sentence for sentence in result.warnings)


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
    frames = (frames + rng.normal(0, NOISE, frames.shape)).astype(np.float32)
    empty = np.zeros(x.shape, np.float32)
    sample = Sample(frames.reshape(len(frames), 1, -1), None, empty, empty, np.ones(x.shape, bool))
    return check_levels(sample, collect(patterns), PatternProjector((320, 240)), NoiseModel(NOISE, 0.0))


@pytest.mark.parametrize("part", [0.3, 0.45, 0.5, 0.6])
def test_stripes_of_mixed_frames_are_neither_dark_nor_bright(part):
    assert "levels that no pattern has" in (stripes_said(part=part) or "")


@pytest.mark.parametrize("scene", [{}, {"blur_px": 4.0}, {"gamma": 2.2}, {"gamma": 0.5}, {"dimmed_white": 0.6}],
                         ids=["sharp", "out of focus", "gamma", "inverse gamma", "a display that dims white"])
def test_stripes_of_whole_frames_raise_no_doubt(scene):
    assert stripes_said(**scene) is None
