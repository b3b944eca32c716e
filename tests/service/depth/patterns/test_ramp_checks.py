"""Two ramps that are not white and black together: named, and none of their depths is believed; what is linear and steady is not."""

import numpy as np
import pytest

from benchmarks import projected_scenes
from benchmarks.projected_scenes import Ball, Wall, World
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.patterns.ramp import ramp_patterns

SHAPES = (Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.15, 0.05, -1.15), 0.12, 0.8))
FAULTS = {
    "images that are not linear": (lambda frames: frames ** (1 / 2.2), "as where light = level^0.6"),
    "a lamp that goes on before white": (lambda frames: np.minimum(frames + np.array([0, 0, 0.08, 0.08])[:, None, None], 1),
                                         "the light has changed between the frames"),
    "a lamp that fades": (lambda frames: frames * np.linspace(1, 0.7, 4)[:, None, None], "the light has changed between the frames"),
}


def measured(folder, monkeypatch, change=lambda frames: frames, *, gamma=1.0, **projector):
    """|error| / σ of the solved depths and what is said, of a wall and a ball under two ramps, white and black."""
    world, plain = World(shapes=SHAPES, gamma=gamma, samples=2), projected_scenes.images
    monkeypatch.setattr(projected_scenes, "images", lambda *args: change(plain(*args)))
    truth = projected_scenes.write_capture(folder / "capture", world, ramp_patterns("column"), **projector).depth
    found = depth(DepthRequest(capture=folder / "capture", out=folder / "out", device="cpu", photon_gain=1 / world.electrons))
    maps = found.maps
    return (np.abs(maps.depth - truth) / np.maximum(maps.sigma, 1e-9))[maps.mask], "; ".join(found.warnings)


@pytest.mark.parametrize("fault", FAULTS)
def test_ramps_that_are_not_white_and_black_together_are_named(tmp_path, monkeypatch, fault):
    """12 to 30 % of the depths were off by more than five σ, without a word of it."""
    change, words = FAULTS[fault]
    off, said = measured(tmp_path, monkeypatch, change)
    assert words in said and off.size == 0


def test_an_undeclared_response_is_named_and_a_declared_one_is_not(tmp_path, monkeypatch):
    off, said = measured(tmp_path / "not", monkeypatch, gamma=2.2)
    assert "measure projector.response" in said and off.size == 0
    off, said = measured(tmp_path / "declared", monkeypatch, gamma=2.2, response=(np.linspace(0, 1, 256)**2.2).tolist())
    assert "ramps" not in said and (off > 5).mean() < 0.02 and off.size > 10000


@pytest.mark.parametrize("gains", [(1, 1, 1, 1), (1.03, 0.97, 1.02, 1)], ids=["steady", "flicker of 3 %"])
def test_right_ramps_are_not_accused(tmp_path, monkeypatch, gains):
    off, said = measured(tmp_path, monkeypatch, lambda frames: np.minimum(frames * np.array(gains)[:, None, None], 1))
    assert "ramps" not in said and (off > 5).mean() < 0.01 and off.size > 10000
