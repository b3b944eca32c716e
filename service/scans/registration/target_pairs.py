"""Pairs of scans by their common targets, beside those by their surfaces; and targets that lie elsewhere in one scan than in the others."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from service.scans.points.rigid import about, applied, inverse, step_between
from service.scans.points.scan import Target
from service.scans.registration.free_space import contradiction
from service.scans.registration.pairs import Evidence, Pair, PairState, Prepared, is_contradicted
from service.scans.registration.targets import pose_by_targets
from stage.transforms import cross_matrix

WRONG_SIGMAS = 5.0
"""Targets contradict surfaces, or other scans, beyond this many standard deviations in each coordinate."""
LEAST_TURN = 1e-4
"""A turn by less than this, radians, is no contradiction; nor a shift by less than this part of the distance of the targets."""


class TargetPlace(NamedTuple):
    """The place of a target, as all scans say that show it."""

    name: str
    scans: tuple[int, ...]
    """The scans with a pose that agree about its place."""
    position: np.ndarray | None  # [3] metres, world; None: no place is shown by more scans than others are
    sigma_m: float  # root of the sum of the variances along the axes
    wrong: dict[int, float]
    """The scans that show it elsewhere, and how far from there, metres; without a place, from the nearest other scan."""
    same_as: dict[int, str]
    """The target at whose place a scan shows this one."""


def pairs_by_targets(shown: Mapping[int, Sequence[Target]], ready: Callable[[int], Prepared]) -> dict[tuple[int, int], Pair]:
    """Return the pairs of scans that have targets in common."""
    points = {number: len(ready(number).fine.points) for number in shown}
    found = {}
    for a, b in combinations(sorted(shown), 2):
        given = pose_by_targets(shown[a], shown[b], first_row=(points[a], points[b]))
        if given.common:
            found[a, b] = Pair(a, b, given.state, given.fit, len(given.used) / len(given.common), 0.0, given.reason, Evidence.TARGETS)
    return found


def against_surfaces(pair: Pair, surface: Pair | None, ready: Callable[[int], Prepared]) -> Pair:
    """Return a pair with a pose by targets, refused if the surfaces of the two scans, where they were tried, contradict it."""
    assert pair.fit is not None
    if surface is not None and surface.state is PairState.JOINED and surface.fit is not None:
        step = step_between(pair.fit.pose @ inverse(surface.fit.pose), pair.fit.pivot)
        along = about(pair.fit.pivot - surface.fit.pivot)
        spread = np.linalg.inv(pair.fit.information) + along @ np.linalg.inv(surface.fit.information) @ along.T
        shift, turn = float(np.linalg.norm(step[3:])), float(np.linalg.norm(step[:3]))
        if step @ np.linalg.solve(spread, step) > 6 * WRONG_SIGMAS**2 and (
                turn > LEAST_TURN or shift > LEAST_TURN * float(np.linalg.norm(pair.fit.pivot))):
            return pair._replace(state=PairState.CONTRADICTED, reason=(
                f"the targets ask for a pose that is {1e3 * shift:.3g} mm and {np.degrees(turn):.2g}° from that of the surfaces, which "
                "counts: they moved together against the object, or their σ is too small"))
        return pair
    a, b = ready(pair.a), ready(pair.b)
    spacing = max(a.spacing, b.spacing)
    against = contradiction(a.image, b.image, a.fine, b.fine, pair.fit.pose, spacing)
    if is_contradicted(against):
        return pair._replace(state=PairState.CONTRADICTED, contradicted=against.points, reason=(
            f"at the pose of their targets {against.points:.1%} of the points in sight lie where the other camera saw through"))
    return pair


def target_places(shown: Mapping[int, Sequence[Target]], poses: Mapping[int, np.ndarray], covariances: Mapping[int, np.ndarray]
                  ) -> list[TargetPlace]:
    """Return where each target is that two or more scans with a pose show, and the scans that show it elsewhere.

    A scan without a covariance has an exact pose.

    Convention:
        A place counts if more than half of the scans agree about it within their standard deviations.
    """
    seen: dict[str, list[tuple[int, np.ndarray, np.ndarray]]] = defaultdict(list)
    for number in sorted(shown.keys() & poses.keys()):
        pose = poses[number]
        for target in shown[number]:
            point = applied(pose, target.position[None])[0]
            spread = pose[:3, :3] @ target.covariance @ pose[:3, :3].T
            if number in covariances:
                motion = np.concatenate([-cross_matrix(point - pose[:3, 3]), np.eye(3)], axis=1)
                spread = spread + motion @ covariances[number] @ motion.T
            seen[target.name].append((number, point, spread))
    places = [_place(name, found) for name, found in seen.items() if len(found) > 1]
    known = [(place.name, place.position, place.sigma_m) for place in places if place.position is not None]
    for place in places:
        for number, point, spread in seen[place.name]:
            if number in place.wrong:
                near = [(float(np.linalg.norm(point - position)), name) for name, position, sigma in known if name != place.name
                        and np.linalg.norm(point - position) < WRONG_SIGMAS * np.hypot(sigma, np.sqrt(np.trace(spread)))]
                if near:
                    place.same_as[number] = min(near)[1]
    return places


def _place(name: str, shown: list[tuple[int, np.ndarray, np.ndarray]]) -> TargetPlace:
    points = np.array([point for _, point, _ in shown])
    apart = points[:, None] - points[None]
    spread = np.array([[one + other for _, _, other in shown] for _, _, one in shown])
    agree = np.einsum("abi,abij,abj->ab", apart, np.linalg.inv(spread), apart) < 3 * WRONG_SIGMAS**2
    members = agree[int(np.argmax(agree.sum(axis=1)))]
    away = np.linalg.norm(apart, axis=-1)
    if 2 * np.count_nonzero(members) <= len(shown):
        np.fill_diagonal(away, np.inf)
        return TargetPlace(name, (), None, 0.0, {number: float(away[k].min()) for k, (number, _, _) in enumerate(shown)}, {})
    weights = np.linalg.inv(np.array([each for _, _, each in shown])[members])
    total = np.linalg.inv(weights.sum(axis=0))
    position = total @ np.einsum("nij,nj->i", weights, points[members])
    numbers = [number for number, _, _ in shown]
    wrong = {numbers[k]: float(np.linalg.norm(points[k] - position)) for k in np.flatnonzero(~members)}
    return TargetPlace(name, tuple(numbers[k] for k in np.flatnonzero(members)), position, float(np.sqrt(np.trace(total))), wrong, {})
