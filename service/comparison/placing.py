"""Lay a scan on its design: rough poses by features and by principal axes, then least squares of distances to the design's faces.

The last fit is that of the points whose distances Tukey's biweight keeps, so that a dent or a burr does not move the rest. Source: Chen and
Medioni, "Object modelling by registration of multiple range images", Image and Vision Computing 10(3), 1992, for distances along normals.
"""

from collections.abc import Callable
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from service.comparison.surfaces import STRAY, Design, Offsets, ScannedSurface
from service.scans.points.cloud import Cloud, Thinned, cloud_of, thin
from service.scans.points.rigid import applied, moved
from service.scans.registration.coarse import fpfh, is_near, rough_poses
from service.scans.registration.pairs import FEATURE_CELLS, MOST_POSES, ROUGH_POINTS
from stage.errors import ScanError
from stage.spread import MAD_TO_SIGMA, TUKEY, tukey_weights

CELLS_ACROSS = 60
"""The size of the design in cells of the rough scale."""
SAMPLES_A_CELL = 8
"""Points of the design for each cell of its surface, of which the rough scale averages."""
ALIKE = 0.5
"""The least cosine between the normals of a point and of the face that is nearest to it."""
FEW, SOME, MANY = 800, 3000, 30_000
"""Points of the scan that are fitted: of each rough pose, of the best ones, and at last."""
BEST = 6
"""The number of poses that are fitted finely."""
STEPS = 15
NEARLY_STILL, STILL = 1e-3, 1e-6
"""Steps end when points move by less than this part of the reach: of a rough fit, and of the last."""
RIVAL = 1.5
"""Another pose fits as well if the mean square distance that it leaves is at most this many times that of the best."""
LARGER, SMALLER = 4.0, 0.02
"""The sizes of a scan, in that of the design, beyond which their units are not the same: a fixture may lie around a part, and a scan may
show a small piece of it."""
BESIDE = 1.5
"""Distance along an axis from the middle of points beyond which one is stray, in the longest side of the box around them."""
LEAST_SHARE = 0.5
"""The least part of a scan that must lie on the design."""
USUAL = 0.8
"""Part of the points by whose largest distance from the design it is seen whether a scan is turned."""
POOR = 3.0
"""That distance in σ of a point, above which other ways to turn the scan are tried."""
TURNED_BETTER = 2.0
"""By which factor it must be smaller for a scan to be called turned: of a part that is its own mirror image it is the same."""
MIRROR, AS_IT_IS = np.array([-1.0, 1.0, 1.0]), np.ones(3)
TURNED = (
    (AS_IT_IS, -1.0, "if its outside is taken for the inside (turn over the faces or the normals of the scan, or the faces of the design "
                     "where that is an open surface)"),
    (MIRROR, 1.0, "as its mirror image (check the axes of the scan, which may be left-handed, and that it is that part and not its twin)"),
    (MIRROR, -1.0, "as its mirror image turned inside out (an axis of it, or of the design, was mirrored without turning the faces over)"))
"""The factors of coordinates and of normals of scans that are turned, and the sentences about them."""
HELD = 1e-3
"""A motion is not determined if it moves the points along their normals by less than the square root of this part of the motion that moves
them most: it is held where it is. A cylinder of 64 flat sides has 8e-4 about its axis."""


class Placement(NamedTuple):
    """The pose of a scan on its design, and how sure it is."""

    pose: np.ndarray  # [4, 4] design_from_scan
    pivot: np.ndarray  # [3] metres, frame of the design: the middle of the points
    covariance: np.ndarray  # [6, 6] of a small rotation about the pivot (radians) and a translation (metres); 0 of held motions
    rivals: int
    """Number of other poses that fit about as well."""
    held: int
    """Number of motions, of six, that the surface does not determine."""
    sigma_m: float
    """Largest standard deviation by which any point may be moved along the surface's normal, metres."""


class _Fit(NamedTuple):
    pose: np.ndarray
    pivot: np.ndarray
    covariance: np.ndarray
    held: int
    open_still: np.ndarray  # [6, 6]: what is left of a motion after the fit: the part that is held


