"""Whether surfaces that a moving scanner saw again lie where they lay before, and which declaration would bring them together.

A cloud of a moving scanner looks smooth within one pass whatever the track, the mounting or the angles are; a wrong one shows where the
same surface is seen again from elsewhere. Around places of the cloud a plane is fitted to the returns of one pass, and the distance of the
returns of another pass from it is compared with the scatter about the plane. Where it is larger, each fault of a declaration that is
often made is tried: angles of another sign or unit, ranges in millimetres, inverted poses, a clock that is off, and a mounting that is
turned or moved.

Source: Skaloud and Lichti, "Rigorous approach to bore-sight self-calibration in airborne laser scanning", ISPRS Journal 61(1), 2006, for
the mounting by planes that are seen from several poses.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from kernels.photometric.model.samples import evenly
from stage.spread import MAD_TO_SIGMA
from stage.tof.scan import Pose, Shots, world_points

RETURNS = 60_000
"""The most returns that are looked at, evenly in time."""
PLACES = 1500
"""Places at which planes are fitted."""
NEIGHBOURS = 96
"""Returns around a place, among which are those of other passes."""
OWN, OTHER = 0.02, 0.05
"""Parts of the duration within which returns are of one pass, and beyond which they are of another."""
OF_PLANE = 10
"""Returns of one pass by which a plane is fitted."""
FLAT = 0.2
"""Largest deviation from a plane, as a part of the smaller extent of its returns."""
LEAST_PLACES = 100
APART, LEAST_M = 2.0, 1e-3
"""Distance between passes over the scatter within one above which they contradict each other, and the least scatter that counts: no scanner
has less, but simulated ones have none."""
EXPLAINED = 0.5
"""Distance between passes with another declaration, over that with the given one, below which it is named."""


class Passes(NamedTuple):
    """How far apart passes lie."""

    apart_m: float
    """Robust standard deviation of the distances of returns of one pass from planes of another."""
    within_m: float
    """That of returns from the planes of their own pass."""
    explanation: str | None
    """What brings the passes together, as a clause; None where they do not contradict each other, empty where nothing does."""

    def warning(self) -> str | None:
        """Return a sentence, or None where passes agree."""
        if self.explanation is None:
            return None
        why = self.explanation or "check time_s, the poses of the track and platform_from_scanner"
        return (f"track: surfaces that were seen again lie {self.apart_m:.2g} m apart, where points scatter by {self.within_m:.2g} m "
                f"within one pass: {why}")


class _Planes(NamedTuple):
    """Places that two passes show."""

    own: np.ndarray  # [places, OF_PLANE] returns of one pass
    other: np.ndarray  # [places] a return of another
    size: float
    """Median radius of the places."""


def compare_passes(shots: Shots, index: np.ndarray, range_m: np.ndarray) -> Passes | None:
    """Return how far apart the passes of a scan lie; None where the platform stands still, or too little is seen again.
    `index`: [m] the shot of each return. `range_m`: [m] metres."""
    if len(shots.scan.track) < 2 or len(index) < LEAST_PLACES:
        return None
    chosen = evenly(len(index), RETURNS)
    index, range_m = index[chosen], range_m[chosen]
    points = world_points(shots, index, range_m)[0]
    planes = _planes(points, shots.time_s[index])
    if planes is None:
        return None
    apart_m, within_m = _apart(planes, points)
    if apart_m <= APART * max(within_m, LEAST_M):
        return Passes(apart_m, within_m, None)
    explanation = _declared_otherwise(shots, index, range_m, apart_m / planes.size)
    return Passes(apart_m, within_m, explanation or _off(shots, index, range_m, planes, apart_m))


def _planes(points: np.ndarray, time: np.ndarray) -> _Planes | None:
    duration = float(np.ptp(time))
    places = evenly(len(points), 3 * PLACES)
    away, near = cKDTree(points).query(points[places], k=min(NEIGHBOURS, len(points)))
    apart = np.abs(time[near] - time[places, None]) / max(duration, 1e-12)
    own = np.where(apart <= OWN, away, np.inf)
    first = np.argsort(own, axis=1)[:, :OF_PLANE]
    radius = np.take_along_axis(own, first, axis=1).max(axis=1)
    # the pass that is longest ago: its pose is the most unlike
    last = np.where(away <= radius[:, None], apart, 0)
    kept = np.isfinite(radius) & (last.max(axis=1) >= OTHER)
    if kept.sum() < LEAST_PLACES:
        return None
    nearest, beside = np.take_along_axis(near, first, axis=1)[kept], near[np.arange(len(near)), last.argmax(axis=1)][kept]
    values = np.linalg.eigvalsh(_covariance(points[nearest])[1])
    flat = np.flatnonzero(values[:, 0] <= FLAT**2 * values[:, 1])
    flat = flat[evenly(len(flat), PLACES)]
    if len(flat) < LEAST_PLACES:
        return None
    return _Planes(nearest[flat], beside[flat], float(np.median(radius[kept][flat])))


def _covariance(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    middle = points.mean(axis=1)
    off = points - middle[:, None]
    return middle, np.einsum("pka,pkb->pab", off, off) / (points.shape[1] - 3)


def _distances(planes: _Planes, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the other returns from the planes, and the scatter about these."""
    middle, covariance = _covariance(points[planes.own])
    values, vectors = np.linalg.eigh(covariance)
    return np.einsum("pa,pa->p", points[planes.other] - middle, vectors[:, :, 0]), np.sqrt(np.maximum(values[:, 0], 0))


