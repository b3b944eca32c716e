"""Registration of many scans: which pairs belong together, the poses that fit all of them, and which scans cannot be joined."""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np

from stage.errors import ScanError
from stage.scans.covariance import covariances
from stage.scans.diagnosis import odd_scales, odd_scans, why_alone
from stage.scans.pairs import Pair, PairState, Prepared, prepare, refine, search
from stage.scans.pose_graph import REFUSED, Edge, Solved, solve
from stage.scans.records import Turntable
from stage.scans.rigid import applied, inverse
from stage.scans.scan import Scan
from stage.scans.tree import joined_groups, tree_poses
from stage.scans.turntable import angle_of, freedom, turned_pose

CELLS_ACROSS = 60
"""The extent of a scan in cells of the rough scale: some 1500 cells of a surface are occupied."""
START_CELLS, NEAR_CELLS = 2.0, 1.0
"""Points of two scans overlap, at starts or at poses that were found, if they are at most this many cells apart."""
ROUNDS = 2
"""How often pairs that the poses predict to overlap are looked for."""
Advance = Callable[[float], None]


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """How scans are registered."""

    cell_m: float | None = None
    """Side of the cells of the rough scale, metres; None: a sixtieth of the median extent of the scans."""
    least_overlap: float = 0.1
    """The least part of the smaller of two scans that must be matched."""
    reference: int | None = None
    """The scan whose pose is fixed; None: the first with a start, or the first."""
    threads: int = 1
    """Pairs that are registered at one time."""


class Registration(NamedTuple):
    """The poses of the scans that could be joined, and what became of each pair."""

    poses: dict[int, np.ndarray]  # [4, 4] world_from_scan of each joined scan
    covariances: dict[int, np.ndarray]  # [6, 6] as `stage.scans.records.Covariance`
    reference: int
    """The scan whose pose is fixed."""
    pairs: tuple[Pair, ...]
    alone: dict[int, str]
    """Why each scan that could not be joined is not, in words after its name."""
    scales: dict[int, float]
    """The approximate scale of each joined scan whose scale is not that of the others."""
    weights: dict[tuple[int, int], float]
    """The weight of each joined pair in the poses, from 0 (the others contradict it) to 1."""
    factor: float
    """The standard deviation of what the loops leave, in units of what the information of the pairs says; NaN without loops."""
    cell_m: float


def register(scans: Sequence[Scan], starts: Sequence[np.ndarray | None], options: RegistrationOptions, *,
             table: Turntable | None = None, advance: Advance = lambda done: None) -> Registration:
    """Find the poses of scans of one object.

    Args:
        scans: two or more.
        starts: world_from_scan [4, 4] of each that is right to about a cell of the rough scale and some degrees; None: nothing is known.
        options: how.
        table: the turntable, if its axis is right and only the angles are to be found.
        advance: told how far the work is, from 0 to 1.

    Raises:
        ScanError: no two scans can be joined.
    """
    extents = [extent_of(scan) for scan in scans]
    odd = odd_scans(extents)
    usual = float(np.median([extent for number, extent in enumerate(extents) if number not in odd]))
    cell = options.cell_m or usual / CELLS_ACROSS
    with ThreadPoolExecutor(options.threads) as pool:
        used = [number for number in range(len(scans)) if number not in odd]
        ready = dict(zip(used, pool.map(lambda number: prepare(scans[number], cell_m=cell), used), strict=True))
        advance(0.15)
        pairs = _pairs(ready, starts, cell, options, pool, lambda done: advance(0.15 + 0.6 * done))
        solved, kept = _solved(len(scans), pairs, starts, options, table)
        tried: set[tuple[int, int]] = set()
        for _ in range(ROUNDS):
            found = _predicted(ready, pairs, tried, solved, cell, options, pool)
            if not found:
                break
            pairs |= found
            solved, kept = _solved(len(scans), pairs, starts, options, table)
        advance(0.9)
    joined = solved.poses if solved is not None else {}
    basis = sorted(joined) or used[:1]
    alone = {}
    for number in sorted(set(range(len(scans))) - set(basis)):
        others = [(scans[other], ready[other]) for other in sorted(basis, key=lambda other: abs(other - number))]
        words = why_alone(scans[number], others, extent=extents[number], others_extent=usual, cell_m=cell,
                          least_overlap=options.least_overlap)
        alone[number] = words or _refusal(number, scans, pairs.values())
    advance(1.0)
    if solved is None:
        raise ScanError(*(f"{scans[number].name}: {words}" for number, words in alone.items()))
    if options.reference is not None and options.reference not in joined:
        raise ScanError(f"{scans[options.reference].name}: is the reference, but {alone[options.reference]}")
    weights = {(pair.a, pair.b): float(weight) for pair, weight in zip(kept, solved.weights, strict=True)}
    return Registration(joined, covariances(solved, kept, [edge_of(pair) for pair in kept]), _reference(joined, starts, options),
                        tuple(pairs.values()), alone, odd_scales(kept, list(joined)), weights, solved.factor, cell)


def extent_of(scan: Scan) -> float:
    """Return the diagonal of the box around nearly all points of a scan, metres."""
    low, high = np.percentile(scan.points, (1, 99), axis=0)
    return float(np.linalg.norm(high - low))


def overlap_of(a: Prepared, b: Prepared, pose: np.ndarray, near_m: float) -> float:
    """Return which part of the smaller of two scans lies within a distance of the other at a pose a_from_b, facing the same way."""
    placed = applied(pose, b.rough.points)
    index, distance = a.rough.tree.nearest(placed)
    facing = np.einsum("ni,ni->n", b.rough.normals @ pose[:3, :3].T, a.rough.normals[index[:, 0]]) > 0.5
    return float(((distance[:, 0] < near_m) & facing).sum() / min(len(a.rough.points), len(b.rough.points)))