Wanted = Callable[[Offsets], np.ndarray]
"""Tells which of some offsets [m] count."""


def place(design: Design, scan: ScannedSurface, *, search: bool, reach_m: float, datum: Wanted | None = None) -> Placement:
    """Find the pose of a scan on its design.
    `search`: nothing is known of the pose; False: it is right to within the reach of a rough fit, a fiftieth of the design's size.
    `reach_m`: distance of points from the design beyond which they do not belong to it. `datum`: tells the points by which the pose is
    found at last; None: all. Raises ScanError if less than half of the scan can be laid on the design."""
    drawn = np.random.default_rng(0).permutation(len(scan.points))
    if not SMALLER < scan.size / design.size < LARGER:
        raise ScanError(f"the scan does not lie on the design: {_sizes(design, scan)}")
    fitted = np.eye(4)
    rivals = 0
    coarse = design.size / CELLS_ACROSS
    if search:
        found, middle = _searched(design, scan, drawn, coarse)
        if not found:
            raise ScanError(f"the scan does not lie on the design: {_sizes(design, scan)}")
        least = found[0][1]
        fitted = _closest(design, scan, drawn[:SOME], [pose for pose, score in found if score <= RIVAL * least], coarse)
        _refuse_turned(design, scan, drawn, coarse, fitted)
        rivals = sum(score <= RIVAL * least and not is_near(pose, fitted, middle, 3 * coarse) for pose, score in found)
    for reach, kept in ((1.5 * coarse, 1.5 * coarse), (max(0.75 * coarse, reach_m), 0.75 * coarse), (reach_m, 0.0)):
        step = _fit(design, scan, drawn[:MANY], fitted, reach, kept_m=kept)  # the few points of walls decide before they stand off
        if step is None:
            raise ScanError(_unlike(design, scan, drawn[:SOME], fitted, reach_m))
        fitted, last = step.pose, step
    share = _share(design, scan, drawn[:SOME], fitted, reach_m)
    if share < LEAST_SHARE:
        raise ScanError(_unlike(design, scan, drawn[:SOME], fitted, reach_m))
    if datum is not None:
        by_datum = _fit(design, scan, drawn[:MANY], fitted, reach_m, datum)
        if by_datum is None:
            raise ScanError("regions: too little of the datum regions is in the scan to lay it on them")
        turn = np.eye(6)
        turn[3:, :3] = np.cross(np.eye(3), by_datum.pivot - last.pivot).T
        open_still = by_datum.open_still @ turn
        last = by_datum._replace(covariance=by_datum.covariance + open_still @ last.covariance @ open_still.T)
    near, _ = _matched(design, scan, drawn[:SOME], last.pose, reach_m)
    moves = gradient(near.at, near.across, last.pivot)
    sigma_m = float(np.sqrt(np.einsum("ni,ij,nj->n", moves, last.covariance, moves).max(initial=0)))
    return Placement(last.pose, last.pivot, last.covariance, rivals, last.held, sigma_m)


def _searched(design: Design, scan: ScannedSurface, drawn: np.ndarray, coarse: float) -> tuple[list[tuple[np.ndarray, float]], np.ndarray]:
    """Return poses of a scan, the best first, with the mean square distances that they leave, and the middle of the scan."""
    rough, middle = _rough(design, scan)
    tried = sorted((_settle(design, scan, drawn[:FEW], pose, (6 * coarse, 3 * coarse)) for pose in rough), key=lambda each: each[1])
    better = _distinct(tried, middle, coarse)
    finely = (_settle(design, scan, drawn[:SOME], pose, (3 * coarse, 1.5 * coarse, coarse)) for pose, _ in better)
    return sorted(finely, key=lambda each: each[1]), middle


def _closest(design: Design, scan: ScannedSurface, rows: np.ndarray, poses: list[np.ndarray], coarse: float) -> np.ndarray:
    """Return of poses that fit about as well the first, unless most points lie clearly closer to the design at another: points beside
    edges and borders, which face another way than what is nearest, may be most of a mean square distance."""
    most = [_most(design, scan, rows, pose, coarse) for pose in poses]
    best = int(np.argmin(most))
    return poses[best if most[best] < most[0] / RIVAL else 0]


