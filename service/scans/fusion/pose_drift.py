"""Whether poses drift from scan to scan, as where the step of a turntable is declared wrong: each scan lies beside the next one by the
same small motion, less than noise, and the last beside the first by all of them."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from service.scans.fusion.misplaced import LEAST_COMMON, Readings, Sample, fitted_motion

LEAST_SCANS = 4
"""Fewest scans that tell a drift from the displacement of one."""
LEAST_SIGMAS, EXPLAINED = 0.25, 0.95
"""RMS displacement of the drift, in median standard deviations of the comparison, and robust cost that it leaves of that without it, for it
to be told: of right poses it is .01 and 1.00, where the second half of the scans lies elsewhere .23 and .96, and of a turntable with 24
steps of .3 and 1 % more .41 and .93, 1.4 and .79."""
MOST_READINGS = 500_000
"""About as many readings are fitted; hundreds of scans have millions."""
ROUNDS = 20
"""Rounds of reweighting of the fit, which begins with no motion and comes nearer to that of most readings by a third or more in each."""


class Drift(NamedTuple):
    """A motion that poses have too much from each scan to the next."""

    turn: np.ndarray  # [3] rotation vector in radians, world
    displacement_m: float  # RMS of what it adds between two scans, along the normals of what both see

    def words(self, poses: list[np.ndarray] | None) -> str:
        """Return it in words. `poses`: world from scan [4, 4] of each, if known."""
        apart = f"scans lie {1e3 * self.displacement_m:.3g} mm beside each other (RMS)"
        if poses is None:
            return f"from scan to scan the poses drift, and {apart}"
        steps = [Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec() for before, after in pairwise(poses)]
        declared, shown = (np.degrees(np.median(np.linalg.norm(np.array(steps) - turn, axis=1))) for turn in (0.0, self.turn))
        return (f"scans[].scan_to_world: from scan to scan the poses turn by {declared:.4g}° in the median, and the surfaces by some "
                f"{shown:.4g}°, so that {apart}: the step of a turntable is another one, or the poses drift: relit register finds them")


def pose_drift(samples: list[Sample], readings: list[Readings]) -> Drift | None:
    """Return the motion by which each scan lies farther from the surface of the others than the scan before; None: there is none.
    `readings`: of each scan, as `misplaced.readings_of` returns them; the scans are in the order in which they were taken."""
    every = 1 + sum(len(each.at) for each in readings) // MOST_READINGS
    readings = [Readings(each.at[::every], each.distance[::every], each.expected[::every]) for each in readings]
    at, distance, expected = (np.concatenate([getattr(each, name) for each in readings]) for name in ("at", "distance", "expected"))
    if len(samples) < LEAST_SCANS or len(at) < LEAST_COMMON * len(samples):
        return None
    points, normals = (np.concatenate([getattr(sample, name) for sample in samples])[at] for name in ("points", "normals"))
    scan = np.repeat(np.arange(len(samples)), [len(sample.points) for sample in samples])[at]
    steps = scan - np.repeat(np.arange(len(readings)), [len(each.at) for each in readings])
    place = points - points.mean(axis=0)
    extent = max(float(np.abs(place).max()), 1e-12)
    rows = steps[:, None] * np.concatenate([np.cross(place / extent, normals), normals], axis=1)
    spread = max(1.5 * float(np.median(np.abs(distance))), 1e-9)
    motion = fitted_motion(rows, distance, ROUNDS)
    drifted = rows @ motion
    before, after = (np.log1p((rest / spread) ** 2).sum() for rest in (distance, distance - drifted))
    displacement = float(np.sqrt(np.mean(drifted**2)))
    told = displacement > LEAST_SIGMAS * float(np.median(expected)) and after < EXPLAINED * before
    return Drift(motion[:3] / extent, displacement) if told else None
