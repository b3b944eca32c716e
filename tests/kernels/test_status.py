"""Codes of pixels: what counts as solved is what was asked for."""

import numpy as np

from kernels.status import ESTIMATED, SOLVED, Status, refuse_unsure

CODES = np.array([Status.OK, Status.OK, Status.AMBIGUOUS, Status.SHADOWED, Status.NOT_CONVERGED, Status.MULTIPATH], dtype=np.uint8)
SIGMA = np.array([1.0, 20.0, 9.0, 0.0, np.nan, 30.0], dtype=np.float32)
CONFIDENCE = np.array([0.5, 0.05, 0.1, 0.0, 0.9, 0.0], dtype=np.float16)


def refused(**limits):
    status = CODES.copy()
    refuse_unsure(status, SIGMA, CONFIDENCE, **{"max_sigma": None, "least_confidence": 0.0, **limits})
    return np.flatnonzero(status == Status.UNSURE).tolist()


def test_solved_pixels_beyond_a_limit_become_unsure():
    """A deviation that is not a number is no certainty; pixels that were not solved keep the reason why."""
    assert refused() == []
    assert refused(max_sigma=15.0) == [1, 4]
    assert refused(least_confidence=0.2) == [1, 2]
    assert refused(max_sigma=15.0, least_confidence=0.2) == [1, 2, 4]


def test_what_is_not_known_refuses_nothing():
    status = CODES.copy()
    refuse_unsure(status, None, None, max_sigma=0.1, least_confidence=1.0)
    assert np.array_equal(status, CODES)


def test_unsure_pixels_carry_values_and_are_not_solved():
    assert set(SOLVED) < set(ESTIMATED) and Status.UNSURE in set(ESTIMATED) - set(SOLVED)
    assert not {Status.UNSOLVED, Status.SHADOWED, Status.SATURATED, Status.DARK, Status.LOW_MODULATION} & set(ESTIMATED)
