"""Several stripes in one frame, which is the laser's and where nothing tells; curves of different frames that contradict each other."""

import numpy as np
import pytest

from kernels.status import Status
from service.depth.laser.stripe_curves import choose_curves, link
from service.depth.laser.stripe_map import StripeSamples, contradicted
from service.depth.laser.stripes import Signal, Sweep
from stage.capture.camera import Camera

LINES = 60
OK, NONE = int(Status.OK), int(Status.LOW_MODULATION)


def frame(*curves):
    """Places, brightness and status of curves (place, brightness, first and last line), the brightest of each line first."""
    place, bright = np.zeros((3, LINES)), np.zeros((3, LINES))
    for row, (at, strength, first, last) in enumerate(curves):
        lines = slice(first, last)
        place[row, lines] = (at + 0.5 * np.arange(LINES))[lines]
        bright[row, lines] = strength
    order = np.argsort(-bright, axis=0, kind="stable")
    place, bright = np.take_along_axis(place, order, axis=0), np.take_along_axis(bright, order, axis=0)
    return place, bright, np.where(bright > 0, OK, NONE).astype(np.uint8)


def test_curves_are_followed_over_lines_where_their_order_changes():
    place, bright, status = frame((20.0, 1.0, 0, LINES), (90.0, 0.6, 0, LINES))
    bright[:, 30:] = bright[::-1][[1, 2, 0]][:, 30:]
    place[[0, 1], 30:] = place[[1, 0], 30:]  # texture: the fainter one is brighter here
    curve = link(place, status == OK)
    assert curve.max() == 1
    for number in (0, 1):
        assert np.diff(place.T[number == curve.T]).max() == pytest.approx(0.5)


def test_a_gap_of_dark_lines_does_not_end_a_curve():
    place, _, status = frame((20.0, 1.0, 0, LINES))
    status[0, 20:22] = NONE
    assert link(place, status == OK).max() == 0


@pytest.mark.parametrize("curves", [
    [(20.0, 1.0, 0, LINES)],
    [(20.0, 1.0, 0, 30), (60.0, 0.9, 30, LINES)],
    [(20.0, 1.0, 0, LINES), (90.0, 0.1, 0, LINES), (150.0, 0.09, 0, LINES)],
    [(20.0, 1.0, 0, LINES), (90.0, 0.9, 30, 31)],
], ids=["one", "a step of the surface", "two reflections, which say nothing of each other", "a hot pixel, which is no stripe"])
def test_one_laser_is_not_in_doubt(curves):
    found = choose_curves(*frame(*curves))
    assert (found.peak == 0).all() and (found.status == OK).all() and not found.doubled.any()


def test_a_reflection_is_left_out_where_it_is_seen_alone_too():
    found = choose_curves(*frame((20.0, 1.0, 0, 45), (90.0, 0.15, 10, LINES)))
    assert (found.status[:45] == OK).all() and (found.peak == 0).all()
    assert (found.status[45:] == Status.MULTIPATH).all() and not found.doubled.any()


def test_two_stripes_of_comparable_brightness_are_both_in_doubt():
    found = choose_curves(*frame((20.0, 1.0, 0, 40), (90.0, 0.6, 10, LINES)))
    assert (found.status == Status.MULTIPATH).all() and found.doubled[10:40].all() and found.doubled.sum() == 30


def test_a_short_rival_casts_doubt_on_its_lines_alone():
    found = choose_curves(*frame((20.0, 1.0, 0, LINES), (90.0, 0.6, 10, 18)))
    assert (found.status[10:18] == Status.MULTIPATH).all()
    assert (np.delete(found.status, range(10, 18)) == OK).all()


RNG = np.random.default_rng(0)
ALBEDO = np.exp(RNG.normal(0, 0.4, (40, 120)))


def swept(step, *, width=1.6, noise=0.0, albedo=ALBEDO, first=10.0, last=110.0):
    sweep, cols = Sweep(), np.arange(albedo.shape[1]) + 0.5
    for place in np.arange(first, last, step):
        frame = albedo * np.exp(-((cols - place) ** 2) / (2 * width**2)) + RNG.normal(0, noise, albedo.shape)
        last_frame = Signal(frame.astype(np.float32), 0, max(noise, 1e-5))
        sweep.add(last_frame)
    sweep.close()
    return sweep.albedo_for(last_frame)


@pytest.mark.parametrize("step", [0.7, 1.5])
def test_texture_is_found_again(step):
    found = swept(step)
    inner = slice(18, 102)
    assert (found[:, inner] > 0).all()
    ratio = (found / ALBEDO)[:, inner]
    assert np.std(ratio) / np.mean(ratio) < 0.01  # the ripple of the sum
    assert (found[:, :8] == 0).all() and (found[:, 112:] == 0).all()  # beyond the sweep, and where its end takes half of the light


def test_stripes_that_lie_apart_tell_nothing():
    found = swept(8.0)
    assert found is None or np.mean(found > 0) < 0.01


def test_noise_is_not_taken_for_texture():
    found = swept(1.0, noise=0.01, albedo=np.ones((40, 120)))
    inner = found[:, 18:102]
    assert np.std(inner) / np.mean(inner) < 0.0045  # a reading's noise is 0.01 over a root energy of 1.7: a half is smoothed away


def test_one_frame_tells_nothing():
    sweep, frame = Sweep(), Signal(np.ones((4, 4), np.float32), 0, 0.01)
    sweep.add(frame)
    sweep.close()
    assert sweep.albedo_for(frame) is None


CAMERA = Camera(projection="perspective", resolution=(200, 40), focal_px=(300.0, 300.0))
ROWS = np.arange(40)


def samples(*given):
    """Samples of curves (place, depth, brightness), each on all lines, and their numbers."""
    parts = [StripeSamples(ROWS, np.full(40, place), np.full(40, depth), np.full(40, 1e-3), np.full(40, bright), np.full(40, Status.OK))
             for place, depth, bright in given]
    return StripeSamples.joined(parts), np.repeat(np.arange(len(given)), 40)


WALL = [(20.0 + 3 * k, 1.0, 1.0) for k in range(12)]


def test_a_wall_contradicts_nothing():
    assert not contradicted(*samples(*WALL), CAMERA, doubled=True).any()


def test_a_faint_stripe_behind_the_wall_is_contradicted():
    found = contradicted(*samples(*WALL, (33.5, 1.6, 0.2)), CAMERA, doubled=False)
    assert found[-40:].all() and not found[:-40].any()


def test_the_edge_of_a_surface_is_no_contradiction():
    assert not contradicted(*samples(*WALL, *((56.0 + 3 * k, 2.0, 0.2) for k in range(4))), CAMERA, doubled=True).any()


def test_a_narrow_post_stays_unless_frames_show_two_stripes():
    wall = [curve for curve in WALL if curve[0] != 35.0]
    given = samples(*wall, (35.0, 0.6, 1.0))
    assert not contradicted(*given, CAMERA, doubled=False).any()
    assert contradicted(*given, CAMERA, doubled=True)[-40:].all()
