"""Poses of many scans from the poses of pairs, with weights that take from pairs what the loops of the others contradict.

The cost of a pair is μ r² / (μ + r²) with r² the squared Mahalanobis distance of its pose (Geman and McClure), and μ shrinks from where all
pairs count alike. Source: Yang, Antonante, Tzoumas and Carlone, "Graduated non-convexity for robust spatial perception", IEEE Robotics and
Automation Letters 5(2), 2020.
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from service.scans.points.rigid import about, applied, inverse, screwed, step_between
from service.scans.registration.pairs import Pair

SHRINK = 1.6
"""Factor by which μ shrinks from round to round."""
STEPS = 4
"""Steps of Gauss and Newton in each round."""
LAST_STEPS = 12
"""Steps without the pairs that are refused."""
OUTLIER = 5.0
"""The misfit of a pair, in standard deviations of what the others leave, from which it loses its weight."""
MANY = 240
"""Unknowns from which on normal equations are solved without a singular value decomposition: that of 200 scans takes seconds a step."""
REFUSED = 0.25
"""A pair with a smaller weight contradicts the others."""
CLOSED_DEGREES = 3.0
"""The largest turn that is left of a loop of three pairs that agree."""
CLOSED_PART = 0.03
"""The largest shift that is left of such a loop, as a part of the distance of the camera."""


class Edge(NamedTuple):
    """The pose of scan b against scan a with its information."""

    a: int
    b: int
    pose: np.ndarray  # [4, 4] a_from_b
    pivot: np.ndarray  # [3] metres, frame of a
    information: np.ndarray  # [6, 6] about the pivot, frame of a


class Solved(NamedTuple):
    """The poses that fit the pairs best."""

    poses: dict[int, np.ndarray]  # world_from_scan of each scan of the graph
    weights: np.ndarray  # [edge] 0…1; 0 of pairs that the others contradict
    factor: float
    """Standard deviation of what the loops leave of the pairs, in units of what their information says; NaN without loops."""
    hessian: np.ndarray  # [6n, 6n] of small motions about the centre, for the scans in the order of `poses`
    basis: np.ndarray  # [6n, k] the ways in which the graph may move
    held: np.ndarray  # [k, k] information of the priors
    centre: np.ndarray  # [3] metres, world


def solve(edges: Sequence[Edge], start: dict[int, np.ndarray], *, fixed: int, freedoms: dict[int, np.ndarray] | None = None,
          priors: dict[int, np.ndarray] | None = None) -> Solved:
    """Find the poses of all scans of a connected graph.

    Args:
        start: world_from_scan [4, 4] of every scan.
        fixed: the scan whose pose stays.
        freedoms: [6, k] of each scan that may move in k ways alone: small motions of rotation vector and translation about the origin of
            the world; scans that are not named move freely. None: all do.
        priors: [k, k] information on each such motion against the start, of scans of `freedoms`.
    """
    poses = dict(start)
    order = list(poses)
    centre = np.mean([applied(poses[edge.a], edge.pivot[None])[0] for edge in edges], axis=0)
    basis = _basis(order, fixed, freedoms or {}, centre)
    held = _held(order, basis, priors or {}, freedoms or {})
    held_by = np.linalg.pinv(basis)
    squared, floor = _misfits(edges, poses), 6 * OUTLIER**2
    scale = _scale(squared)
    bound = max(float(squared.max()) / scale**2, floor)

    def improve(weights: np.ndarray) -> None:
        system, gradient = _system(edges, poses, order, weights / scale**2, centre)
        moved = np.concatenate([step_between(poses[number] @ inverse(start[number]), centre) for number in order])
        pull = basis.T @ gradient + held @ held_by @ moved
        step = -basis @ _least_squares(basis.T @ system @ basis + held, pull)
        for k, number in enumerate(order):
            poses[number] = screwed(step[6 * k:6 * k + 6], centre, poses[number])

    while True:
        for _ in range(STEPS):
            improve((bound / (bound + squared / scale**2)) ** 2)
            squared = _misfits(edges, poses)
        scale = _scale(squared)
        if bound <= floor:
            break
        bound = max(bound / SHRINK**2, floor)
    for _ in range(LAST_STEPS):  # refused pairs neither pull any longer nor widen the scale
        weights = (floor / (floor + squared / scale**2)) ** 2
        weights = np.where(weights > REFUSED, weights, 0.0)
        improve(weights)
        squared = _misfits(edges, poses)
        scale = _scale(squared[weights > 0]) if (weights > 0).any() else scale
    hessian, _ = _system(edges, poses, order, weights, centre)
    used = weights > 0
    loops = 6 * int(used.sum()) - np.linalg.matrix_rank(basis)
    factor = float(np.sqrt(squared[used].sum() / loops)) if loops > 0 else float("nan")
    return Solved(poses, weights, factor, hessian, basis, held, centre)


def adjoint(edge: Edge, pose_a: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return what a small motion about the centre does at the pivot of a pair, in the frame of its scan a: [6, 6]."""
    turn = np.kron(np.eye(2), pose_a[:3, :3].T)
    return turn @ about(applied(pose_a, edge.pivot[None])[0] - centre)