def _refuse_turned(design: Design, scan: ScannedSurface, drawn: np.ndarray, coarse: float, pose: np.ndarray) -> None:
    """Raise ScanError if the mirror image of a scan, or the scan turned inside out, lies on the design far better than the scan does at a
    pose."""
    own = _most(design, scan, drawn[:SOME], pose, coarse)
    if own <= POOR * float(np.median(scan.sigma)):
        return
    most, said = own, ""
    for axes, sides, sentence in TURNED:
        turned = scan._replace(points=scan.points * axes, normals=scan.normals * axes * sides)
        poses = [each for each, _ in _searched(design, turned, drawn, coarse)[0]]
        if poses:
            nearer = _most(design, turned, drawn[:SOME], _closest(design, turned, drawn[:SOME], poses, coarse), coarse)
            most, said = (nearer, sentence) if nearer < most / RIVAL else (most, said)
    if most < own / TURNED_BETTER:
        raise ScanError(f"the scan lies on the design only {said}: {USUAL:.0%} of its points then lie within {1e3 * most:.2g} mm of "
                        f"it, and within {1e3 * own:.2g} mm as it is")


def _most(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reach: float) -> float:
    """Return the distance from the design within which most points of a scan lie that face as it does; at most the reach."""
    distance = np.full(len(rows), reach)
    found = np.abs(_matched(design, scan, rows, pose, reach)[0].distance)
    distance[:len(found)] = found
    return float(np.quantile(distance, USUAL))


def _rough(design: Design, scan: ScannedSurface) -> tuple[list[np.ndarray], np.ndarray]:
    """Return rough poses design_from_scan, and the middle of the scan in its own frame."""
    cell = design.size / CELLS_ACROSS
    count = int(min(2e5, SAMPLES_A_CELL * float(design.areas.sum()) / cell**2))
    points, face = design.sample(max(count, 2000))
    of_design = _cloud(points, design.normals[face], np.full(len(points), cell / 100), cell)
    of_scan = _cloud(scan.points, scan.normals, scan.sigma, cell)
    features = (fpfh(each, FEATURE_CELLS * cell) for each in (of_design, of_scan))
    poses = rough_poses(of_design, of_scan, *features, cell_m=cell, most=MOST_POSES)
    return [*poses, *_by_axes(of_design, of_scan)], of_scan.middle


def _cloud(points: np.ndarray, normals: np.ndarray, sigma: np.ndarray, cell: float) -> Cloud:
    """Return points as registration uses them, whose normals point outward; points without a normal, and far stray ones, are left out."""
    low, high = np.quantile(points, (STRAY, 1 - STRAY), axis=0)
    around = np.abs(points - (low + high) / 2).max(axis=1) < BESIDE * (high - low).max()
    known = (np.linalg.norm(normals, axis=1) > 0.5) & around
    thinned = thin(points[known], -normals[known], sigma[known] ** 2, cell)
    whole = np.linalg.norm(thinned.directions, axis=1) > 0.5  # the mean of both sides of a thin wall has no direction
    return cloud_of(Thinned(*(each[whole] for each in thinned[:3])), most=ROUGH_POINTS)


def _by_axes(design: Cloud, scan: Cloud) -> list[np.ndarray]:
    """Return the poses that lay the principal axes of a scan on those of the design, in any order and direction."""
    poses = []
    ours, theirs = (np.linalg.eigh(np.cov((each.points - each.middle).T))[1] for each in (design, scan))
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = ours @ (theirs[:, order] * signs).T
        if np.linalg.det(turn) > 0:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn, design.middle - turn @ scan.middle
            poses.append(pose)
    return poses


def _settle(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reaches: tuple[float, ...]
            ) -> tuple[np.ndarray, float]:
    """Return a pose after fits at some reaches, and the mean square distance that it leaves, of at most the last reach each."""
    for reach in reaches:
        fit = _fit(design, scan, rows, pose, reach, still=NEARLY_STILL)
        if fit is None:
            break
        pose = fit.pose
    found = _matched(design, scan, rows, pose, reaches[-1])[0]
    squares = np.minimum(found.distance**2, reaches[-1] ** 2)
    return pose, float(squares.sum() + (len(rows) - len(squares)) * reaches[-1] ** 2) / len(rows)


