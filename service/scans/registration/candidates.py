"""Choose the pairs of scans to register: those that overlap at known poses, or else those whose surfaces look alike."""

from collections.abc import Callable, Iterable, Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np

from service.scans.points.rigid import applied
from service.scans.registration.pairs import Prepared

ALL_PAIRS = 32
"""Up to so many scans every pair is tried."""
PARTNERS, OTHER_PARTNERS = 12, 4
"""A pair of more scans is tried if it is among so many of one of its scans that overlap most: of those of its scale, and of others."""
FACING = 0.4
"""The least component of a normal along an axis, to either side, by which a point counts as turned that way: each is to one to three."""
ALIKE_AT_ONCE = 6
"""The most similar scans with which each of more scans without poses is tried, before the poses that are found are used."""
SAMPLE = 200
"""The most features of a scan that are compared with those of others."""
CELL_LIMIT = 1 << 19
"""Cells of the world are numbered from minus to plus so many along each axis."""
STEPS = np.array([1, 2 * CELL_LIMIT, 4 * CELL_LIMIT**2])
"""Strides of the cell number along each axis; six times the largest number still fits a 64-bit integer."""


class Outline(NamedTuple):
    """Reduced points, normals and features of a scan, kept in memory to choose pairs."""

    points: np.ndarray  # [n, 3] float32 metres, of the rough scale
    normals: np.ndarray  # [n, 3] float32, of these points
    features: np.ndarray  # [m, 33] float32, of some of them
    cell_m: float


def outline_of(ready: Prepared, cell_m: float) -> Outline:
    """Return the outline of a scan whose rough scale has cells of a side, metres."""
    chosen = np.random.default_rng(0).permutation(len(ready.features))[:SAMPLE]
    return Outline(ready.rough.points.astype(np.float32), ready.rough.normals.astype(np.float32), ready.features[np.sort(chosen)], cell_m)


class Overlaps:
    """Upper bound of the overlap of scans at poses: by cells of the world that both are in or beside."""

    def __init__(self, outlines: Mapping[int, Outline], poses: Mapping[int, np.ndarray], near_cells: float) -> None:
        """Make the bound for scans at poses.
        `outlines`: of the scans. `poses`: world_from_scan [4, 4] of those that have one. `near_cells`: how far points may be apart, in
        cells."""
        self._outlines, self._poses, self._near = outlines, poses, near_cells
        self._cells: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}
        self._ways: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}

    def of_one_scale(self, a: int, b: int) -> bool:
        """Return whether the rough scales of two scans have cells of one side."""
        return self._outlines[a].cell_m == self._outlines[b].cell_m

    def most(self, a: int, b: int) -> float:
        """Return a number that the part of the smaller scan that lies within reach of the other does not exceed."""
        side = self._near * max(self._outlines[a].cell_m, self._outlines[b].cell_m)
        if self._outlines[a].cell_m < self._outlines[b].cell_m:
            a, b = b, a
        own, _ = self._of(b, side)
        _, around = self._of(a, side)
        place = np.minimum(np.searchsorted(around, own), len(around) - 1)
        inside = np.count_nonzero(around[place] == own)
        return float(inside / (min(len(own), len(self._outlines[a].points)) if self.of_one_scale(a, b) else len(own)))

    def facing(self, a: int, b: int) -> float:
        """Return about which part of the smaller scan, or of the scan of smaller scale, has surface of the other around it that is turned
        the same way, so that both can have seen it: what pairs are ordered by."""
        side = self._near * max(self._outlines[a].cell_m, self._outlines[b].cell_m)
        if self._outlines[a].cell_m < self._outlines[b].cell_m:
            a, b = b, a
        own, around = self._turned(b, side)[0], self._turned(a, side)[1]
        inside = around[np.minimum(np.searchsorted(around, own), len(around) - 1)] == own
        part = inside.reshape(len(own) // 6, 6).any(axis=1).sum()
        alike = self.of_one_scale(a, b)
        return float(part / (min(len(self._outlines[number].points) for number in (a, b)) if alike else len(own) // 6))

    def _turned(self, number: int, side: float) -> tuple[np.ndarray, np.ndarray]:
        """Return six numbers for each point of a scan, of its cell and of each way along an axis, [6n], −1 of ways that it is not turned;
        and the sorted numbers of cells in or beside which it has points that are turned that way."""
        key = number, side
        if key not in self._ways:
            normals = self._outlines[number].normals.astype(np.float64) @ self._poses[number][:3, :3].T
            turned = np.concatenate([normals, -normals], axis=1) > FACING
            cells = self._of(number, side)[0]
            offsets = (np.array(list(np.ndindex(3, 3, 3))) - 1) @ STEPS
            around = [6 * np.unique(np.unique(cells[turned[:, way]])[:, None] + offsets) + way for way in range(6)]
            self._ways[key] = np.where(turned, 6 * cells[:, None] + np.arange(6), -1).ravel(), np.unique(np.concatenate(around))
        return self._ways[key]

    def _of(self, number: int, side: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell of each point of a scan, and the sorted cells in or beside which it has points."""
        if (number, side) not in self._cells:
            index = np.floor(applied(self._poses[number], self._outlines[number].points.astype(np.float64)) / side).astype(np.int64)
            keys = (np.clip(index, -CELL_LIMIT, CELL_LIMIT - 1) + CELL_LIMIT) @ STEPS
            offsets = np.array(list(np.ndindex(3, 3, 3))) - 1
            self._cells[number, side] = keys, np.unique(np.unique(keys)[:, None] + offsets @ STEPS)
        return self._cells[number, side]


def overlapping(numbers: Iterable[int], overlaps: Overlaps, least_overlap: float, *, count: int, wanted: Callable[[int, int], bool]
                ) -> list[tuple[int, int]]:
    """Return the pairs of scans that may overlap, each once, the lower number first; of many scans those that overlap most.
    `numbers`: the scans that have poses. `count`: of all scans; beyond ALL_PAIRS each is tried with PARTNERS others of its scale and
    OTHER_PARTNERS of other scales, and with more where it is among those of these. `wanted`: returns whether a pair is to be considered."""
    most = {(a, b): overlaps.most(a, b) for a, b in combinations(sorted(numbers), 2) if wanted(a, b)}
    found = {pair: overlap for pair, overlap in most.items() if overlap >= least_overlap}
    if count <= ALL_PAIRS:
        return list(found)
    partners: dict[tuple[int, bool], int] = {}
    kept = []
    facing = {pair: overlaps.facing(*pair) for pair in found}
    for a, b in sorted(found, key=lambda pair: (-facing[pair], -found[pair], pair)):
        alike = overlaps.of_one_scale(a, b)
        if facing[a, b] >= least_overlap and min(partners.get((number, alike), 0) for number in (a, b)) < (
                PARTNERS if alike else OTHER_PARTNERS):
            kept.append((a, b))
            for number in (a, b):
                partners[number, alike] = partners.get((number, alike), 0) + 1
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
    """Return the pairs of scans of different groups to be tried next: of each scan the most similar, and the next in their order."""
    partners: dict[int, int] = {}
    kept = []
    for a, b in sorted(unlike, key=lambda pair: (pair[1] - pair[0] != 1, unlike[pair], pair)):
        if group_of[a] != group_of[b] and min(partners.get(a, 0), partners.get(b, 0)) < ALIKE_AT_ONCE:
            kept.append((a, b))
            partners[a], partners[b] = partners.get(a, 0) + 1, partners.get(b, 0) + 1
    return sorted(kept)
