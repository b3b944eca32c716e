"""Which tracking frames a capture has, and between which two a frame lies."""

import pytest

from stage.capture.capture import Capture
from stage.errors import ManifestError
from stage.motion.tracking import Interval, intervals, tracking_frames
from tests.scenes.moving import Subject, write_moving

SMALL = Subject(size=16)


def opened(folder, order):
    return Capture.open(write_moving(folder, SMALL, order))


@pytest.mark.parametrize(("order", "times", "reference"), [
    ("TLLLT", (0, 4), 1), ("TLTLT", (0, 2, 4), 1), ("LTLTLTLT", (1, 3, 5, 7), 2),
])
def test_the_middle_tracking_frame_is_the_reference(tmp_path, order, times, reference):
    found = tracking_frames(opened(tmp_path, order))
    assert (found.times, found.reference) == (times, reference)
    assert [frame.image for frame in found.frames] == [f"{time:02d}.exr" for time in times]


def test_another_may_be_named(tmp_path):
    capture = opened(tmp_path, "TLTLT")
    assert tracking_frames(capture, to="04.exr").reference == 2
    with pytest.raises(ManifestError, match=r"frame: --align-to takes one of 00\.exr, 02\.exr, 04\.exr$"):
        tracking_frames(capture, to="01.exr")


@pytest.mark.parametrize(("order", "count"), [("LLLL", 0), ("LLTLL", 1)])
def test_two_are_needed(tmp_path, order, count):
    with pytest.raises(ManifestError, match=f"{count} lit by a full light: --align follows the subject"):
        tracking_frames(opened(tmp_path, order))


def test_an_image_too_small_to_be_followed(tmp_path):
    capture = Capture.open(write_moving(tmp_path, Subject(size=15), "TLT"))
    with pytest.raises(ManifestError, match=r"camera\.resolution: is 15x15: --align needs 16 to 32766"):
        tracking_frames(capture)


def test_intervals_go_outward_from_the_reference(tmp_path):
    capture = opened(tmp_path, "LTLLLTLTLLTL")
    found = intervals(capture, tracking_frames(capture, to="05.exr"), capture.sources())
    third, fourth = pytest.approx(1 / 3), pytest.approx(4 / 3)
    assert found == [Interval(1, (4,), (0.5,)), Interval(2, (5, 6, 7), (third, pytest.approx(2 / 3), fourth)),
                     Interval(0, (0, 1, 2, 3), (-0.25, 0.25, 0.5, 0.75))]


@pytest.mark.parametrize(("order", "words"), [
    ("LLLTLT", r"frames\[0\]: lies more than one tracking interval before the"),
    ("TLTLLL", r"frames\[5\]: lies more than one tracking interval after the"),
])
def test_a_frame_far_outside_is_named(tmp_path, order, words):
    capture = opened(tmp_path, order)
    with pytest.raises(ManifestError, match=words):
        intervals(capture, tracking_frames(capture), capture.sources())
    capture = opened(tmp_path / "near", order.replace("LLL", "LL"))
    intervals(capture, tracking_frames(capture), capture.sources())  # exactly one interval is not too far
