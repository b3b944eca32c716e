"""Groups of scans that pairs join, and first poses along the pairs that agree best with the loops of others."""

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from stage.scans.pairs import Pair
from stage.scans.rigid import inverse, step_between

CLOSED_DEGREES = 3.0
"""The largest turn that is left of a loop of three pairs that agree."""
CLOSED_PART = 0.03
"""The largest shift that is left of such a loop, as a part of the distance of the camera."""


def joined_groups(count: int, pairs: Iterable[Pair]) -> list[set[int]]:
    """Return the groups of scans that pairs join, the largest first; of equal groups the one with the first scan."""
    first, second = np.array([(pair.a, pair.b) for pair in pairs], dtype=np.int64).reshape(-1, 2).T
    found, group = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(count, count)), directed=False)
    groups = [set(np.flatnonzero(group == number).tolist()) for number in range(found)]
    return sorted(groups, key=lambda members: (-len(members), min(members)))


def tree_poses(pairs: Sequence[Pair], members: set[int], reference: int, pose: np.ndarray) -> dict[int, np.ndarray]:
    """Return first poses: along the pairs with the most agreeing loops and the most matches.

    Args:
        pairs: joined pairs between the members, which connect them.
        members: the scans.
        reference: the scan that has `pose`.
        pose: [4, 4] its world_from_scan.
    """
    relative: dict[tuple[int, int], np.ndarray] = {}
    worth: dict[tuple[int, int], float] = {}
    for pair in pairs:
        assert pair.fit is not None
        relative[pair.a, pair.b], relative[pair.b, pair.a] = pair.fit.pose, inverse(pair.fit.pose)
    beside: dict[int, set[int]] = defaultdict(set)
    for a, b in relative:
        beside[a].add(b)
    for pair in pairs:
        assert pair.fit is not None
        loops = [_closed(relative[pair.a, pair.b], relative[pair.b, third], relative[third, pair.a], pair.fit.pivot)
                 for third in beside[pair.a] & beside[pair.b]]
        share = (sum(loops) + 0.5) / (len(loops) + 1)
        worth[pair.a, pair.b] = worth[pair.b, pair.a] = share * (1 + sum(loops)) * np.sqrt(pair.fit.matches)
    poses = {reference: pose}
    while len(poses) < len(members):
        a, b = max(((a, b) for a in poses for b in beside[a] if b not in poses), key=lambda ab: (worth[ab], -ab[0], -ab[1]))
        poses[b] = poses[a] @ relative[a, b]
    return {number: poses[number] for number in sorted(poses)}


def _closed(first: np.ndarray, second: np.ndarray, third: np.ndarray, pivot: np.ndarray) -> bool:
    step = step_between(first @ second @ third, pivot)
    return bool(np.degrees(np.linalg.norm(step[:3])) < CLOSED_DEGREES and np.linalg.norm(step[3:]) < CLOSED_PART * np.linalg.norm(pivot))
