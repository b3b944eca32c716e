"""The pose of one scan against another by the distances between their surfaces, weighted by the σ of every point.

Between the planes of two matched points p and q with normals m and n the distance is (p - q)·(m + n) / |m + n|, which is 0 on any sphere
and not on planes alone (Rusinkiewicz, "A symmetric objective function for ICP", ACM Transactions on Graphics 38(4), 2019). It is the limit
of generalised ICP (Segal, Haehnel and Thrun, "Generalized-ICP", RSS 2009) for covariances that are flat; the variance across the surface is
that of the two points along their lines of sight.
"""

from typing import NamedTuple

import numpy as np

from service.scans.points.cloud import Cloud, cell_numbers
from service.scans.points.neighbours import NearestWithin
from service.scans.points.rigid import applied, moved
from service.scans.registration.coarse import ALIKE
from stage.spread import MAD_TO_SIGMA, tukey_weights

STEPS = 12
"""The most steps at one reach."""
STILL, NEARLY_STILL = 0.1, 0.2
"""Steps end when the scan moves by less than this part of the standard error of the mean distance; at all reaches but the last, of the
standard deviation of the distances."""
FEW = 3000
"""The most points that are matched at all reaches but the last."""
EDGE = 5.0
"""Normals are at an edge if fewer neighbours change them by more than this many times the median. A vase, a figure: next to none."""
BLOCK = 6.0
"""The side of the blocks within which errors may be alike, in distances of neighbouring points."""
LEAST_MATCHES = 30
"""The fewest matches that a pose of six numbers is fitted to."""


class Fit(NamedTuple):
    """A pose and what the distances say of it."""

    pose: np.ndarray  # [4, 4] a_from_b
    pivot: np.ndarray  # [3] metres, frame of a: the mean of the matched points, about which rotations count
    doubt: np.ndarray  # [k, 6] motions about the pivot by which the pose may be wrong beside the noise; `information` is less by them
    information: np.ndarray  # [6, 6] of rotation vector (radians) and translation (metres), frame of a
    normal: np.ndarray  # [6, 6] the matrix of the normal equations of `rows`
    noise: np.ndarray  # [6, 6] the part of it that noise in the normals alone would make
    bend: np.ndarray  # [6, 6] the part that normals would make which are as wrong as the choice of their neighbours changes them
    even_bend: np.ndarray  # [6, 6] the same without what edges add, where the choice of the neighbours changes normals most
    residual: float  # metres: the robust standard deviation of the distances
    ratio: float  # the robust standard deviation of the distances in units of their σ
    together: float  # by which factor errors of neighbours that are alike widen σ of the pose
    scale: float  # by how much b would have to grow about the pivot, as a part of its size
    scale_sigma: float
    rows: "Rows | None"  # None: they are kept elsewhere
    matches: int  # with a weight above 0


class Held(NamedTuple):
    """Motions of a scan that a fit does not make."""

    motions: np.ndarray  # [k, 6] about the pivot
    pivot: np.ndarray  # [3] metres, frame of a

    def free(self, pivot: np.ndarray, size: float) -> np.ndarray:
        """Return the motions about another pivot that are left, [6, 6 - k]: at right angles to the others for points of a size, metres."""
        turn = self.motions[:, :3]
        there = np.concatenate([turn, self.motions[:, 3:] + np.cross(turn, pivot - self.pivot)], axis=1)
        return np.asarray(np.linalg.svd(there * np.array([size**2] * 3 + [1.0] * 3))[2][len(there):].T)


class Rows(NamedTuple):
    """The matched points of a fit, each a row of its least squares."""

    at: np.ndarray  # [k] int64, point of a
    of: np.ndarray  # [k] int64, point of b
    gradient: np.ndarray  # [k, 6] float32: weight times the derivative of the distance
    sigma_a: np.ndarray  # [k] float32 metres: what the noise of the point of a adds to the distance
    sigma_b: np.ndarray  # [k] float32


