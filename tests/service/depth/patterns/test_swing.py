"""Three phase frames alone under a projector that bends waves: σ holds the error, and a sentence says so. The scene and its images are
those of tests/scenes/depth.py."""

import numpy as np
import pytest

from service.depth.depth import depth
from service.requests.depth import DepthRequest
from tests.scenes.captures import write_images, write_manifest
from tests.scenes.depth import AMBIENT, PROJECTOR, entries_of, make_scene, manifest, phase_patterns, shown

NOISE = 0.003


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def measured(folder, scene, gamma, ambient):
    """What relit depth makes of one wave over the whole projector, its three steps alone."""
    rng, patterns = np.random.default_rng(6), phase_patterns("column", float(PROJECTOR.width), 3)
    level = np.array([shown(pattern, scene.uv) for pattern in patterns])
    light = scene.albedo[..., 1] * (0.8 * level**gamma * ~scene.shaded + ambient) + rng.normal(0, NOISE, level.shape)
    write_manifest(folder, manifest(write_images(folder, light, entries_of(patterns))))
    return depth(DepthRequest(capture=folder, out=folder / "out", device="cpu", least_confidence=0))


@pytest.mark.parametrize("gamma", [1.6, 2.2])
@pytest.mark.parametrize("ambient", [0.04, 0.2])
def test_a_bent_wave_is_in_sigma(tmp_path, scene, gamma, ambient):
    result = measured(tmp_path, scene, gamma, ambient)
    kept = result.maps.mask & ~scene.shaded
    ratio = np.abs(result.maps.depth - scene.depth)[kept] / result.maps.sigma[kept]
    assert "relit calibrate response" in result.warnings[0]
    assert np.median(ratio) < 1.4 and (ratio > 5).mean() < 0.01


@pytest.mark.parametrize("ambient", [AMBIENT, 0.3])
def test_an_even_wave_raises_no_doubt(tmp_path, scene, ambient):
    result = measured(tmp_path, scene, 1.0, ambient)
    assert not any("level^" in sentence for sentence in result.warnings)
