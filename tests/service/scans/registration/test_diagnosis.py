"""What is said of scans that could not be joined claims no more than was looked for."""

import pytest

from service.scans.registration.diagnosis import refusal
from service.scans.registration.pair_tasks import NOT_THERE
from service.scans.registration.pairs import Pair, PairState

NO_POSE = "no pose brings enough of the two surfaces together"


@pytest.mark.parametrize(("reasons", "words"), [
    ((NO_POSE, NO_POSE), "no surface was found that it has in common"),
    ((NOT_THERE, NO_POSE), "no surface was found that it has in common"),
    ((), "no surface was found that it has in common"),
    ((NOT_THERE, NOT_THERE), "does not overlap the others at the poses that are given")])
def test_a_scan_that_no_pose_was_found_for(reasons, words):
    pairs = [Pair(0, other, PairState.NO_POSE, None, 0.0, 0.0, reason) for other, reason in enumerate(reasons, start=1)]
    assert refusal(0, ["front", "left", "back"], pairs, False).startswith(words)


def test_a_pair_that_came_nearer_tells_why():
    pairs = [Pair(0, 1, PairState.NO_POSE, None, 0.0, 0.0, NO_POSE), Pair(0, 2, PairState.LITTLE_OVERLAP, None, 0.05, 0.0, "only 5 %")]
    assert refusal(0, ["front", "left", "back"], pairs, False) == "against back, only 5 %"