def fit(a: Cloud, b: Cloud, start: np.ndarray, reaches: list[float], *, most: int | None = None, held: Held | None = None
        ) -> Fit | None:
    """Move scan b until its surface lies on that of scan a.

    Args:
        start: [4, 4] a_from_b.
        reaches: the largest distances, metres, at which points are matched, one after the other.
        most: the most points of b that are matched; None: all that are drawn.
        held: motions that are not made; None: all are.

    Returns:
        The fit, or None if fewer than `LEAST_MATCHES` points can be matched or they do not determine a pose at all.
    """
    pose = start
    found: _Matches | None = None
    search, count = NearestWithin(a.tree, len(b.sample)), len(b.sample)
    whole, few = (slice(None, None, max(1, -(-count // min(most or count, each)))) for each in (count, FEW))
    for reach in reaches:
        last = reach == reaches[-1]
        for _ in range(STEPS):
            found = _match(a, b, pose, reach, search, whole if last else few)
            if found is None:
                return None
            system = _system(found)
            size = float(np.sqrt(np.sum((found.placed - system.pivot) ** 2) / len(found.placed)))
            free = np.eye(6) if held is None else held.free(system.pivot, size)
            try:
                normal = free.T @ (system.information + 1e-9 * np.trace(system.information) / 6 * np.eye(6)) @ free
                step = -free @ np.linalg.solve(normal, free.T @ system.gradient)
            except np.linalg.LinAlgError:
                return None
            pose = moved(step, system.pivot, pose)
            enough = STILL * found.scale / np.sqrt(len(found.at)) if last else NEARLY_STILL * found.scale
            if float(np.linalg.norm(step[:3])) * size + float(np.linalg.norm(step[3:])) < enough:
                break
    if found is None or (found := _match(a, b, pose, reaches[-1], search, whole)) is None:
        return None
    return _result(a, found, pose)


def _result(a: Cloud, found: "_Matches", pose: np.ndarray) -> Fit:
    system = _system(found)
    together = _together(found, system, BLOCK * float(np.median(a.spacing)))
    squared = max(found.ratio, 1.0) ** 2 * together**2
    local = found.placed - system.pivot
    grow = np.vecdot(local, found.normal)
    weight = found.weight / found.sigma**2
    cross = system.weighted.T @ grow
    try:
        solved = np.linalg.solve(system.information, np.stack([cross, system.gradient], axis=1))
    except np.linalg.LinAlgError:
        solved = np.zeros((6, 2))
    left = float(weight @ grow**2 - cross @ solved[:, 0])
    scale = -float(weight @ (grow * found.distance) - cross @ solved[:, 1]) / left if left > 0 else 0.0
    rows = Rows(found.at, found.of, system.weighted.astype(np.float32), found.sigma_a.astype(np.float32), found.sigma_b.astype(np.float32))
    scale_sigma = float(np.sqrt(squared / left)) if left > 0 else float("inf")
    return Fit(pose=pose, pivot=system.pivot, doubt=np.zeros((0, 6)), information=system.information / squared, normal=system.information,
               noise=system.noise, bend=system.bend, even_bend=system.even_bend, residual=found.scale, ratio=found.ratio,
               together=together, scale=scale,
               scale_sigma=scale_sigma, rows=rows, matches=int((found.weight > 0).sum()))


def _together(found: "_Matches", system: "_System", block_m: float) -> float:
    """Return by which factor distances that are alike in a block of the surface widen the σ of the pose, at least 1.

    Source: Liang and Zeger, "Longitudinal data analysis using generalized linear models", Biometrika 73, 1986: sums over blocks in place of
    single errors.
    """
    _, block = np.unique(cell_numbers(found.placed, block_m), return_inverse=True)
    pulls = system.weighted * found.distance[:, None]
    sums = np.stack([np.bincount(block, column) for column in pulls.T], axis=1)
    single = pulls.T @ pulls
    units = 1 / np.sqrt(np.maximum(np.diag(single), np.finfo(np.float64).tiny))
    single, blocks = single * np.outer(units, units), (sums.T @ sums) * np.outer(units, units)
    factor = float(np.trace(np.linalg.pinv(single, rcond=1e-9, hermitian=True) @ blocks)) / 6
    return float(np.sqrt(max(factor, 1.0)))


class _Matches(NamedTuple):
    at: np.ndarray
    of: np.ndarray
    placed: np.ndarray  # [k, 3] points of b, frame of a
    normal: np.ndarray  # [k, 3] unit
    distance: np.ndarray  # [k] metres
    sigma: np.ndarray  # [k] metres
    weight: np.ndarray  # [k] 0…1
    tilt: np.ndarray  # [k] radians: standard deviation of the normals
    bent: np.ndarray  # [k] radians: by how much normals of fewer neighbours differ
    scale: float
    ratio: float
    sigma_a: np.ndarray
    sigma_b: np.ndarray


class _System(NamedTuple):
    pivot: np.ndarray
    information: np.ndarray
    gradient: np.ndarray
    noise: np.ndarray
    bend: np.ndarray
    even_bend: np.ndarray
    weighted: np.ndarray


def _match(a: Cloud, b: Cloud, pose: np.ndarray, reach: float, search: NearestWithin, rows: slice) -> _Matches | None:
    sample = b.sample[rows]
    placed = applied(pose, b.points[sample])
    index, apart = search.search(placed, rows, reach)
    near = np.flatnonzero(apart < reach)
    sample, placed, index, apart = sample[near], placed[near], index[near], apart[near]
    turned = b.normals[sample] @ pose[:3, :3].T
    alike = np.vecdot(turned, a.normals[index])
    normal = turned + a.normals[index]
    normal /= np.maximum(np.sqrt(np.vecdot(normal, normal)), 1e-12)[:, None]
    across = np.vecdot(placed - a.points[index], normal)
    beside = np.sqrt(np.maximum(apart**2 - across**2, 0))
    keep = (alike > ALIKE) & ~a.border[index] & ~b.border[sample] & (beside < 1.5 * a.spacing[index])
    if keep.sum() < LEAST_MATCHES:
        return None
    at, of, normal, across = index[keep], sample[keep], normal[keep], across[keep]
    seen_b = np.vecdot(b.directions[of] @ pose[:3, :3].T, normal) * b.sigma[of]
    seen_a = np.vecdot(a.directions[at], normal) * a.sigma[at]
    sigma = np.sqrt(seen_a**2 + seen_b**2 + (0.05 * np.minimum(a.sigma[at], b.sigma[of])) ** 2)  # grazing rays: never 0
    ratio = MAD_TO_SIGMA * float(np.median(np.abs(across) / sigma))
    weight = tukey_weights(across, max(ratio, 1.0) * sigma)
    # 16 neighbours that lie about a spacing away tilt a plane by a quarter of σ over the spacing
    tilt = max(ratio, 1.0) * np.hypot(a.sigma[at] / a.spacing[at], b.sigma[of] / b.spacing[of]) / 4
    bent_a, bent_b = a.normals[at] - a.near_normals[at], b.normals[of] - b.near_normals[of]
    bent = np.sqrt(np.vecdot(bent_a, bent_a) + np.vecdot(bent_b, bent_b))
    scale = MAD_TO_SIGMA * float(np.median(np.abs(across)))
    return _Matches(at, of, placed[keep], normal, across, sigma, weight, tilt, bent, scale, ratio, seen_a, seen_b)


def _system(found: _Matches) -> _System:
    """Return the normal equations of a small motion about the mean of the matches."""
    weight = found.weight / found.sigma**2
    pivot = found.placed.mean(axis=0)
    local = found.placed - pivot
    jacobian = np.concatenate([np.cross(local, found.normal), found.normal], axis=1)
    weighted = jacobian * weight[:, None]
    even = np.minimum(found.bent, EDGE * np.median(found.bent))
    return _System(pivot, weighted.T @ jacobian, weighted.T @ found.distance, _turned(local, weight * found.tilt**2),
                   _turned(local, weight * found.bent**2), _turned(local, weight * even**2), weighted)


def _turned(local: np.ndarray, off: np.ndarray) -> np.ndarray:
    """Return the information [6, 6] that normals alone make whose components in the plane have these weighted variances [k]."""
    square = (local * off[:, None]).T @ local
    out = np.zeros((6, 6))
    out[:3, :3] = np.trace(square) * np.eye(3) - square
    out[3:, 3:] = off.sum() * np.eye(3)
    return out
