"""The covariance of the poses of a pose graph from the noise of every measured point.

A point that several pairs use has one error, so that pairs are not independent: what the noise of each point does to all poses at once is
added up (the sandwich estimator; Huber, "The behavior of maximum likelihood estimates under nonstandard conditions", 1967).
"""

from collections.abc import Callable, Sequence

import numpy as np

from service.scans.points.rigid import about
from service.scans.registration.fine import Rows
from service.scans.registration.pairs import Pair
from service.scans.registration.pose_graph import Edge, Solved, adjoint

BATCH_POINTS = 1 << 14
"""Points of a scan whose shares are in memory at one time."""


def rows_of(pair: Pair) -> Rows:
    """Return the matched points of a pair that has them in memory."""
    assert pair.fit is not None and pair.fit.rows is not None
    return pair.fit.rows


def covariances(solved: Solved, pairs: Sequence[Pair], edges: Sequence[Edge], rows: Callable[[Pair], Rows] = rows_of
                ) -> dict[int, np.ndarray]:
    """Return the covariance of the pose of each scan, by pairs with their fits in the order of the edges that `solved` was found from.

    Returns:
        [6, 6] of each scan: of a small rotation (radians, about the world's axes through the origin of the scan), then of a translation
        (metres, world); 0 of the scan whose pose is fixed. What loops leave beyond the noise of the points multiplies all of them.
    """
    order = list(solved.poses)
    place = {number: 6 * k for k, number in enumerate(order)}
    spread = np.zeros((6 * len(order), 6 * len(order)))
    onto = [_onto(edge, solved, place) for edge in edges]
    for pair, weight, jacobian in zip(pairs, solved.weights, onto, strict=True):
        assert pair.fit is not None
        pull = jacobian.T @ (weight * pair.fit.information @ pair.fit.doubt.T)
        spread += pull @ pull.T
    for number in order:
        of_scan = [k for k, pair in enumerate(pairs) if number in (pair.a, pair.b)]
        if not of_scan:
            continue
        shares = [_shares(pairs[k], number, float(solved.weights[k]), rows(pairs[k])) for k in of_scan]
        square = np.zeros((6 * len(of_scan), 6 * len(of_scan)))
        for first in range(0, 1 + max(int(index.max()) for index, _ in shares), BATCH_POINTS):
            every = np.concatenate([_of_points(first, *share) for share in shares], axis=1)
            square += every.T @ every
        together = np.concatenate([onto[k] for k in of_scan])
        spread += together.T @ square @ together
    basis = solved.basis
    inverse = np.linalg.pinv(basis.T @ solved.hessian @ basis + solved.held, hermitian=True)
    total = basis @ inverse @ (basis.T @ spread @ basis + solved.held) @ inverse @ basis.T
    total *= max(solved.factor, 1.0) ** 2 if np.isfinite(solved.factor) else 1.0
    out = {}
    for number in order:
        shift = about(solved.poses[number][:3, 3] - solved.centre)
        k = place[number]
        own = shift @ total[k:k + 6, k:k + 6] @ shift.T
        out[number] = (own + own.T) / 2
    return out


def _onto(edge: Edge, solved: Solved, place: dict[int, int]) -> np.ndarray:
    """Return what small motions of all scans do at the pivot of a pair, [6, 6n]."""
    out = np.zeros((6, 6 * len(place)))
    jacobian = adjoint(edge, solved.poses[edge.a], solved.centre)
    out[:, place[edge.a]:place[edge.a] + 6] = -jacobian
    out[:, place[edge.b]:place[edge.b] + 6] = jacobian
    return out


def _shares(pair: Pair, number: int, weight: float, rows: Rows) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a scan that a pair uses, [k], and what the noise of each adds to its gradient, [k, 6]."""
    assert pair.fit is not None
    index, sigma = (rows.at, -rows.sigma_a) if number == pair.a else (rows.of, rows.sigma_b)
    onto_graph = weight * pair.fit.information @ np.linalg.pinv(pair.fit.normal, rcond=1e-12, hermitian=True)  # by way of the pair's pose
    return index, (rows.gradient * (sigma * max(pair.fit.ratio, 1.0) * pair.fit.together)[:, None]) @ onto_graph.T


def _of_points(first: int, index: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the sums of the values of each point of a batch, [BATCH_POINTS, 6]; points without any have 0."""
    inside = (index >= first) & (index < first + BATCH_POINTS)
    return np.stack([np.bincount(index[inside] - first, column, minlength=BATCH_POINTS) for column in values[inside].T], axis=1)
