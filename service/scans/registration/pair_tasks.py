"""Pairs of scans that are to be registered, each of them work of its own that depends on nothing but its two scans."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from service.scans.points.cloud import Thinned, cloud_of, thin
from service.scans.points.rigid import applied, inverse
from service.scans.registration.coarse import fpfh
from service.scans.registration.look_alikes import told_from_shifted, told_from_turned
from service.scans.registration.pairs import FEATURE_CELLS, FINE_POINTS, ROUGH_POINTS, Pair, PairState, Prepared, overlap_of, refine, search

START_CELLS, NEAR_CELLS = 2.0, 1.0
"""Points of two scans overlap, at starts or at poses that were found, if they are at most this many cells apart."""
AROUND = 0.5
"""By how much, in its extent, the part of a larger scan reaches beyond a smaller one that is registered to it."""
FEW = 50
"""Fewest points of the part of a scan that another is registered to."""
NOT_THERE = "do not overlap at the poses that are given"
"""The reason of a pair that was not tried for this."""


class PairTask(NamedTuple):
    """Two scans, and what is known of the pose of one against the other."""

    a: int
    b: int
    start: np.ndarray | None
    """[4, 4] a_from_b; None: nothing is known."""
    near_cells: float
    """Points overlap at the start if they are at most this many cells apart."""
    may_search: bool
    """True if the pose is searched if the start does not lead to one."""
    accept_alike: bool = False
    """True if a pose that was searched is taken although the scans fit as well when they are turned."""
    start_decides: bool = False
    """True if the start is taken in directions that the surfaces leave open, and nothing is searched in its place."""
    start_is_rough: bool = False
    """True if the start is right to about a cell alone, so that other poses as near it are tried."""


def register_pair(task: PairTask, a: Prepared, b: Prepared, *, cell_m: tuple[float, float], least_overlap: float) -> Pair:
    """Register two scans as a task says.
    `cell_m`: side of the cells of the rough scale of each, metres. If they differ, the part of the larger scan around the smaller one is
    taken at the scale of that, which takes a start."""
    numbers, cell = (task.a, task.b), min(cell_m)
    if task.start is None and cell_m[0] != cell_m[1]:
        return Pair(*numbers, PairState.NO_POSE, None, 0.0, 0.0, "are of different scales, and no pose is given to start from")
    if task.start is not None:
        if cell_m[0] > cell_m[1]:
            a, cell = _part_around(a, b, task.start, cell)
        elif cell_m[1] > cell_m[0]:
            b, cell = _part_around(b, a, inverse(task.start), cell)
        if min(len(a.rough.points), len(b.rough.points)) == 0 or overlap_of(a, b, task.start, task.near_cells * cell) < least_overlap:
            return Pair(*numbers, PairState.NO_POSE, None, 0.0, 0.0, NOT_THERE)
        pair = refine(a, b, task.start, numbers=numbers, cell_m=cell, least_overlap=least_overlap,
                      decides=task.start_decides)
        if task.start_is_rough:
            pair = told_from_shifted(a, b, pair, task.start, cell_m=cell, least_overlap=least_overlap, accept=task.start_decides)
        if not task.may_search or task.start_decides or pair.state in (PairState.JOINED, PairState.AMBIGUOUS):
            return pair
    return told_from_turned(a, b, search(a, b, numbers=numbers, cell_m=cell, least_overlap=least_overlap), cell_m=cell,
                            least_overlap=least_overlap, accept=task.accept_alike)


def _part_around(large: Prepared, small: Prepared, start: np.ndarray, cell_m: float) -> tuple[Prepared, float]:
    """Return the part of a scan around a smaller one, large_from_small [4, 4], at the scale of that or as fine as its points allow it, and
    the side of the cells of that scale."""
    placed = applied(start, small.rough.points)
    low, high = placed.min(axis=0), placed.max(axis=0)
    reach = AROUND * float(np.linalg.norm(high - low))
    fine = large.fine
    inside = ((fine.points > low - reach) & (fine.points < high + reach)).all(axis=1)
    if inside.sum() < FEW:
        return replace(large, rough=replace(large.rough, points=np.zeros((0, 3)))), cell_m
    part = cloud_of(Thinned(fine.points[inside], fine.directions[inside], fine.sigma[inside]), most=FINE_POINTS)
    cell = max(cell_m, float(np.median(part.spacing)))
    rough = cloud_of(thin(part.points, part.directions, part.sigma**2, cell), most=ROUGH_POINTS)
    return Prepared(rough=rough, fine=part, features=fpfh(rough, FEATURE_CELLS * cell), image=large.image,
                    area=len(rough.points) * cell**2), cell
