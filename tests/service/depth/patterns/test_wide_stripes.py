"""A Gray code whose stripes are as wide as the period of the phase: what most scanners project."""

import numpy as np
import pytest

from kernels.status import Status
from stage.patterns.binary import binary_patterns
from stage.patterns.phase import phase_patterns
from tests.scenes.depth import depth_of
from tests.scenes.projected import Ball, Rig, Wall, World, trace, write_capture

pytestmark = pytest.mark.long

SHAPES = (Wall((0, 0, -1.6), (0.2, 0.1, 1), texture=0.4), Ball((0.12, -0.05, -1.2), 0.16, 0.8))
RIGS = {axis: Rig(camera=(120, 90), camera_focal=156.0, projector=(192, 144), projector_focal=252.0, position_m=position)
        for axis, position in (("column", (-0.22, 0.03, 0.0)), ("row", (0.03, -0.22, 0.0)))}
PERIOD = 16
WRONG_M = 0.05
"""A period is 8 to 15 cm of depth here, and a mixed pixel at the ball's outline 40 cm."""


def solve(folder, world, light, axis, stripe, *, inverses=True):
    patterns = (*phase_patterns(axis, (PERIOD,), 4),
                *binary_patterns(world.rig.projector[axis == "row"], axis, stripe_px=stripe, inverses=inverses))
    write_capture(folder, world, patterns, light=light)
    return depth_of(folder)


@pytest.mark.parametrize(("axis", "blur"), [("column", 2.0), ("row", 0.4)])
def test_edges_number_the_periods(tmp_path, axis, blur):
    world = World(shapes=SHAPES, rig=RIGS[axis], blur_px=blur)
    light = trace(world)
    fine = solve(tmp_path / "fine", world, light, axis, PERIOD // 2).maps
    found = solve(tmp_path / "wide", world, light, axis, PERIOD)
    assert "phase numbered by gray, edges refined" in found.method
    wide = found.maps
    assert wide.mask[light.lit].mean() > 0.9
    both = wide.mask & fine.mask
    other = both & (np.abs(wide.depth - fine.depth) > 1e-6)  # the same phase in another period
    assert other.mean() < 0.004  # at the outline of the ball, where pixels mix two surfaces: ten of them, and a rounding makes it eleven
    for maps in (fine, wide):  # pixels at the outline of the ball, which mix two surfaces: up to .34 % with fine stripes
        assert (np.abs(maps.depth - light.depth) > WRONG_M)[maps.mask].mean() < 0.005


def test_without_inverses_places_near_an_edge_stay_undecided(tmp_path):
    world = World(shapes=SHAPES, rig=RIGS["column"])
    light = trace(world)
    fine = solve(tmp_path / "fine", world, light, "column", PERIOD // 2).maps
    wide = solve(tmp_path / "wide", world, light, "column", PERIOD, inverses=False).maps
    assert 0.7 < wide.mask[light.lit].mean() < 0.85  # three quarters of each period
    both = wide.mask & fine.mask
    assert np.allclose(wide.depth[both], fine.depth[both], atol=1e-6)
    assert (wide.status[light.lit & ~wide.mask] == Status.UNDECIDED).mean() > 0.8
