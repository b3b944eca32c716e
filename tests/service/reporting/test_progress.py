"""Progress: what the recording of it finds wrong, and the seconds that reports hold."""

import pytest

from service.reporting.progress import Timings
from tests.service.recording import Recording, Stage


@pytest.mark.parametrize(("total", "told", "fault"), [
    (1, [], None), (1, [1], None), (3, [1, 2, 3], None), (3, [0, 0, 3], None), (100, [7, 100], None),
    (0, [], "has 0 steps"), (3, [1, 1, 1], "ends at 1 of 3"), (3, [], "ends at 0 of 3"), (3, [4], "ends at 4 of 3"),
    (3, [2, 1, 3], "goes back"),
])
def test_a_stage_that_does_not_come_to_its_total_is_found(total, told, fault):
    found = Stage("frames", total, told).fault
    assert (found is None) == (fault is None) and (fault is None or fault in found)


def test_timings_pass_everything_on_and_keep_the_seconds_of_each_stage():
    recording = Recording()
    timings = Timings(recording)
    timings.stage("frames", 2)
    timings.advance(1)
    timings.advance(2)
    timings.stage("write", 1)
    timings.stage("frames", 1)  # comes again: its seconds are added
    assert list(timings.close()) == ["frames", "write"] and all(seconds >= 0 for seconds in timings.seconds.values())
    assert recording.stages == [("frames", 2, [1, 2]), ("write", 1, []), ("frames", 1, [])]


def test_parts_of_a_stage_are_timed_and_not_told():
    recording = Recording()
    timings = Timings(recording)
    timings.stage("frames", 1)
    for _ in range(2):
        with timings.part("product"):
            pass
    assert list(timings.parts) == ["product"] and len(recording.stages) == 1
