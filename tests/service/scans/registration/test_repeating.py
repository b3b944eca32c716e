"""Starts about half a period off, on plates with a pattern: which period is right is told by nothing."""

import numpy as np
import pytest

from service.scans.points.rigid import step_between
from service.scans.points.scan import Scan
from service.scans.registration.registration import NoneJoinedError
from tests.scenes.register import register, scan_with
from tests.scenes.turntable import MM

pytestmark = pytest.mark.long
PERIOD, SIGMA = 5 * MM, 0.03 * MM


def pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Dimples in rows and columns."""
    return 0.2 * MM * (np.cos(2 * np.pi * x / PERIOD) + np.cos(2 * np.pi * y / PERIOD))


def uneven(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Dimples on a plate whose broad form tells where they are."""
    return pattern(x, y) + 4 * MM * np.sin(x / 13e-3 + 1) * np.sin(y / 17e-3)


def plate(height, left_m: float, seed: int) -> Scan:
    """Points of 120 mm x 80 mm of a plate, from a scanner 1 m above its middle."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(left_m, left_m + 0.12, 12_000), random.uniform(-0.04, 0.04, 12_000)
    points = np.column_stack([x, y, height(x, y)])
    origin = np.array([left_m + 0.06, 0, 1.0])
    sight = (points - origin) / np.linalg.norm(points - origin, axis=1)[:, None]
    points += sight * random.normal(0, SIGMA, len(points))[:, None]
    return scan_with(points, SIGMA, name=f"from {left_m:g} m", origin=origin)


def registered(height, start_m: float, *, starts_decide: bool = False):
    """Two plates whose frames are that of the world, the second with a start beside its place."""
    start = np.eye(4)
    start[0, 3] = start_m
    return register([plate(height, -0.08, 1), plate(height, -0.04, 2)], [np.eye(4), start], starts_decide=starts_decide)


@pytest.mark.parametrize("start_m", [2.4 * MM, 2.6 * MM])
def test_a_start_between_two_periods_is_refused(start_m):
    with pytest.raises(NoneJoinedError, match=r"a pose .* mm beside fits as well, and is as near its start: the surface repeats itself"):
        registered(pattern, start_m)


@pytest.mark.parametrize(("height", "start_m"), [(pattern, 0.3 * MM), (pattern, 1.5 * MM), (uneven, 1.5 * MM), (uneven, 2.4 * MM)])
def test_right_starts_and_plates_that_do_not_repeat_are_joined(height, start_m):
    found = registered(height, start_m)
    # σ of the pose is about .015 mm; the neighbouring period is 5 mm away
    assert np.linalg.norm(step_between(found.poses[1], np.zeros(3))[3:]) < 0.1 * MM
    assert not found.pairs[0].reason


def test_a_start_that_decides_has_a_sigma_that_reaches_the_other_period():
    found = registered(pattern, 2.6 * MM, starts_decide=True)
    assert "the start is taken" in found.pairs[0].reason
    assert np.linalg.norm(step_between(found.poses[1], np.zeros(3))[3:]) < 3 * np.sqrt(np.trace(found.covariances[1][3:, 3:]))
