"""Digits whose stripes a camera does not resolve, where the projector is out of focus: left out, said, and the rest is decoded."""

import numpy as np
import pytest

from stage.patterns.binary import binary_patterns
from stage.patterns.kary import kary_patterns, palette
from tests.marks import first_short
from tests.scenes.depth import depth_of
from tests.scenes.projected import Ball, Wall, World, trace, write_capture

SHAPES = (Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.15, 0.05, -1.15), 0.12, 0.8))


@pytest.fixture(scope="module")
def light():
    return trace(World(shapes=SHAPES))


def solved(folder, world, light, patterns, declared=None):
    """What was found, and the error over σ of each solved pixel whose depth is known."""
    write_capture(folder / "capture", world, patterns, light=light, declared=declared)
    found = depth_of(folder / "capture", photon_gain=1 / world.electrons)
    known = found.maps.mask & light.lit & np.isfinite(light.depth)
    return found, (np.abs(found.maps.depth - light.depth) / np.maximum(found.maps.sigma, 1e-9))[known]


@pytest.mark.long
def test_colours_between_dark_and_bright_tell_nothing(tmp_path, light):
    """A palette without a colour whose channels are all dark or bright: no digit is left out."""
    colors = [(1.0, 0.5, 0.0), (0.0, 1.0, 0.5), (0.5, 0.0, 1.0)]
    found, off = solved(tmp_path, World(shapes=SHAPES), light, kary_patterns(320, "column", base=3, stripe_px=3, colors=colors))
    assert not [warning for warning in found.warnings if "does not resolve" in warning]
    assert (off > 5).mean() < 0.01 and len(off) > 0.9 * (light.lit & np.isfinite(light.depth)).sum()


@pytest.mark.long
@pytest.mark.parametrize("base", [4, 8])
@pytest.mark.parametrize("stripe_px", [1, 3])
def test_exchanged_red_and_blue_are_named(tmp_path, light, base, stripe_px):
    """Images in the order blue, green, red: a third to a half was solved, and two thirds of it beyond five σ."""
    right = kary_patterns(320, "column", base=base, stripe_px=stripe_px, colors=palette(base))
    turned = kary_patterns(320, "column", base=base, stripe_px=stripe_px, colors=[color[::-1] for color in palette(base)])
    found, off = solved(tmp_path, World(shapes=SHAPES), light, turned, declared=right)
    assert not len(off) and any("red and blue are exchanged" in warning for warning in found.warnings)


@first_short(("base", "reflected", "blur_px", "digits", "coloured"), [
    (3, False, 1.5, 2, False), (3, True, 3.0, 2, False), (4, True, 6.0, 2, False), (5, False, 0.4, 1, False), (3, True, 0.4, 0, False),
    (4, True, 0.4, 0, False), (8, False, 3.0, 1, True), (4, True, 3.0, 1, True), (3, False, 3.0, 2, True), (3, True, 0.4, 0, True),
    (4, False, 0.4, 0, True), (8, True, 0.4, 0, True)])
def test_digits_that_are_not_resolved_are_left_out(tmp_path, light, base, reflected, blur_px, digits, coloured):
    """Stripes of 1 px, of which a camera pixel sees 1.6. Both the share solved and that beyond five σ are those of stripes that are
    resolved, with room for the rim of the ball."""
    patterns = kary_patterns(320, "column", base=base, reflected=reflected, colors=palette(base) if coloured else None)
    found, off = solved(tmp_path, World(shapes=SHAPES, blur_px=blur_px), light, patterns)
    assert (off > 5).mean() < 0.01 and len(off) > 0.9 * (light.lit & np.isfinite(light.depth)).sum()
    said = [warning for warning in found.warnings if "does not resolve" in warning]
    assert len(said) == (digits > 0)
    assert all((f"finest {digits} digits" if digits > 1 else "finest digit of") in warning for warning in said)
    assert all(f"stripes are {base**digits} px wide" in warning for warning in said)


@pytest.mark.long
@pytest.mark.parametrize("inverses", [False, True])
@pytest.mark.parametrize(("blur_px", "stripe_px"), [(4.0, 8), (0.4, 1)])
def test_plain_bits_that_are_not_resolved_are_left_out(tmp_path, light, inverses, blur_px, stripe_px):
    """The coarsest of the bits that hardly a pixel reads stays: it is wrong by a stripe at most, and σ is that of an edge then."""
    found, off = solved(tmp_path, World(shapes=SHAPES, blur_px=blur_px), light,
                        binary_patterns(320, "column", code="binary", inverses=inverses))
    assert (off > 5).mean() < 0.01 and len(off) > 0.95 * (light.lit & np.isfinite(light.depth)).sum()
    said = [warning for warning in found.warnings if "does not resolve" in warning]
    assert [f"stripes are {stripe_px} px wide" in warning for warning in said] == [True] * (stripe_px > 1)
