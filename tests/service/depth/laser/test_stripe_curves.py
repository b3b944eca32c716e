"""Several stripes in one frame: which is the laser's, and where nothing tells."""

import numpy as np
import pytest

from kernels.status import Status
from service.depth.laser.stripe_curves import choose_curves, link

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
