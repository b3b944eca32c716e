"""Projectors and cameras that are not linear: three phase frames alone of bent waves, whose σ holds the error, and two ramps that are not
white and black together, of whose depths none is believed. A sentence says so, and what is linear and steady is not accused."""

import numpy as np
import pytest

from stage.patterns.ramp import ramp_patterns
from tests.marks import first_short
from tests.scenes import projected
from tests.scenes.depth import AMBIENT, PROJECTOR, depth_of, depth_under, grey_light, make_scene, phase_patterns
from tests.scenes.projected import Ball, Wall, World


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def under_waves(folder, scene, gamma, ambient):
    """What relit depth makes of one wave over the whole projector, its three steps alone."""
    patterns = phase_patterns("column", float(PROJECTOR.width), 3)
    light = grey_light(scene, patterns, ambient=ambient, response=lambda level: level**gamma)
    return depth_under(folder, patterns, light, seed=6, least_confidence=0)


@first_short("gamma", [1.6, 2.2])
@first_short("ambient", [0.04, 0.2])
def test_a_bent_wave_is_in_sigma(tmp_path, scene, gamma, ambient):
    result = under_waves(tmp_path, scene, gamma, ambient)
    kept = result.maps.mask & ~scene.shaded
    ratio = np.abs(result.maps.depth - scene.depth)[kept] / result.maps.sigma[kept]
    assert "relit calibrate response" in result.warnings[0]
    assert np.median(ratio) < 1.4 and (ratio > 5).mean() < 0.01


@pytest.mark.parametrize("ambient", [AMBIENT, 0.3])
def test_an_even_wave_raises_no_doubt(tmp_path, scene, ambient):
    result = under_waves(tmp_path, scene, 1.0, ambient)
    assert not any("level^" in sentence for sentence in result.warnings)


SHAPES = (Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.15, 0.05, -1.15), 0.12, 0.8))
FAULTS = {
    "images that are not linear": (lambda frames: frames ** (1 / 2.2), "as where light = level^0.6"),
    "a lamp that goes on before white": (lambda frames: np.minimum(frames + np.array([0, 0, 0.08, 0.08])[:, None, None], 1),
                                         "the light has changed between the frames"),
    "a lamp that fades": (lambda frames: frames * np.linspace(1, 0.7, 4)[:, None, None], "the light has changed between the frames"),
}


def under_ramps(folder, monkeypatch, change=lambda frames: frames, *, gamma=1.0, **projector):
    """|error| / σ of the solved depths and what is said, of a wall and a ball under two ramps, white and black."""
    world, plain = World(shapes=SHAPES, gamma=gamma, samples=2), projected.images
    monkeypatch.setattr(projected, "images", lambda *args: change(plain(*args)))
    truth = projected.write_capture(folder / "capture", world, ramp_patterns("column"), **projector).depth
    found = depth_of(folder / "capture", photon_gain=1 / world.electrons)
    maps = found.maps
    return (np.abs(maps.depth - truth) / np.maximum(maps.sigma, 1e-9))[maps.mask], "; ".join(found.warnings)


@first_short("fault", FAULTS)
def test_ramps_that_are_not_white_and_black_together_are_named(tmp_path, monkeypatch, fault):
    change, words = FAULTS[fault]
    off, said = under_ramps(tmp_path, monkeypatch, change)
    assert words in said and off.size == 0


def test_an_undeclared_response_is_named_and_a_declared_one_is_not(tmp_path, monkeypatch):
    off, said = under_ramps(tmp_path / "not", monkeypatch, gamma=2.2)
    assert "measure projector.response" in said and off.size == 0
    off, said = under_ramps(tmp_path / "declared", monkeypatch, gamma=2.2, response=(np.linspace(0, 1, 256)**2.2).tolist())
    assert "ramps" not in said and (off > 5).mean() < 0.02 and off.size > 10000


@pytest.mark.long
@pytest.mark.parametrize("gains", [(1, 1, 1, 1), (1.03, 0.97, 1.02, 1)], ids=["steady", "flicker of 3 %"])
def test_right_ramps_are_not_accused(tmp_path, monkeypatch, gains):
    off, said = under_ramps(tmp_path, monkeypatch, lambda frames: np.minimum(frames * np.array(gains)[:, None, None], 1))
    assert "ramps" not in said and (off > 5).mean() < 0.01 and off.size > 10000
