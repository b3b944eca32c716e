"""Compare the surfaces of scans with poses that are not to be moved."""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from service.scans.points.rigid import inverse, step_between
from service.scans.registration.extent import CELLS_ACROSS
from service.scans.registration.pair_tasks import START_CELLS, PairTask
from service.scans.registration.pairs import Pair, PairState
from service.scans.registration.registration import Advance, ScanWork

WRONG_SIGMAS, WRONG_PART = 5.0, 1e-4
"""A pair contradicts the poses if it differs by so many standard deviations and by this part of the extent of the scans, also as a turn."""


class FixedPoses(NamedTuple):
    """Poses as they were given, and the pairs of scans that overlap there."""

    poses: list[np.ndarray]
    pairs: tuple[Pair, ...]
    off: dict[tuple[int, int], tuple[float, float]]
    """Difference between the best and the given pose of each joined pair: metres at the overlap, and degrees."""
    wrong: dict[tuple[int, int], tuple[float, float]]
    """The part of `off` that noise does not explain."""


def check_fixed(work: ScanWork, extents: Sequence[float], poses: Sequence[np.ndarray], *, cell_m: float | None, least_overlap: float,
                advance: Advance = lambda done: None) -> FixedPoses:
    """Compare fixed poses, world_from_scan [4, 4], with what the surfaces of overlapping scans ask for.

    Args:
        extents: of the scans, as `extent_of` returns it.
        cell_m: side of the cells of the rough scale, metres; None: a sixtieth of the median extent of the scans.
        least_overlap: the least part of the smaller of two scans that must be matched.
        advance: told how far the work is, from 0 to 1.
    """
    extent = float(np.median(extents))
    cells = dict.fromkeys(range(len(poses)), cell_m or extent / CELLS_ACROSS)
    work.outlines(cells, lambda done: advance(0.15 * done))
    tasks = [PairTask(a, b, inverse(poses[a]) @ poses[b], START_CELLS, may_search=False) for a, b in combinations(cells, 2)]
    pairs = work.pairs(tasks, cells, least_overlap, lambda done: advance(0.15 + 0.85 * done))
    off, wrong = {}, {}
    for pair in pairs:
        if pair.state is not PairState.JOINED or pair.fit is None:
            continue
        step = step_between(pair.fit.pose @ inverse(inverse(poses[pair.a]) @ poses[pair.b]), pair.fit.pivot)
        shift, turn = float(np.linalg.norm(step[3:])), float(np.linalg.norm(step[:3]))
        off[pair.a, pair.b] = shift, float(np.degrees(turn))
        if step @ pair.fit.information @ step > 6 * WRONG_SIGMAS**2 and max(shift, turn * extent) > WRONG_PART * extent:
            wrong[pair.a, pair.b] = off[pair.a, pair.b]
    return FixedPoses(list(poses), tuple(pairs), off, wrong)
