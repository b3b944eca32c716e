"""Digits whose stripes a camera does not resolve, where the projector is out of focus: left out, said, and the rest is decoded."""

import numpy as np
import pytest

from benchmarks.projected_scenes import Ball, Wall, World, trace, write_capture
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.patterns.kary import kary_patterns
from tests.marks import first_short

SHAPES = (Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.15, 0.05, -1.15), 0.12, 0.8))


@pytest.fixture(scope="module")
def light():
    return trace(World(shapes=SHAPES))


@first_short(("base", "reflected", "blur_px", "digits"), [
    (3, False, 1.5, 2), (3, True, 3.0, 2), (4, True, 6.0, 2), (5, False, 0.4, 1), (3, True, 0.4, 0), (4, True, 0.4, 0)])
def test_digits_that_are_not_resolved_are_left_out(tmp_path, light, base, reflected, blur_px, digits):
    """Stripes of 1 px, of which a camera pixel sees 1.6. A blurred digit was read as the middle one: of the reflected code under a blur of
    3 px 27 % of the pixels were solved, and a quarter of these off by more than five σ. Both the share solved and that beyond five σ are
    those of stripes that are resolved, with room for the rim of the ball."""
    world = World(shapes=SHAPES, blur_px=blur_px)
    truth = write_capture(tmp_path / "capture", world, kary_patterns(320, "column", base=base, reflected=reflected), light=light).depth
    found = depth(DepthRequest(capture=tmp_path / "capture", out=tmp_path / "out", device="cpu", photon_gain=1 / world.electrons))
    maps = found.maps
    known = light.lit & np.isfinite(truth)
    off = (np.abs(maps.depth - truth) / np.maximum(maps.sigma, 1e-9))[maps.mask & known]
    assert (off > 5).mean() < 0.01 and maps.mask[known].mean() > 0.9
    said = [warning for warning in found.warnings if "does not resolve" in warning]
    assert len(said) == (digits > 0)
    assert all((f"finest {digits} digits" if digits > 1 else "finest digit of") in warning for warning in said)
    assert all(f"stripes are {base**digits} px wide" in warning for warning in said)
