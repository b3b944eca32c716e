"""Whether scans lie on each other far better if their poses are read otherwise, as files of other programs have them, or at another scale.

About an axis of a round body inverted poses lay scans on each other over most of the surface; what differs, as an arm, is there twice.
Where poses are right and their unit or calibration is not, each surface grows about its own scanner, and every scan seems misplaced.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from service.scans.fusion.misplaced import LEAST_COMMON, ROUNDS, SAME_SIGMAS, Readings, Sample
from service.scans.fusion.range_images import PreparedScan
from stage.transforms import OPENCV_FROM_CAMERA

DOUBTFUL = 0.02
"""Part of the points in common that may contradict before poses are read otherwise: of right poses 1 % do, and up to 5 % where pixels are
coarse; of inverted ones about a body that is not nearly the same all around its axis 2 to 22 %."""
FAR_BETTER = 0.5
"""Part of the contradicting points that may be left with poses that are read otherwise: where these are the right ones .01 to .44 are, and
where the poses as given are, 2.3 times as many or more contradict."""
FEW_DOUBTFUL, MOST_CONTRADICTING = 4, 0.05
"""Most scans at wrong places of which any two are tried exchanged, of more the whole list is tried in other orders; and largest part of the
points in common that contradict in the right one."""
LEAST_SCANS = 3
"""Fewest scans whose scale can be told from their places: two that lie apart along their lines of sight fit at some scale too."""
OPENCV = np.eye(4)
OPENCV[:3, :3] = OPENCV_FROM_CAMERA
"""To the axes of OpenCV, in which the poses of imported frames are, and back."""


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


def _w_first(pose: np.ndarray) -> np.ndarray:
    """Return a pose of imported frames whose quaternion was read as x y z w, and is w x y z."""
    camera = pose @ OPENCV
    camera[:3, :3] = Rotation.from_quat(np.roll(Rotation.from_matrix(camera[:3, :3]).as_quat(), -1)).as_matrix()
    return np.asarray(camera @ OPENCV)


OTHERWISE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "the poses are world_to_scan": np.linalg.inv,
    "the poses that were imported are world_to_camera": lambda pose: np.asarray(OPENCV @ np.linalg.inv(pose) @ OPENCV),
    "the quaternions of the poses that were imported begin with w": _w_first,
    "the y and z axes of the scans are negated (OpenCV's axes in scan_to_world, or OpenGL's in poses that were imported)":
        lambda pose: np.asarray(pose @ OPENCV),
}
"""How poses, world from scan [4, 4], may have been meant."""


class Moved:
    """Scans where they lie at other poses."""

    def __init__(self, given: list[np.ndarray], others: list[np.ndarray]) -> None:
        """Take the poses as given and the other ones, world from scan [4, 4]."""
        self._back = [pose @ np.linalg.inv(other) for pose, other in zip(given, others, strict=True)]

    def sample(self, number: int, sample: Sample) -> Sample:
        """Return the points of the scan of a number."""
        motion = np.linalg.inv(self._back[number])
        return sample._replace(points=sample.points @ motion[:3, :3].T + motion[:3, 3], normals=sample.normals @ motion[:3, :3].T)

    def scan(self, number: int, scan: PreparedScan) -> PreparedScan:
        """Return the scan of a number."""
        return scan._replace(image=scan.image._replace(camera_from_world=scan.image.camera_from_world @ self._back[number]))


def meant_otherwise(samples: list[Sample], readings: list[Readings], poses: list[np.ndarray],
                    read: Callable[[list[Sample], Moved], list[Readings]]) -> str | None:
    """Return how the poses must be read for scans to lie on each other far better than as given, in words; None: there is no such way.

    `readings`: of the poses as given. `poses`: world from scan [4, 4] of each. `read`: returns the readings of samples, with scans that
    `Moved` moves."""
    given = agreement(samples, readings)
    if len(poses) < 2 or given.contradicting <= DOUBTFUL:
        return None
    fitting: list[tuple[float, int, str, Agreement]] = []
    for words, other in OTHERWISE.items():
        moved = Moved(poses, [other(pose) for pose in poses])
        there = [moved.sample(number, sample) for number, sample in enumerate(samples)]
        found = agreement(there, read(there, moved))
        if found.contradicting <= FAR_BETTER * given.contradicting and found.agreeing >= given.agreeing + LEAST_COMMON:
            fitting.append((found.contradicting, len(fitting), words, found))
    if not fitting:
        return None
    _, _, words, found = min(fitting)
    return f"{_said(words, found, given)}: write them as scan_to_world"


def in_another_order(samples: list[Sample], readings: list[Readings], poses: list[np.ndarray], names: Sequence[str], doubtful: list[int],
                     read: Callable[[list[Sample], Moved], list[Readings]]) -> str | None:
    """Return in which order the poses must be for scans to lie on each other better than as given, in words; None: there is none.

    `names`: of the scans. `doubtful`: numbers of those that lie beside the others or have no surface in common with them. The rest is
    as of `meant_otherwise`."""
    given, everyone = agreement(samples, readings), [*range(len(poses))]
    orders: dict[str, list[int]] = {}
    if len(doubtful) <= FEW_DOUBTFUL:
        for one, two in combinations(doubtful, 2):
            exchanged = {one: two, two: one}
            orders[f"the poses of {names[one]} and {names[two]} are exchanged"] = [exchanged.get(number, number) for number in everyone]
    elif 2 * len(doubtful) >= len(poses):
        as_text = sorted(everyone, key=str)
        orders = {"the poses are in the opposite order, as where a table turns the other way": everyone[::-1],
                  "each pose is that of the scan before": everyone[1:] + everyone[:1],
                  "each pose is that of the scan after": everyone[-1:] + everyone[:-1],
                  "the poses are in the order of their numbers as text (1, 10, 11, 2)": np.argsort(as_text).tolist(),
                  "the scans are in the order of their numbers as text (1, 10, 11, 2)": as_text}
    fitting: list[tuple[int, str, Agreement]] = []
    for words, order in orders.items():
        moved = Moved(poses, [poses[number] for number in order])
        there = [moved.sample(number, sample) for number, sample in enumerate(samples)]
        found = agreement(there, read(there, moved))
        if found.contradicting <= MOST_CONTRADICTING and found.agreeing >= given.agreeing + 2 * LEAST_COMMON:
            fitting.append((found.agreeing, words, found))
    if not fitting:
        return None
    _, words, found = max(fitting)
    return f"{_said(words, found, given)}: put them in that order"


def _said(words: str, found: Agreement, given: Agreement) -> str:
    return (f"{words}: read so, {found.agreeing} points of scans lie on other scans and {found.common - found.agreeing} beside "
            f"them, and {given.agreeing} and {given.common - given.agreeing} as they are")


def common_scale(samples: list[Sample], readings: list[Readings], scanners: np.ndarray) -> tuple[float, list[Readings]]:
    """Return the factor by which the depths of all scans must be multiplied to lie on each other best, and what the readings are then.

    `readings`: of each scan, as `misplaced.readings_of` returns them. `scanners`: [N, 3] metres, world, where each scan was taken from."""
    firsts = np.cumsum([0, *(len(sample.points) for sample in samples)])
    normals = np.concatenate([sample.normals for sample in samples])
    towards = [np.einsum("ni,ni->n", normals[each.at], scanners[number] - scanners[np.searchsorted(firsts, each.at, side="right") - 1])
               for number, each in enumerate(readings)]  # how fast a point leaves the surface as the scale grows
    along, distance = np.concatenate(towards), np.concatenate([each.distance for each in readings]).astype(np.float64)
    growth = 0.0
    for _ in range(ROUNDS):
        rest = np.abs(distance + growth * along)
        weight = along / (1 + (rest / max(1.5 * float(np.median(rest)), 1e-9)) ** 2)
        growth = -float(weight @ distance) / max(float(weight @ along), 1e-12)
    return 1 + growth, [each._replace(distance=(each.distance + growth * part).astype(np.float32), through=each.through[:0])
                        for each, part in zip(readings, towards, strict=True)]