def _pairs(ready: dict[int, Prepared], starts: Sequence[np.ndarray | None], cell: float, options: RegistrationOptions,
           pool: ThreadPoolExecutor, advance: Advance) -> dict[tuple[int, int], Pair]:
    """Return all pairs: from the starts where there are any, else searched."""
    def one(numbers: tuple[int, int]) -> Pair:
        a, b = (ready[k] for k in numbers)
        first, second = (starts[k] for k in numbers)
        if first is not None and second is not None:
            start = inverse(first) @ second
            if overlap_of(a, b, start, START_CELLS * cell) < options.least_overlap:
                return Pair(*numbers, PairState.NO_POSE, None, 0.0, 0.0, "do not overlap at the poses that are given")
            pair = refine(a, b, start, numbers=numbers, cell_m=cell, least_overlap=options.least_overlap)
            if pair.state in (PairState.JOINED, PairState.AMBIGUOUS):
                return pair
        return search(a, b, numbers=numbers, cell_m=cell, least_overlap=options.least_overlap)

    numbers = list(combinations(ready, 2))
    found = {}
    for done, pair in enumerate(pool.map(one, numbers)):
        found[pair.a, pair.b] = pair
        advance((done + 1) / len(numbers))
    return found


def _predicted(ready: dict[int, Prepared], pairs: dict[tuple[int, int], Pair], tried: set[tuple[int, int]], solved: Solved | None,
               cell: float, options: RegistrationOptions, pool: ThreadPoolExecutor) -> dict[tuple[int, int], Pair]:
    """Return further joined pairs, of scans that overlap at the poses that were found.

    Args:
        ready: the scans.
        pairs: what became of each pair.
        tried: pairs that this function tried before, to which it adds.
        solved: the poses; None: there are none.
        cell: side of the cells of the rough scale, metres.
        options: how.
        pool: for several pairs at a time.
    """
    if solved is None:
        return {}
    poses = solved.poses

    def again(numbers: tuple[int, int]) -> Pair | None:
        a, b = (ready[k] for k in numbers)
        pose = inverse(poses[numbers[0]]) @ poses[numbers[1]]
        if overlap_of(a, b, pose, NEAR_CELLS * cell) < options.least_overlap:
            return None
        tried.add(numbers)
        pair = refine(a, b, pose, numbers=numbers, cell_m=cell, least_overlap=options.least_overlap)
        return pair if pair.state is PairState.JOINED else None

    numbers = [ab for ab, pair in pairs.items()
               if pair.state is not PairState.JOINED and ab[0] in poses and ab[1] in poses and ab not in tried]
    return {(pair.a, pair.b): pair for pair in pool.map(again, numbers) if pair is not None}


def _solved(count: int, pairs: dict[tuple[int, int], Pair], starts: Sequence[np.ndarray | None], options: RegistrationOptions,
            table: Turntable | None) -> tuple[Solved | None, list[Pair]]:
    """Return the poses of the largest group of scans that pairs join without contradiction, and these pairs; None where none are joined."""
    joined = [pair for pair in pairs.values() if pair.state is PairState.JOINED]
    while True:
        group = joined_groups(count, joined)[0]
        if len(group) < 2:
            return None, []
        kept = [pair for pair in joined if pair.a in group]
        reference = _reference(group, starts, options)
        first = starts[reference]
        poses = tree_poses(kept, group, reference, np.eye(4) if first is None else first)
        ways: dict[int, np.ndarray] = {}
        priors: dict[int, np.ndarray] = {}
        if table is not None:
            poses = {number: turned_pose(table, angle_of(table, pose)) for number, pose in poses.items()}
            ways = {number: freedom(table) for number in poses}
            if table.angle_sigma_deg > 0 and table.angles_deg is not None:
                poses = {number: turned_pose(table, table.angles_deg[number]) for number in poses}
                priors = {number: np.array([[np.radians(table.angle_sigma_deg) ** -2]]) for number in poses}
        solved = solve([edge_of(pair) for pair in kept], poses, fixed=reference, freedoms=ways, priors=priors)
        left = [pair for pair, weight in zip(kept, solved.weights, strict=True) if weight > REFUSED]
        if len(joined_groups(count, left)[0]) == len(group):
            return solved, kept
        joined = left


def edge_of(pair: Pair) -> Edge:
    """Return a joined pair as the pose graph takes it."""
    assert pair.fit is not None
    return Edge(pair.a, pair.b, pair.fit.pose, pair.fit.pivot, pair.fit.information)


def _reference(numbers: Iterable[int], starts: Sequence[np.ndarray | None], options: RegistrationOptions) -> int:
    return min(numbers, key=lambda number: (number != options.reference, starts[number] is None, number))


def _refusal(number: int, scans: Sequence[Scan], pairs: Iterable[Pair]) -> str:
    """Return why a scan could not be joined, by the pair that came nearest to it."""
    tried = [pair for pair in pairs if number in (pair.a, pair.b) and pair.state is not PairState.NO_POSE]
    if not tried:
        return "has no surface in common with the others"
    ambiguous = [pair for pair in tried if pair.state is PairState.AMBIGUOUS]
    joined = [pair for pair in tried if pair.state is PairState.JOINED]
    best = max(ambiguous or joined or tried, key=lambda pair: pair.overlap)
    other = scans[best.b if best.a == number else best.a].name
    if best.state is PairState.JOINED:
        return f"is joined with {other} alone, and neither with the largest group of scans"
    further = ": give its turntable or pose and keep that fixed" if best.state is PairState.AMBIGUOUS else ""
    return f"against {other}, {best.reason}{further}"
