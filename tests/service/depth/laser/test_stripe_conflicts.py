"""Curves of different frames that contradict each other: a made-up wall under stripes three pixels apart."""

import numpy as np

from kernels.status import Status
from service.depth.laser.stripe_map import StripeSamples, contradicted
from stage.capture.camera import Camera

CAMERA = Camera(projection="perspective", resolution=(200, 40), focal_px=(300.0, 300.0))
LINES = np.arange(40)


def curves(*given):
    """Samples of curves (place, depth, brightness), each on all lines, and their numbers."""
    parts = [StripeSamples(LINES, np.full(40, place), np.full(40, depth), np.full(40, 1e-3), np.full(40, bright), np.full(40, Status.OK))
             for place, depth, bright in given]
    return StripeSamples.joined(parts), np.repeat(np.arange(len(given)), 40)


WALL = [(20.0 + 3 * k, 1.0, 1.0) for k in range(12)]


def test_a_wall_contradicts_nothing():
    assert not contradicted(*curves(*WALL), CAMERA, doubled=True).any()


def test_a_faint_stripe_behind_the_wall_is_contradicted():
    found = contradicted(*curves(*WALL, (33.5, 1.6, 0.2)), CAMERA, doubled=False)
    assert found[-40:].all() and not found[:-40].any()


def test_the_edge_of_a_surface_is_no_contradiction():
    assert not contradicted(*curves(*WALL, *((56.0 + 3 * k, 2.0, 0.2) for k in range(4))), CAMERA, doubled=True).any()


def test_a_narrow_post_stays_unless_frames_show_two_stripes():
    wall = [curve for curve in WALL if curve[0] != 35.0]
    given = curves(*wall, (35.0, 0.6, 1.0))
    assert not contradicted(*given, CAMERA, doubled=False).any()
    assert contradicted(*given, CAMERA, doubled=True)[-40:].all()
