"""A camera that drifts or shakes during stripes is named, and σ holds what that makes; one that stands still is not."""

import json

import numpy as np
import pytest

from stage.patterns.binary import binary_patterns
from stage.patterns.kary import kary_patterns
from tests.marks import first_short
from tests.scenes.depth import depth_of
from tests.scenes.projected import Ball, Rig, Wall, World, trace, write_capture

RIG = Rig(camera=(200, 150), camera_focal=230.0, projector=(256, 192), projector_focal=300.0)
WORLD = World(shapes=(Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.1, 0.05, -1.2), 0.13, 0.8, texture=0.3),
                      Wall((0.15, 0.1, -1.25), (0.2, -0.3, 1), 0.6, half_m=(0.09, 0.07))), rig=RIG)
PATTERNS = {"Gray with inverses": binary_patterns(256, "column"), "Gray": binary_patterns(256, "column", inverses=False),
            "binary": binary_patterns(256, "column", code="binary"), "3-ary": kary_patterns(256, "column", base=3),
            "Gray rows": binary_patterns(192, "row", inverses=False)}
every_code = first_short("name", ["Gray", "Gray rows", "Gray with inverses", "binary", "3-ary"])


@pytest.fixture(scope="module")
def light():
    return trace(WORLD)


def measured(folder, light, name, move):
    """What relit depth says of shifts, the largest one that it reports, and depths over σ of the solved pixels; `move`: the images' shifts
    right and down, of the numbers of the frames as parts of all."""
    patterns = PATTERNS[name]
    away = np.array([move(number / (len(patterns) - 1)) for number in range(len(patterns))])
    down = name.endswith("rows")
    write_capture(folder, WORLD, patterns, light=light, aside=[(size, 0.0) if down else (0.0, size) for size in away])
    found = depth_of(folder, read_noise=WORLD.read_noise, photon_gain=1 / WORLD.electrons)
    solved = found.maps.mask & light.lit & np.isfinite(light.depth)
    assert solved.sum() > 0.4 * light.lit.sum()
    off = np.abs(found.maps.depth - light.depth)[solved] / found.maps.sigma[solved]
    report = json.loads((folder / "out" / "report.json").read_text())
    return [warning for warning in found.warnings if "aside of each other" in warning], report["found"].get("image_shift_px", 0.0), off


@every_code
def test_a_camera_that_stands_still_is_not_accused(tmp_path, light, name):
    said, size, _ = measured(tmp_path, light, name, lambda part: 0.0)
    assert said == [] and size == 0


def test_stairs_before_a_camera_that_stands_still_are_not_accused(tmp_path):
    """The few edges of wide stripes lie beside steps, on every line alike; 1.3 px were said of these."""
    steps = [Wall((0.07 * number, 0, -1.25 - 0.05 * ((number + 2) % 3)), (0, 0, 1), 0.7, half_m=(0.035, 1)) for number in range(-8, 9)]
    stairs = World(shapes=(Wall((0, 0, -1.4), (0, 0, 1), 0.7), *steps), rig=RIG, samples=2)
    write_capture(tmp_path, stairs, PATTERNS["Gray"])
    assert not depth_of(tmp_path, read_noise=stairs.read_noise, photon_gain=1 / stairs.electrons).warnings


@every_code
def test_a_camera_that_drifts_is_named_and_sigma_holds_it(tmp_path, light, name):
    """Frames with wide stripes, half of the sequence or more, show at least a third of the drift and at most all of it."""
    said, size, off = measured(tmp_path, light, name, lambda part: 1.5 * part)
    assert len(said) == 1 and 0.3 * 1.5 < size < 1.5
    # at most .06 %, and 13 to 57 % without what the shifts make (rows .3 %: the rig has no baseline along them)
    assert (off > 5).mean() < 0.005


@pytest.mark.long
@pytest.mark.parametrize("name", ["Gray with inverses", "Gray"])
def test_a_camera_that_shakes_is_named_and_sigma_holds_it(tmp_path, light, name):
    rng = np.random.default_rng(2)
    said, size, off = measured(tmp_path, light, name, lambda part: rng.normal(0, 0.5))
    assert len(said) == 1 and size > 0.3
    assert (off > 5).mean() < 0.005  # .04 and .07 %, without it .2 and 2 %


@first_short("part", [0.8, 0.7])
def test_a_jump_before_the_finest_bits_is_named_and_sigma_holds_it(tmp_path, light, part):
    """Their stripes are too fine to show edges; what they and their inverses show together is the same scene, aside."""
    said, size, off = measured(tmp_path, light, "Gray with inverses", lambda now: float(now > part))
    assert len(said) == 1 and size == pytest.approx(1.0, abs=0.15)
    assert (off > 5).mean() < 0.005
