"""Compare the surfaces of scans with poses that are not to be moved."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from typing import NamedTuple

import numpy as np

from service.scans.points.rigid import inverse, step_between
from service.scans.points.scan import Scan
from service.scans.registration.extent import CELLS_ACROSS, extent_of
from service.scans.registration.pair_tasks import NOT_THERE, START_CELLS
from service.scans.registration.pairs import Pair, PairState, overlap_of, prepare, refine

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


def check_fixed(scans: Sequence[Scan], poses: Sequence[np.ndarray], *, threads: int, cell_m: float | None, least_overlap: float,
                advance: Callable[[float], None] = lambda done: None) -> FixedPoses:
    """Compare fixed poses, world_from_scan [4, 4], with what the surfaces of overlapping scans ask for.

    Args:
        threads: pairs that are compared at one time.
        cell_m: side of the cells of the rough scale, metres; None: a sixtieth of the median extent of the scans.
        least_overlap: the least part of the smaller of two scans that must be matched.
        advance: told how far the work is, from 0 to 1.
    """
    extent = float(np.median([extent_of(scan) for scan in scans]))
    cell = cell_m or extent / CELLS_ACROSS
    with ThreadPoolExecutor(threads) as pool:
        ready = list(pool.map(lambda scan: prepare(scan, cell_m=cell), scans))

        def one(numbers: tuple[int, int]) -> Pair:
            a, b = (ready[k] for k in numbers)
            start = inverse(poses[numbers[0]]) @ poses[numbers[1]]
            if overlap_of(a, b, start, START_CELLS * cell) < least_overlap:
                return Pair(*numbers, PairState.NO_POSE, None, 0.0, 0.0, NOT_THERE)
            return refine(a, b, start, numbers=numbers, cell_m=cell, least_overlap=least_overlap)

        numbers = list(combinations(range(len(scans)), 2))
        pairs = []
        for done, pair in enumerate(pool.map(one, numbers)):
            pairs.append(pair)
            advance((done + 1) / len(numbers))
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
