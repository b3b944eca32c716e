"""A sweep whose images are out of step with its planes is told by the steps of its stripes."""

import numpy as np
import pytest

from benchmarks.trials.laser import Case, cloth, grain, swept
from kernels.status import Status
from service.depth.laser.missed_planes import Misstep, missteps
from service.depth.laser.stripe_map import StripeSamples
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane

WORDS = "frames are missing, doubled or in another order"


@pytest.mark.long
@pytest.mark.parametrize(("slipped", "texture", "words"), [
    ((25, 60), cloth, "from 024.exr to 025.exr the stripe does not move"), ((25, 26), grain, "and 1 more such steps"),
    ((40, 60), grain, "from 039.exr to 040.exr the stripe does not move")])
def test_frames_that_are_out_of_step_are_as_unsure_as_they_are_wrong(slipped, texture, words):
    """Where one frame is taken twice and all later ones are late, 55 and 29 % of the depths are off by more than five σ otherwise."""
    found = swept(Case("slipped", texture, planes=60, slipped=slipped))
    assert WORDS in found.note and words in found.note
    ratio = (found.error / np.maximum(found.sigma, 1e-9))[found.solved]
    assert found.solved.mean() > 0.2 and (ratio > 5).mean() < 0.02


@pytest.mark.long
@pytest.mark.parametrize("case", [Case("right", grain, planes=40), Case("a second plane", grain, planes=60, second=0.2, second_every=5),
                                  Case("the camera drifts", cloth, planes=60, drift_px=2.0)], ids=lambda case: case.name)
def test_sweeps_in_step_are_not_accused(case):
    assert WORDS not in swept(case).note


def plate_sweep(jump):
    """Stripes on a wall 1 m away whose right half is a plate so far before it that they jump by this many planes at its slanting edge."""
    camera = Camera.model_validate({"projection": "perspective", "resolution": [320, 100], "focal_px": [400.0, 400.0]})
    laser, step_m, line = 0.3, 0.02, np.arange(100)
    at = np.arange(-9, 9) * step_m + 0.003
    planes = [LaserPlane(type="plane", point_m=(laser, 0, 0), normal=(1, 0, x - laser)) for x in at]
    shift = (jump - 1) * step_m * 400
    samples = []
    for x in at:
        on_plate = 400 * x + 0.02 * (line - 50) > 0
        places = 160 + 400 * x + np.where(on_plate, shift, 0)
        depth = np.where(on_plate, 1 / (1 + shift / (400 * laser)), 1.0)
        samples.append(StripeSamples(line, places, depth, np.full(100, 1e-4), np.ones(100, np.float32), np.full(100, Status.OK, np.uint8)))
    return samples, planes, camera


def test_an_edge_of_depth_that_the_stripe_jumps_over_is_no_missing_frame():
    assert missteps(*plate_sweep(3.4), along="row") == []
    samples, planes, camera = plate_sweep(1)
    assert missteps(samples, planes, camera, along="row") == []
    assert missteps(samples[:8] + samples[10:], planes[:-2], camera, along="row") == [Misstep(8, 3)]
