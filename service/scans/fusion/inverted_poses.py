"""Whether scans lie on each other far better with all poses inverted: files of other programs hold world_to_scan too.

About an axis of a round body inverted poses lay scans on each other over most of the surface; what differs, as an arm, is there twice."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from service.scans.fusion.misplaced import LEAST_COMMON, SAME_SIGMAS, Readings, Sample
from service.scans.fusion.range_images import PreparedScan

DOUBTFUL = 0.01
"""Part of the points in common that may contradict before inverted poses are tried: of right poses 1 % do, and up to 5 % where pixels are
coarse, and of inverted ones about a body that is not the same all around its axis 1 to 22 %."""
FAR_BETTER = 0.5
"""Part of the contradicting points that may be left with inverted poses: where these are the right ones .01 to .44 are, and where the poses
as given are, 2.3 times as many or more contradict."""


class Agreement(NamedTuple):
    """The points that scans have in common."""

    common: int  # points of all samples that another scan has near by
    agreeing: int  # those of them that lie on the surface of another scan within their σ

    @property
    def contradicting(self) -> float:
        """Return the part of the points in common that agree with no other scan; 1 where there are next to none."""
        return 1.0 if self.common < LEAST_COMMON else 1 - self.agreeing / self.common


def agreement(samples: list[Sample], readings: list[Readings]) -> Agreement:
    """Return how many points of the samples the readings of all scans, as `misplaced.readings_of` returns them, agree with."""
    common, agreeing = (np.zeros(sum(len(sample.points) for sample in samples), dtype=bool) for _ in range(2))
    for each in readings:
        common[each.at] = True
        agreeing[each.at[np.abs(each.distance) <= SAME_SIGMAS * each.expected]] = True
    return Agreement(int(common.sum()), int(agreeing.sum()))


def inverted_fit(given: Agreement, samples: list[Sample], poses: list[np.ndarray],
                 read: Callable[[list[Sample], "Inverted"], list[Readings]]) -> Agreement | None:
    """Return the agreement with all poses inverted if that is far better than the given one, and else None.

    `poses`: world from scan [4, 4] of each as given. `read`: returns the readings of samples, with scans that `Inverted` moves."""
    if len(poses) < 2 or given.contradicting <= DOUBTFUL:
        return None
    inverted = Inverted(poses)
    moved = [inverted.sample(number, sample) for number, sample in enumerate(samples)]
    found = agreement(moved, read(moved, inverted))
    better = found.contradicting <= FAR_BETTER * given.contradicting and found.agreeing >= given.agreeing + LEAST_COMMON
    return found if better else None


class Inverted:
    """Scans where they lie if their poses are inverted."""

    def __init__(self, poses: list[np.ndarray]) -> None:
        """Take the poses as given, world from scan [4, 4]."""
        self._back = [pose @ pose for pose in poses]  # from where a scan lies then to where it lies as given

    def sample(self, number: int, sample: Sample) -> Sample:
        """Return the points of the scan of a number."""
        motion = np.linalg.inv(self._back[number])
        return sample._replace(points=sample.points @ motion[:3, :3].T + motion[:3, 3], normals=sample.normals @ motion[:3, :3].T)

    def scan(self, number: int, scan: PreparedScan) -> PreparedScan:
        """Return the scan of a number."""
        return scan._replace(image=scan.image._replace(camera_from_world=scan.image.camera_from_world @ self._back[number]))