def _distinct(tried: list[tuple[np.ndarray, float]], middle: np.ndarray, apart_m: float) -> list[tuple[np.ndarray, float]]:
    """Return the best of some poses that differ from each other."""
    kept: list[tuple[np.ndarray, float]] = []
    for pose, score in tried:
        if len(kept) < BEST and not any(is_near(pose, other, middle, apart_m) for other, _ in kept):
            kept.append((pose, score))
    return kept


def _matched(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reach: float) -> tuple[Offsets, np.ndarray]:
    """Return where some points of a scan lie against the design at a pose, and which points they are; those that face another way are left
    out."""
    found = design.offsets(applied(pose, scan.points[rows]), reach)
    turned = scan.normals[rows[found.near]] @ pose[:3, :3].T
    alike = np.einsum("ni,ni->n", turned, design.normals[found.face]) > ALIKE
    return Offsets(*(each[alike] for each in found)), rows[found.near[alike]]


def _fit(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reach: float, wanted: Wanted | None = None, *,
         still: float = STILL, kept_m: float = 0.0) -> _Fit | None:
    """Return the pose near another that brings points of a scan onto the design; None if too few can be matched.
    `kept_m`: distance within which points count whatever the others say: where most lie on planes, those that tell the rest stand off."""
    covariance, held, pivot, open_still = np.zeros((6, 6)), 6, np.zeros(3), np.eye(6)
    for _ in range(STEPS):
        found, points = _matched(design, scan, rows, pose, reach)
        if wanted is not None:
            kept = wanted(found)
            found, points = Offsets(*(each[kept] for each in found)), points[kept]
        if len(points) < 6 * 5:
            return None
        placed = found.at + found.across * found.distance[:, None]
        pivot = placed.mean(axis=0)
        spread = MAD_TO_SIGMA * float(np.median(np.abs(found.distance)))
        weight = tukey_weights(found.distance, max(spread, float(np.median(scan.sigma)), kept_m / TUKEY))
        jacobian = gradient(placed, found.across, pivot)
        size = float(np.sqrt(np.mean((placed - pivot) ** 2) * 3))
        units = np.array([1 / size] * 3 + [1.0] * 3)
        scaled = jacobian * units
        values, axes = np.linalg.eigh(scaled.T @ (scaled * weight[:, None]))
        told = values > HELD * values[-1]
        inverse = (axes[:, told] / values[told]) @ axes[:, told].T * np.outer(units, units)
        step = -inverse @ (jacobian.T @ (weight * found.distance))
        noise = jacobian * (weight * scan.sigma[points])[:, None]
        covariance, held = inverse @ (noise.T @ noise) @ inverse, int((~told).sum())
        open_still = np.eye(6) - inverse @ jacobian.T @ (jacobian * weight[:, None])
        pose = moved(step, pivot, pose)
        if float(np.linalg.norm(step[:3])) * size + float(np.linalg.norm(step[3:])) < still * reach:
            break
    return _Fit(pose, pivot, covariance, held, open_still)


def gradient(points: np.ndarray, across: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return the derivative [n, 6] of the distance of points [n, 3] along unit vectors by a small motion about a pivot."""
    return np.concatenate([np.cross(points - pivot, across), across], axis=1)


def _share(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reach: float) -> float:
    return len(_matched(design, scan, rows, pose, reach)[1]) / len(rows)


def _unlike(design: Design, scan: ScannedSurface, rows: np.ndarray, pose: np.ndarray, reach: float) -> str:
    return (f"the scan does not lie on the design: {_share(design, scan, rows, pose, reach):.0%} of its points come within "
            f"{1e3 * reach:.3g} mm of it at the best pose; {_sizes(design, scan)}")


def _sizes(design: Design, scan: ScannedSurface) -> str:
    return (f"the scan is {1e3 * scan.size:.4g} mm large, the design {1e3 * design.size:.4g} mm: check --scan-unit and --design-unit, and "
            "that it is that part")
