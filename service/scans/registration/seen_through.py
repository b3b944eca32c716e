"""Poses of many scans against what each camera saw through: of pairs that join scans wrongly, those that put scans elsewhere tell.

A body that looks alike turned joins a scan to its turned neighbour where what sticks out is in neither picture, and several such pairs
close loops. Scans further apart then have parts of the surface where the other camera saw through.
"""

from collections.abc import Callable, Iterable, Sequence
from itertools import combinations, product

import numpy as np

from service.scans.points.rigid import inverse
from service.scans.registration.free_space import contradiction
from service.scans.registration.pairs import BEFORE_SETS, SEEN_THROUGH, Pair, PairState, Prepared
from service.scans.registration.pose_graph import worths

REASON = "so joined, other scans would have parts where a camera saw through"
ALIKE = "both fit scans that would be seen through so: the object looks alike turned, and nothing tells which of them are turned"


def seen_through(a: Prepared, b: Prepared, pose: np.ndarray) -> bool:
    """Return whether one of two scans has parts of its surface where the camera of the other saw through, at a pose a_from_b that the
    poses of other pairs add up to: single points, which such a pose may bring before a surface, do not count."""
    against = contradiction(a.image, b.image, a.fine, b.fine, pose, max(a.spacing, b.spacing))
    return against.surface > SEEN_THROUGH or against.before_sets > BEFORE_SETS


def any_seen_through(poses: dict[int, np.ndarray], pairs: Iterable[tuple[int, int]], ready: Callable[[int], Prepared]) -> bool:
    """Return whether the scans of any pair are seen through.
    `poses`: world_from_scan of each. `ready`: returns a scan."""
    return any(seen_through(ready(a), ready(b), inverse(poses[a]) @ poses[b]) for a, b in pairs)


def doubted_scans(poses: dict[int, np.ndarray], pairs: Iterable[Pair]) -> set[int]:
    """Return the scans with a pose that also fit scans without one, from which cameras would see through them: they may be turned."""
    return {number for pair in pairs if pair.reason == REASON for number in (pair.a, pair.b)
            if number in poses and not {pair.a, pair.b} <= set(poses)}


def open_pairs(poses: dict[int, np.ndarray], pairs: Sequence[Pair], count: int) -> dict[tuple[int, int], Pair]:
    """Return the joined pairs of doubted scans as ambiguous ones, if less than half of `count` scans have a pose: where most have one, they
    tell that it is the scan without one that is turned."""
    doubted = doubted_scans(poses, pairs) if 2 * len(poses) < count else set()
    return {(pair.a, pair.b): pair._replace(state=PairState.AMBIGUOUS, reason=ALIKE) for pair in pairs
            if pair.state is PairState.JOINED and {pair.a, pair.b} <= set(poses) and {pair.a, pair.b} & doubted}


def wrongly_joined(poses: dict[int, np.ndarray], pairs: Sequence[Pair], ready: Callable[[int], Prepared]) -> dict[tuple[int, int], Pair]:
    """Return the joined pairs that poses of scans rest on and that put groups of them together wrongly, as contradicted ones; none where
    no camera saw through any other scan.

    Groups grow by the pairs with the most agreeing loops and matches first, unless scans of both would be seen through. Pairs within a
    group are left to the weights of the loops.
    """
    if not any_seen_through(poses, combinations(poses, 2), ready):
        return {}
    worth = worths(pairs)
    groups: dict[int, dict[int, np.ndarray]] = {}
    found = {}
    for pair in sorted(pairs, key=lambda pair: -worth[pair.a, pair.b]):
        assert pair.fit is not None
        one, two = (groups.setdefault(number, {number: np.eye(4)}) for number in (pair.a, pair.b))
        if one is two:
            continue
        step = one[pair.a] @ pair.fit.pose @ inverse(two[pair.b])
        moved = {number: step @ pose for number, pose in two.items()}
        if any_seen_through(one | moved, product(one, moved), ready):
            found[pair.a, pair.b] = pair._replace(state=PairState.CONTRADICTED, reason=REASON)
        else:
            one |= moved
            groups |= dict.fromkeys(moved, one)
    return found
