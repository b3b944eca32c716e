"""Which pairs of scans are worth a registration: those that overlap at known poses, or else those whose surfaces look alike."""

from collections.abc import Callable, Iterable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from stage.scans.pairs import Prepared
from stage.scans.rigid import applied

ALL_PAIRS = 32
"""Up to so many scans every pair is tried."""
PARTNERS = 12
"""A pair of more scans is tried if it is among so many of one of its scans that overlap most."""
ALIKE_AT_ONCE = 6
"""The most similar scans with which each of more scans without poses is tried, before the poses that are found are used."""
SAMPLE = 200
"""The most features of a scan that are compared with those of others."""
CELL_LIMIT = 1 << 20
"""Cells of the world are numbered from minus to plus so many along each axis."""


class Outline(NamedTuple):
    """What is kept in memory of every scan, to choose pairs."""

    points: np.ndarray  # [n, 3] float32 metres, of the rough scale
    features: np.ndarray  # [m, 33] float32, of some of them
    cell_m: float


def outline_of(ready: Prepared, cell_m: float) -> Outline:
    """Return the outline of a scan whose rough scale has cells of a side, metres."""
    chosen = np.random.default_rng(0).permutation(len(ready.features))[:SAMPLE]
    return Outline(ready.rough.points.astype(np.float32), ready.features[np.sort(chosen)], cell_m)


class Overlaps:
    """How much scans overlap at poses, from above: by cells of the world that both are in or beside."""

    def __init__(self, outlines: Mapping[int, Outline], poses: Mapping[int, np.ndarray], near_cells: float) -> None:
        """Args: outlines: of the scans. poses: world_from_scan [4, 4] of those that have one. near_cells: how far points may be apart."""
        self._outlines, self._poses, self._near = outlines, poses, near_cells
        self._cells: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}

    def most(self, a: int, b: int) -> float:
        """Return a number that the part of the smaller scan that lies within reach of the other does not exceed."""
        side = self._near * max(self._outlines[a].cell_m, self._outlines[b].cell_m)
        if self._outlines[a].cell_m < self._outlines[b].cell_m:
            a, b = b, a
        own, _ = self._of(b, side)
        _, around = self._of(a, side)
        place = np.minimum(np.searchsorted(around, own), len(around) - 1)
        inside = np.count_nonzero(around[place] == own)
        alike = self._outlines[a].cell_m == self._outlines[b].cell_m
        return float(inside / (min(len(own), len(self._outlines[a].points)) if alike else len(own)))

    def _of(self, number: int, side: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell of each point of a scan, and the sorted cells in or beside which it has points."""
        if (number, side) not in self._cells:
            index = np.floor(applied(self._poses[number], self._outlines[number].points.astype(np.float64)) / side).astype(np.int64)
            steps = np.array([1, 2 * CELL_LIMIT, 4 * CELL_LIMIT**2])
            keys = (np.clip(index, -CELL_LIMIT, CELL_LIMIT - 1) + CELL_LIMIT) @ steps
            offsets = np.array(list(np.ndindex(3, 3, 3))) - 1
            self._cells[number, side] = keys, np.unique(np.unique(keys)[:, None] + offsets @ steps)
        return self._cells[number, side]


def overlapping(numbers: Iterable[int], overlaps: Overlaps, least_overlap: float, *, count: int, wanted: Callable[[int, int], bool]
                ) -> list[tuple[int, int]]:
    """Return the pairs of scans that may overlap, each once, the lower number first; of many scans those that overlap most.

    Args:
        numbers: the scans that have poses.
        overlaps: at these.
        least_overlap: the least part of the smaller of two scans.
        count: of all scans; beyond ALL_PAIRS each is tried with PARTNERS others, and with more where it is among the PARTNERS of these.
        wanted: returns whether a pair is to be considered.
    """
    most = {(a, b): overlaps.most(a, b) for a, b in combinations(sorted(numbers), 2) if wanted(a, b)}
    found = {pair: overlap for pair, overlap in most.items() if overlap >= least_overlap}
    if count <= ALL_PAIRS:
        return list(found)
    partners: dict[int, int] = {}
    kept = []
    for (a, b), _ in sorted(found.items(), key=lambda item: (-item[1], item[0])):
        if min(partners.get(a, 0), partners.get(b, 0)) < PARTNERS:
            kept.append((a, b))
            partners[a], partners[b] = partners.get(a, 0) + 1, partners.get(b, 0) + 1
    return sorted(kept)


def likeness(outlines: Mapping[int, Outline]) -> dict[tuple[int, int], float]:
    """Return how unlike the surfaces of every two scans are, whatever their poses: the mean distance of nearest features."""
    found = {}
    squares = {number: (outline.features**2).sum(axis=1) for number, outline in outlines.items()}
    for a, b in combinations(sorted(outlines), 2):
        if outlines[a].cell_m != outlines[b].cell_m:
            continue
        apart = squares[a][:, None] + squares[b][None] - 2 * outlines[a].features @ outlines[b].features.T
        found[a, b] = float(np.sqrt(np.maximum(apart.min(axis=1), 0)).mean() + np.sqrt(np.maximum(apart.min(axis=0), 0)).mean())
    return found


def most_alike(unlike: Mapping[tuple[int, int], float], group_of: Mapping[int, int]) -> list[tuple[int, int]]:
    """Return the pairs of scans of different groups to be tried next: of each scan the most similar, and the next in their order.

    Args:
        unlike: of each pair that was not tried yet.
        group_of: the group of scans that are joined already, of each scan.
    """
    partners: dict[int, int] = {}
    kept = []
    for a, b in sorted(unlike, key=lambda pair: (pair[1] - pair[0] != 1, unlike[pair], pair)):
        if group_of[a] != group_of[b] and min(partners.get(a, 0), partners.get(b, 0)) < ALIKE_AT_ONCE:
            kept.append((a, b))
            partners[a], partners[b] = partners.get(a, 0) + 1, partners.get(b, 0) + 1
    return sorted(kept)