def _apart(planes: _Planes, points: np.ndarray) -> tuple[float, float]:
    distance, scatter = _distances(planes, points)
    return MAD_TO_SIGMA * float(np.median(np.abs(distance))), float(np.median(scatter))


def _declared_otherwise(shots: Shots, index: np.ndarray, range_m: np.ndarray, least: float) -> str:
    """Return a clause about angles, ranges or poses whose unit, sign or sense is another, by which the passes meet best; none: empty."""
    best, clause = EXPLAINED * least, ""
    for name, otherwise, ranges in (
            ("azimuth_rad is in degrees", replace(shots, azimuth_rad=np.radians(shots.azimuth_rad)), range_m),
            ("azimuth_rad has the other sign", replace(shots, azimuth_rad=-shots.azimuth_rad), range_m),
            ("elevation_rad has the other sign", replace(shots, elevation_rad=-shots.elevation_rad), range_m),
            ("the poses are platform_from_world", _inverted(shots), range_m),
            ("range_m is in millimetres", shots, range_m / 1000)):
        score = _score(otherwise, index, ranges)
        if score < best:
            best, clause = score, name
    return f"they meet if {clause}" if clause else ""


def _score(shots: Shots, index: np.ndarray, range_m: np.ndarray) -> float:
    """Return how far apart passes lie in radii of their places; infinite where there are none."""
    points = world_points(shots, index, range_m)[0]
    planes = _planes(points, shots.time_s[index])
    return np.inf if planes is None else _apart(planes, points)[0] / planes.size


def _inverted(shots: Shots) -> Shots:
    def inverse(pose: Pose) -> Pose:
        rows = np.linalg.inv(np.array(pose.world_from_platform))
        return pose.model_copy(update={"world_from_platform": tuple(tuple(row) for row in rows.tolist())})

    return replace(shots, scan=shots.scan.model_copy(update={"track": tuple(inverse(pose) for pose in shots.scan.track)}))


def _off(shots: Shots, index: np.ndarray, range_m: np.ndarray, planes: _Planes, apart_m: float) -> str:
    """Return a clause about a clock or a mounting that is off, by which the passes meet best; none: empty."""
    used = np.unique(np.concatenate([planes.own.ravel(), planes.other]))
    place = np.zeros(len(index), int)
    place[used] = np.arange(len(used))
    part = _Planes(place[planes.own], place[planes.other], planes.size)
    mount = np.array(shots.scan.platform_from_scanner, dtype=np.float64)

    def moved(values: np.ndarray, kind: str) -> Shots:
        if kind == "clock":
            return replace(shots, time_s=shots.time_s + values[0])
        turned = mount.copy()
        if kind == "turn":
            turned[:3, :3] = Rotation.from_rotvec(values).as_matrix() @ mount[:3, :3]
        else:
            turned[:3, 3] += values
        return replace(shots, scan=shots.scan.model_copy(update={"platform_from_scanner": tuple(tuple(row) for row in turned.tolist())}))

    best, clause = EXPLAINED * apart_m, ""
    for kind, count in (("clock", 1), ("turn", 3), ("place", 3)):
        def residual(values: np.ndarray, kind: str = kind) -> np.ndarray:
            return _distances(part, world_points(moved(values, kind), index[used], range_m[used])[0])[0]

        fit = least_squares(residual, np.zeros(count), loss="soft_l1", f_scale=max(apart_m / 3, 1e-6), diff_step=1e-4, x_scale=0.01)
        left = MAD_TO_SIGMA * float(np.median(np.abs(residual(fit.x))))
        if left < best:
            size = float(np.linalg.norm(fit.x))
            best, clause = left, {"clock": f"{abs(fit.x[0]):.3g} s are {'added to' if fit.x[0] > 0 else 'taken off'} time_s of the shots",
                                  "turn": f"platform_from_scanner is turned by {np.degrees(size):.2g}°",
                                  "place": f"platform_from_scanner is moved by {size:.2g} m"}[kind]
    return f"they lie {best:.2g} m apart if {clause}" if clause else ""
