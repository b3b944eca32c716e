"""Pairs of scans by their common targets, beside those by their surfaces; and targets that lie elsewhere in one scan than in the others."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from service.scans.points.rigid import about, applied, inverse, moved, rigid_between, step_between
from service.scans.points.scan import Target
from service.scans.registration.fine import Fit, Rows
from service.scans.registration.free_space import contradiction
from service.scans.registration.pairs import Evidence, Pair, PairState, Prepared, is_contradicted
from stage.spread import MAD_TO_SIGMA
from stage.transforms import cross_matrix

DISTANCE_SIGMAS = 4.0
"""Targets keep a distance if it differs between two scans by no more than this many standard deviations."""
LEAST_TARGETS = 3
"""The fewest targets that determine a pose, if they are not in a line."""
LEAST_WIDTH_SIGMAS = 10.0
"""Targets are in a line if they lie no further off it than this many standard deviations: the turn about it would be less sure than 6°."""
STEPS = 6
"""Steps of Gauss and Newton: targets are few, and their first pose is near."""


class TargetPose(NamedTuple):
    """The pose of two scans from their common targets."""

    common: tuple[str, ...]
    state: PairState
    fit: Fit | None
    """The pose a_from_b; None: the targets determine none."""
    used: tuple[str, ...]
    """The targets that keep their distances."""
    reason: str
    """The reason why there is no pose, in words; empty where there is one."""


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


# Named targets that several scans show: the pose of a pair by them, and which of them do not keep their distances.
#
# Between two scans a rigid motion keeps the distance of any two targets. The largest set of targets that keep all their distances within
# their standard deviations gives the pose; the others moved, or have another's name. Source of such sets: Bailey, Nebot, Rosenblatt and
# Durrant-Whyte, "Data association for mobile robot navigation: a graph theoretic approach", ICRA 2000.

def pose_by_targets(a: Sequence[Target], b: Sequence[Target], *, first_row: tuple[int, int]) -> TargetPose:
    """Find the pose of scan b against scan a by the targets that both show.
    `first_row`: from which number on `Rows.at` and `Rows.of` count the targets, 3 numbers each, in the order of a and of b, so that the
    covariance of a pose graph tells them from points of the surface."""
    place = {target.name: number for number, target in enumerate(b)}
    pairs = [(number, place[target.name]) for number, target in enumerate(a) if target.name in place]
    common = tuple(a[i].name for i, _ in pairs)
    if len(pairs) < LEAST_TARGETS:
        return TargetPose(common, PairState.LITTLE_OVERLAP, None, (), f"they have only {len(pairs)} targets in common "
                          f"({', '.join(common)}): {LEAST_TARGETS} that are not in a line are needed")
    at, of = np.array(pairs).T
    points_a, points_b = (np.array([given[i].position for i in index]) for given, index in ((a, at), (b, of)))
    spread_a, spread_b = (np.array([given[i].covariance for i in index]) for given, index in ((a, at), (b, of)))
    sigma = np.sqrt((np.trace(spread_a, axis1=1, axis2=2) + np.trace(spread_b, axis1=1, axis2=2)) / 3)
    kept = np.array(_keeping(points_a, points_b, sigma), dtype=np.int64)
    if len(kept) < LEAST_TARGETS or 2 * len(kept) <= len(common):
        return TargetPose(common, PairState.MISFIT, None, (), _disagreement(common, points_a, points_b, sigma))
    width = np.linalg.svd(points_a[kept] - points_a[kept].mean(axis=0), compute_uv=False)[1] / np.sqrt(len(kept))
    used = tuple(common[k] for k in kept)
    if width < LEAST_WIDTH_SIGMAS * float(np.median(sigma[kept])):
        return TargetPose(common, PairState.LITTLE_OVERLAP, None, (), f"their common targets ({', '.join(used)}) lie in a line: the turn "
                          "about it is not determined")
    found = _fit(points_a[kept], points_b[kept], spread_a[kept], spread_b[kept], first_row[0] + 3 * at[kept], first_row[1] + 3 * of[kept])
    if found is None:
        return TargetPose(common, PairState.MISFIT, None, (), f"their common targets ({', '.join(used)}) fit each other mirrored alone: "
                          "check the axes of their coordinates")
    return TargetPose(common, PairState.JOINED, found, used, "")


def _keeping(points_a: np.ndarray, points_b: np.ndarray, sigma: np.ndarray) -> list[int]:
    """Return the largest set of targets that keep all their distances, by a greedy search; of several as large, what they share."""
    off = np.abs(_distances(points_a) - _distances(points_b))
    keep = off < DISTANCE_SIGMAS * np.hypot(sigma[:, None], sigma[None])
    np.fill_diagonal(keep, False)
    order = np.argsort(-keep.sum(axis=1), kind="stable")
    sets: set[frozenset[int]] = set()
    for seed in range(len(keep)):
        chosen, allowed = [seed], keep[seed].copy()
        for number in order:
            if allowed[number]:
                chosen.append(int(number))
                allowed &= keep[number]
        sets.add(frozenset(chosen))
    most = max(map(len, sets))
    largest = [chosen for chosen in sets if len(chosen) == most]
    together = frozenset.intersection(*largest)
    return sorted(largest[0]) if len(largest) == 1 else sorted(together)


def _distances(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points[None], axis=-1)


def _disagreement(common: tuple[str, ...], points_a: np.ndarray, points_b: np.ndarray, sigma: np.ndarray) -> str:
    """Return in words that targets do not keep their distances: by how much, and whether one scale explains it."""
    upper = np.triu_indices(len(common), 1)
    in_a, in_b = _distances(points_a)[upper], _distances(points_b)[upper]
    allowed = DISTANCE_SIGMAS * np.hypot(sigma[:, None], sigma[None])[upper]
    ratio = float(np.median(in_a / np.maximum(in_b, 1e-30)))
    words = (f"their {len(common)} common targets do not keep their distances, which differ by up to "
             f"{1e3 * np.abs(in_a - in_b).max():.3g} mm where σ allows {1e3 * float(np.median(allowed)):.2g} mm: targets moved, have the "
             "names of others, or σ is too small")
    if abs(ratio - 1) > 1e-3 and (np.abs(in_a - ratio * in_b) < allowed * max(ratio, 1)).all():
        words += f"; they keep them if the second scan is {ratio:.4g} times as large: check its unit or scale"
    return words


def _fit(points_a: np.ndarray, points_b: np.ndarray, spread_a: np.ndarray, spread_b: np.ndarray, rows_a: np.ndarray, rows_b: np.ndarray
         ) -> Fit | None:
    """Return the pose that brings targets together, weighted by both covariances; None if only a mirrored one does."""
    pose = rigid_between(points_b[None], points_a[None], np.ones((1, len(points_a))))[0]
    pivot = points_a.mean(axis=0)
    for _ in range(STEPS):
        jacobian, weight, off = _equations(pose, pivot, points_a, points_b, spread_a, spread_b)
        normal = np.einsum("nik,nij,njl->kl", jacobian, weight, jacobian)
        step = -np.linalg.solve(normal, np.einsum("nik,nij,nj->k", jacobian, weight, off))
        pose = moved(step, pivot, pose)
    jacobian, weight, off = _equations(pose, pivot, points_a, points_b, spread_a, spread_b)
    squared = np.einsum("ni,nij,nj->n", off, weight, off)
    if np.median(squared) > 3 * DISTANCE_SIGMAS**2:
        return None
    normal = np.einsum("nik,nij,njl->kl", jacobian, weight, jacobian)
    ratio = float(np.sqrt(squared.sum() / (3 * len(points_a) - 6)))
    grow = applied(pose, points_b) - pivot
    cross = np.einsum("nik,nij,nj->k", jacobian, weight, grow)
    left = float(np.einsum("ni,nij,nj->", grow, weight, grow) - cross @ np.linalg.solve(normal, cross))
    scale = -float(np.einsum("ni,nij,nj->", grow, weight, off)) / left
    pulls = np.einsum("nik,nij->njk", jacobian, weight)  # of the three coordinates of each target
    turn = pose[:3, :3]
    roots_a, roots_b = np.linalg.cholesky(spread_a), turn @ np.linalg.cholesky(spread_b)
    gradient = np.concatenate([np.einsum("njk,njm->nmk", pulls, root).reshape(-1, 6) for root in (roots_a, roots_b)])
    at, of = ((rows[:, None] + np.arange(3)).ravel() for rows in (rows_a, rows_b))
    one, none = np.ones(len(at), dtype=np.float32), np.zeros(len(at), dtype=np.float32)
    rows = Rows(np.concatenate([at, at]), np.concatenate([of, of]), gradient.astype(np.float32), np.concatenate([one, none]),
                np.concatenate([none, one]))
    wide = max(ratio, 1.0) ** 2
    return Fit(pose=pose, pivot=pivot, doubt=np.zeros((0, 6)), information=normal / wide, normal=normal, noise=np.zeros((6, 6)),
               bend=np.zeros((6, 6)), even_bend=np.zeros((6, 6)), residual=MAD_TO_SIGMA * float(np.median(np.abs(off))), ratio=ratio,
               together=1.0, scale=scale,
               scale_sigma=float(np.sqrt(wide / left)), rows=rows, matches=len(points_a))


def _equations(pose: np.ndarray, pivot: np.ndarray, points_a: np.ndarray, points_b: np.ndarray, spread_a: np.ndarray, spread_b: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the derivatives [n, 3, 6], the weights [n, 3, 3] and the differences [n, 3] of targets at a pose."""
    placed, turn = applied(pose, points_b), pose[:3, :3]
    jacobian = np.stack([np.concatenate([-cross_matrix(point - pivot), np.eye(3)], axis=1) for point in placed])
    return jacobian, np.linalg.inv(spread_a + turn @ spread_b @ turn.T), placed - points_a
