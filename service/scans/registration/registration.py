"""Registration of many scans: which pairs belong together, the poses that fit all of them, and which scans cannot be joined.

Scans are needed one or two at a time. Who calls says where they are in the meantime, and where pairs are registered.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import NamedTuple, Protocol

import numpy as np

from service.scans.points.rigid import inverse
from service.scans.points.scan import Scan, Target
from service.scans.registration.candidates import ALL_PAIRS, PARTNERS, Outline, Overlaps, likeness, most_alike, overlapping
from service.scans.registration.covariance import covariances, rows_of
from service.scans.registration.diagnosis import odd_scales, refusal, refused_targets, why_alone
from service.scans.registration.extent import CELLS_ACROSS, cells_of, usual_extent
from service.scans.registration.fine import Rows
from service.scans.registration.look_alikes import looks_alike_turned
from service.scans.registration.pair_tasks import NEAR_CELLS, NOT_THERE, START_CELLS, PairTask
from service.scans.registration.pairs import Evidence, Pair, PairState, Prepared
from service.scans.registration.pose_graph import REFUSED, Edge, Solved, joined_groups, solve, tree_poses
from service.scans.registration.seen_through import open_pairs, wrongly_joined
from service.scans.registration.target_pairs import TargetPlace, against_surfaces, pairs_by_targets, target_places
from stage.errors import ScanError
from stage.sets.scan_set import Turntable

ROUNDS = 2
"""Number of times that pairs which the poses predict to overlap are looked for."""
Advance = Callable[[float], None]


@dataclass(frozen=True, kw_only=True)
class RegistrationOptions:
    """Options of the registration of scans."""

    cell_m: float | None = None
    """Side of the cells of the rough scale, metres; None: a sixtieth of the median extent of the scans."""
    least_overlap: float = 0.1
    """The least part of the smaller of two scans that must be matched."""
    reference: int | None = None
    """The scan whose pose is fixed; None: the first with a start, or the first."""
    accept_alike: bool = False
    """Whether a pose is taken although turned ones pass all tests as well."""
    starts_decide: bool = False
    """Whether starts are taken in directions that the surfaces leave open, and although parts of the surfaces are seen through."""


class ScanWork(Protocol):
    """The places where scans and pairs are made and kept."""

    def outlines(self, cells: dict[int, float], advance: Advance) -> dict[int, Outline]:
        """Prepare scans at rough scales with cells of these sides, metres, and return their outlines."""

    def ready(self, number: int) -> Prepared:
        """Return a scan that was prepared."""

    def pairs(self, tasks: Sequence[PairTask], cells: dict[int, float], least_overlap: float, advance: Advance) -> list[Pair]:
        """Register pairs of prepared scans; they may be without their rows."""

    def rows(self, pair: Pair) -> Rows:
        """Return the matched points of a pair."""

    def scan(self, number: int) -> Scan:
        """Return a scan as it was read."""


class Registration(NamedTuple):
    """The poses of the scans that could be joined, and what became of each pair."""

    poses: dict[int, np.ndarray]  # [4, 4] world_from_scan of each joined scan
    covariances: dict[int, np.ndarray]  # [6, 6] as `stage.sets.scan_set.Covariance`
    reference: int
    """The scan whose pose is fixed."""
    pairs: tuple[Pair, ...]
    alone: dict[int, str]
    """The reason for each scan that could not be joined, in words after its name."""
    scales: dict[int, float]
    """The approximate scale of each joined scan whose scale is not that of the others."""
    kept: tuple[tuple[Pair, float], ...]
    """The pairs between joined scans with their weights in the poses, from 0 (the others contradict it) to 1."""
    factor: float
    """The standard deviation of what the loops leave, in units of what the information of the pairs says; NaN without loops."""
    cell_m: float
    targets: tuple[TargetPlace, ...]
    """The targets that two or more joined scans show."""
    alike_turned: tuple[int, ...]
    """Joined scans of unknown start without targets that look much the same when they are turned about an axis."""


class NoneJoinedError(ScanError):
    """No scans could be joined, or not the reference; with what became of each pair, for a report."""

    def __init__(self, names: Sequence[str], alone: dict[int, str], pairs: tuple[Pair, ...]) -> None:
        """Say why each scan is alone.
        `names`: of all scans. `alone`: the reasons by the number of the scan, in words after its name."""
        super().__init__(*(f"{names[number]}: {words}" for number, words in alone.items()))
        self.alone, self.pairs = alone, pairs


def register_by(work: ScanWork, names: Sequence[str], extents: Sequence[float], starts: Sequence[np.ndarray | None],
                options: RegistrationOptions, *, table: Turntable | None = None, targets: Mapping[int, Sequence[Target]] | None = None,
                advance: Advance = lambda done: None) -> Registration:
    """Find the poses of scans of one object, whose names are for messages.
    `extents`: of the scans, as `extent_of` returns it. `starts`: world_from_scan [4, 4] of each that is right to about a cell of the rough
    scale and some degrees; None: nothing is known. `table`: the turntable, if its axis is right and only the angles are to be found.
    `targets`: the targets that each scan shows. None: there are none. `advance`: told how far the work is, from 0 to 1."""
    count = len(names)
    cells = dict(cells_of(extents, starts, options.cell_m))
    usual = usual_extent(extents)
    outlines = work.outlines(cells, lambda done: advance(0.15 * done))

    def registered(tasks: Sequence[PairTask], least: float, most: float) -> dict[tuple[int, int], Pair]:
        done = work.pairs(tasks, cells, options.least_overlap, lambda part: advance(least + (most - least) * part))
        return {(pair.a, pair.b): pair for pair in done}

    shown = {number: given for number, given in (targets or {}).items() if given}
    targeted = pairs_by_targets({number: shown[number] for number in shown if number in cells}, work.ready)
    pairs = _first_pairs(outlines, starts, targeted, count, options, registered)
    targeted = {ab: pair if pair.fit is None else against_surfaces(pair, pairs.get(ab), work.ready) for ab, pair in targeted.items()}

    def solve_all() -> tuple[Solved | None, list[Pair]]:
        return _solved(count, [*pairs.values(), *targeted.values()], starts, options, table)

    solved, kept = solve_all()
    started = options.starts_decide and all(starts[number] is not None for number in cells)
    tried: set[tuple[int, int]] = set()
    advance(0.75)
    unlike = _untried(outlines, starts, pairs)
    while True:
        for _ in range(ROUNDS):
            found = _predicted(outlines, pairs, tried, solved, count, options, registered)
            if not found:
                break
            pairs |= found
            solved, kept = solve_all()
        told = any(pair.fit is not None for pair in targeted.values()) or started  # by what tells a body from its turned self
        doubted = wrongly_joined(solved.poses, kept, work.ready) if solved is not None and count <= ALL_PAIRS and not told else {}
        if not doubted and solved is not None and not options.accept_alike:
            doubted = open_pairs(solved.poses, [*pairs.values()], len(cells))
        if doubted:
            pairs |= doubted
            solved, kept = solve_all()
            continue
        further = most_alike(unlike, _groups(count, [*pairs.values(), *targeted.values()]))
        if not further:
            break
        for pair in further:
            del unlike[pair]
        pairs |= registered([PairTask(a, b, None, 0.0, True, options.accept_alike) for a, b in further], 0.75, 0.9)
        solved, kept = solve_all()
    advance(0.9)
    joined = solved.poses if solved is not None else {}
    common = options.cell_m or usual / CELLS_ACROSS
    alike = [number for number in sorted(cells) if cells[number] == common]
    basis = [number for number in alike if number in joined] or alike[:1]
    alone = {}
    for number in sorted(set(range(count)) - set(joined or basis)):
        others = [partial(work.ready, other) for other in sorted(basis, key=lambda other: abs(other - number))]
        ambiguous = any(pair.state is PairState.AMBIGUOUS and number in (pair.a, pair.b) for pair in pairs.values())
        words = None if ambiguous else why_alone(work.scan(number), others, extent=extents[number], others_extent=usual, cell_m=common,
                                                  least_overlap=options.least_overlap)  # what looks alike turned does so mirrored
        words = words or refusal(number, names, pairs.values(), starts[number] is not None and not options.starts_decide)
        alone[number] = words + refused_targets(number, names, shown, targeted.values())
    advance(1.0)
    if solved is None:
        raise NoneJoinedError(names, alone, (*pairs.values(), *targeted.values()))
    if options.reference is not None and options.reference not in joined:
        raise NoneJoinedError(names, {options.reference: f"is the reference, but {alone[options.reference]}"},
                              (*pairs.values(), *targeted.values()))
    free = [number for number in joined if starts[number] is None and number not in shown] if table is None else []
    turned = tuple(number for number in free if looks_alike_turned(work.ready(number), cells[number]))
    spread = covariances(solved, kept, [edge_of(pair) for pair in kept],
                         lambda pair: rows_of(pair) if pair.by is Evidence.TARGETS else work.rows(pair))
    return Registration(joined, spread, _reference(joined, starts, options), (*pairs.values(), *targeted.values()), alone,
                        odd_scales(kept, list(joined)), tuple(zip(kept, map(float, solved.weights), strict=True)), solved.factor, common,
                        tuple(target_places(shown, joined, spread)), turned)


Registered = Callable[[Sequence[PairTask], float, float], dict[tuple[int, int], Pair]]
"""Registers pairs; its numbers say between which parts of the whole work."""


def _first_pairs(outlines: dict[int, Outline], starts: Sequence[np.ndarray | None], targeted: dict[tuple[int, int], Pair], count: int,
                 options: RegistrationOptions, registered: Registered) -> dict[tuple[int, int], Pair]:
    """Return pairs by surfaces: from the pose of their targets, or the starts of both scans where they overlap there, else searched, if
    there are few scans."""
    known = {number: start for number in outlines if (start := starts[number]) is not None}
    overlaps = Overlaps(outlines, known, START_CELLS)
    near = set(overlapping(known, overlaps, options.least_overlap, count=count, wanted=lambda a, b: True))
    tasks, pairs = [], {}
    for a, b in combinations(sorted(outlines), 2):
        first, second = known.get(a), known.get(b)
        if (a, b) in targeted and (fit := targeted[a, b].fit) is not None:
            tasks.append(PairTask(a, b, fit.pose, START_CELLS, True, options.accept_alike))
        elif first is None or second is None:
            if count <= ALL_PAIRS:
                tasks.append(PairTask(a, b, None, 0.0, True, options.accept_alike))
        elif (a, b) in near:
            tasks.append(PairTask(a, b, inverse(first) @ second, START_CELLS, count <= ALL_PAIRS, options.accept_alike,
                                  options.starts_decide, start_is_rough=True))
        elif count <= ALL_PAIRS:
            pairs[a, b] = Pair(a, b, PairState.NO_POSE, None, 0.0, 0.0, NOT_THERE)
    pairs |= registered(tasks, 0.15, 0.75)
    return {pair: pairs[pair] for pair in sorted(pairs)}


def _untried(outlines: dict[int, Outline], starts: Sequence[np.ndarray | None], pairs: dict[tuple[int, int], Pair]
             ) -> dict[tuple[int, int], float]:
    """Return how unlike scans of pairs are that can be searched and were not."""
    if all(starts[number] is not None for number in outlines):
        return {}
    return {(a, b): unlike for (a, b), unlike in likeness(outlines).items()
            if (a, b) not in pairs and (starts[a] is None or starts[b] is None)}


def _groups(count: int, pairs: Sequence[Pair]) -> dict[int, int]:
    """Return the group of each scan, of those that pairs join."""
    groups = joined_groups(count, [pair for pair in pairs if pair.state is PairState.JOINED])
    return {number: place for place, members in enumerate(groups) for number in members}


def _predicted(outlines: dict[int, Outline], pairs: dict[tuple[int, int], Pair], tried: set[tuple[int, int]], solved: Solved | None,
               count: int, options: RegistrationOptions, registered: Registered) -> dict[tuple[int, int], Pair]:
    """Return further joined pairs, of scans that overlap at the poses that were found; add those that were tried to `tried`."""
    if solved is None:
        return {}
    poses = solved.poses

    def wanted(a: int, b: int) -> bool:
        pair = pairs.get((a, b))
        return (pair is None or pair.state is not PairState.JOINED) and (a, b) not in tried

    near = overlapping(poses, Overlaps(outlines, poses, NEAR_CELLS), options.least_overlap, count=count, wanted=wanted)
    if count > ALL_PAIRS:
        joined = [number for pair in pairs.values() if pair.state is PairState.JOINED for number in (pair.a, pair.b)]
        near = [(a, b) for a, b in near if min(joined.count(a), joined.count(b)) < PARTNERS // 2]
    found = registered([PairTask(a, b, inverse(poses[a]) @ poses[b], NEAR_CELLS, False) for a, b in near], 0.75, 0.9)
    tried |= {numbers for numbers, pair in found.items() if pair.reason != NOT_THERE}
    return {numbers: pair for numbers, pair in found.items() if pair.state is PairState.JOINED}


def _solved(count: int, pairs: Sequence[Pair], starts: Sequence[np.ndarray | None], options: RegistrationOptions,
            table: Turntable | None) -> tuple[Solved | None, list[Pair]]:
    """Return the poses of the largest group of scans that pairs join without contradiction, and these pairs; None where none are joined."""
    joined = [pair for pair in pairs if pair.state is PairState.JOINED]
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
            poses = {number: table.pose_at(table.angle_of(pose)) for number, pose in poses.items()}
            ways = {number: table.freedom() for number in poses}
            if table.angle_sigma_deg > 0 and table.angles_deg is not None:
                poses = {number: table.pose_at(table.angles_deg[number]) for number in poses}
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