def _least_squares(matrix: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Solve normal equations, which may be singular; those of many scans are not, unless Cholesky's factors do not exist."""
    if len(matrix) > MANY:
        try:
            np.linalg.cholesky(matrix)
            return np.asarray(np.linalg.solve(matrix, wanted))
        except np.linalg.LinAlgError:
            pass
    return np.asarray(np.linalg.lstsq(matrix, wanted, rcond=1e-13)[0])


def _basis(order: list[int], fixed: int, freedoms: dict[int, np.ndarray], centre: np.ndarray) -> np.ndarray:
    columns = []
    for k, number in enumerate(order):
        if number == fixed:
            continue
        own = np.eye(6) if number not in freedoms else np.array(freedoms[number], dtype=np.float64)
        if number in freedoms:  # from the origin of the world to the centre
            own[3:] += np.cross(own[:3].T, centre).T
        block = np.zeros((6 * len(order), own.shape[1]))
        block[6 * k:6 * k + 6] = own
        columns.append(block)
    return np.concatenate(columns, axis=1) if columns else np.zeros((6 * len(order), 0))


def _held(order: list[int], basis: np.ndarray, priors: dict[int, np.ndarray], freedoms: dict[int, np.ndarray]) -> np.ndarray:
    out = np.zeros((basis.shape[1], basis.shape[1]))
    for k, number in enumerate(order):
        if number in priors and number in freedoms:
            columns = np.flatnonzero(np.abs(basis[6 * k:6 * k + 6]).sum(axis=0) > 0)
            if columns.size:
                out[np.ix_(columns, columns)] = priors[number]
    return out


def _misfits(edges: Sequence[Edge], poses: dict[int, np.ndarray]) -> np.ndarray:
    """Return the squared Mahalanobis distance of each pair."""
    return np.array([step @ edge.information @ step for edge in edges for step in [_misfit(edge, poses)]])


def _misfit(edge: Edge, poses: dict[int, np.ndarray]) -> np.ndarray:
    """Return the motion [6] at the pivot, frame of a, by which the poses differ from the pair: of scan b against its place in the pair."""
    return step_between(inverse(poses[edge.a]) @ poses[edge.b] @ inverse(edge.pose), edge.pivot)


def _system(edges: Sequence[Edge], poses: dict[int, np.ndarray], order: list[int], weights: np.ndarray, centre: np.ndarray
            ) -> tuple[np.ndarray, np.ndarray]:
    place = {number: 6 * k for k, number in enumerate(order)}
    system, gradient = np.zeros((6 * len(order), 6 * len(order))), np.zeros(6 * len(order))
    for edge, weight in zip(edges, weights, strict=True):
        jacobian = adjoint(edge, poses[edge.a], centre)
        information = weight * jacobian.T @ edge.information @ jacobian
        pull = weight * jacobian.T @ edge.information @ _misfit(edge, poses)
        for one, sign in ((edge.a, -1), (edge.b, 1)):
            i = place[one]
            gradient[i:i + 6] += sign * pull
            for other, turn in ((edge.a, -1), (edge.b, 1)):
                j = place[other]
                system[i:i + 6, j:j + 6] += sign * turn * information
    return system, gradient


def _scale(squared: np.ndarray) -> float:
    """Return the robust standard deviation of the misfits, at least 1: the median of χ² with six degrees of freedom is 5.35."""
    return max(1.0, float(np.sqrt(np.median(squared) / 5.35)))


def joined_groups(count: int, pairs: Iterable[Pair]) -> list[set[int]]:
    """Return the groups of scans that pairs join, the largest first; of equal groups the one with the first scan."""
    first, second = np.array([(pair.a, pair.b) for pair in pairs], dtype=np.int64).reshape(-1, 2).T
    found, group = connected_components(coo_array((np.ones(len(first)), (first, second)), shape=(count, count)), directed=False)
    groups = [set(np.flatnonzero(group == number).tolist()) for number in range(found)]
    return sorted(groups, key=lambda members: (-len(members), min(members)))


def _relative(pairs: Sequence[Pair]) -> dict[tuple[int, int], np.ndarray]:
    """Return the poses [4, 4] of joined pairs by both orders of their scans."""
    relative = {}
    for pair in pairs:
        assert pair.fit is not None
        relative[pair.a, pair.b], relative[pair.b, pair.a] = pair.fit.pose, inverse(pair.fit.pose)
    return relative


def worths(pairs: Sequence[Pair]) -> dict[tuple[int, int], float]:
    """Return what joined pairs are worth, by both orders of their scans: the more loops of three agree, and the more points match."""
    relative = _relative(pairs)
    beside: dict[int, set[int]] = defaultdict(set)
    for a, b in relative:
        beside[a].add(b)
    worth: dict[tuple[int, int], float] = {}
    for pair in pairs:
        assert pair.fit is not None
        loops = [_closed(relative[pair.a, pair.b], relative[pair.b, third], relative[third, pair.a], pair.fit.pivot)
                 for third in beside[pair.a] & beside[pair.b]]
        share = (sum(loops) + 0.5) / (len(loops) + 1)
        worth[pair.a, pair.b] = worth[pair.b, pair.a] = share * (1 + sum(loops)) * np.sqrt(pair.fit.matches)
    return worth


def tree_poses(pairs: Sequence[Pair], members: set[int], reference: int, pose: np.ndarray) -> dict[int, np.ndarray]:
    """Return first poses: along the joined pairs that are worth most, from that of the reference."""
    worth, relative = worths(pairs), _relative(pairs)
    poses = {reference: pose}
    while len(poses) < len(members):
        a, b = max(((a, b) for a, b in relative if a in poses and b not in poses), key=lambda ab: (worth[ab], -ab[0], -ab[1]))
        poses[b] = poses[a] @ relative[a, b]
    return {number: poses[number] for number in sorted(poses)}


def _closed(first: np.ndarray, second: np.ndarray, third: np.ndarray, pivot: np.ndarray) -> bool:
    step = step_between(first @ second @ third, pivot)
    return bool(np.degrees(np.linalg.norm(step[:3])) < CLOSED_DEGREES and np.linalg.norm(step[3:]) < CLOSED_PART * np.linalg.norm(pivot))
