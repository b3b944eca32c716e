"""Scans that lie beside the surface of the others by more than their noise explains, or where others saw through: their poses are wrong."""

from typing import NamedTuple

import numpy as np

from kernels.fusion.residuals import compare_views
from kernels.fusion.views import upload_views
from service.scans.fusion.fused_surface import world_points
from service.scans.fusion.range_images import PreparedScan

SAMPLES = 3000
"""Pixels of a scan that are compared with the others."""
LEAST_COMMON = 50
"""Fewest pixels of a scan, of SAMPLES, that another must see before the place of the scan can be told."""
REACH = 0.02
"""Largest distance between two surfaces that are still compared, in the median extent of the scans."""
SAME_SIGMAS = 4.0
"""Distance from another surface, in standard deviations, up to which that is the same surface. Where a point has one, what other scans
measured farther in front of it hides it from them, and says nothing of its place."""
LARGEST_SIGMAS = 2.0
"""Displacement, in median standard deviations of the comparison, from which on a scan counts as misplaced; smaller ones harm little."""
CONFIRMED = 0.25
"""Part of the displacement of a misplaced scan up to which others confirm the place of another one. Right scans lie beside each other by
about a third of their noise (0.16 to 0.4 mm where that is 0.6 to 0.8 mm), a sixth of the least displacement that counts."""
CONTRADICTED, LEAST_THROUGH, AGAINST = 0.1, 15, 2
"""Part of the points of two scans, of those that lie on the other's surface or where it saw through, and their number, from which on the
two contradict each other (of right poses none do, of one that is turned by 90° 10 to 40 %), and fewest scans that must contradict one
whose pose is wrong."""
UNDETERMINED = 1e-10
"""Directions in which a motion is determined less than this part of the best determined one do not move."""
ROUNDS = 5
"""Rounds of reweighting of the fit of a motion, which begins with none: points that agree as they are decide, if they are most."""


class Placing(NamedTuple):
    """The place of a scan relative to the others."""

    compared: int  # pixels that another scan sees too
    displacement_m: float  # RMS over the compared pixels along their normals, of the small motion that fits best
    median_m: float  # median distance to the others, without a motion
    sigma_m: float  # median standard deviation of that distance
    misplaced: bool
    against: tuple[int, ...] = ()  # scans that it contradicts, where no other scan tells whose pose is wrong
    through: float = 0.0  # largest part of the points of it and another scan that were seen through, if that is why; else 0


class Sample(NamedTuple):
    """Points of one scan that are compared with the others."""

    points: np.ndarray  # [n, 3] metres, world
    normals: np.ndarray  # [n, 3] unit, world
    variance: np.ndarray  # [n] square metres, of each point along its normal


class Readings(NamedTuple):
    """The points of all samples, one after another, that a scan sees too."""

    at: np.ndarray  # [k] int64
    distance: np.ndarray  # [k] float32 metres, from the surface of the scan
    expected: np.ndarray  # [k] float32 metres, standard deviation of that
    through: np.ndarray = np.empty(0, np.int64)  # [m], the points that it saw through: what it measured lies far behind them


def sample_of(scan: PreparedScan, number: int) -> Sample:
    """Return points of a scan with a pose, drawn by its number."""
    there, used = world_points(scan)
    image = scan.image
    normal = np.asarray(image.normal).reshape(-1, 3)[used]
    usable = np.flatnonzero(normal.any(axis=1))
    picked = np.sort(np.random.default_rng(number).choice(usable, min(SAMPLES, len(usable)), replace=False))
    world = np.linalg.inv(image.camera_from_world)
    turned = normal[picked] @ world[:3, :3].T
    sigma = np.asarray(image.sigma).ravel()[used[picked]]
    if image.orthographic:
        along = sigma * (turned @ world[:3, 2])
    else:
        sight = there[picked] - world[:3, 3]
        depth = np.asarray(image.depth).ravel()[used[picked]].astype(np.float64)
        along = sigma / depth * np.einsum("ni,ni->n", turned, sight)
    return Sample(there[picked], turned, along**2)


def reach_of(samples: list[Sample], voxel: float) -> float:
    """Return the distance, metres, beyond which two surfaces are not compared."""
    return max(REACH * float(np.median([np.ptp(sample.points, axis=0).max() for sample in samples])), 10 * voxel)


def readings_of(scan: PreparedScan, number: int, samples: list[Sample], reach: float, *, device: str) -> Readings:
    """Return how far the points of all samples but its own lie from the surface of a scan."""
    origin = samples[number].points.mean(axis=0)  # near the scan, so that coordinates are short in single precision
    views = upload_views([scan.image], origin, device=device)
    whole = Sample(*(np.concatenate(parts) for parts in zip(*samples, strict=True)))
    distance, expected = (values[:, 0].copy() for values in compare_views(
        views, whole.points - origin, whole.normals, whole.variance, reach=reach, device=device))
    first = sum(len(sample.points) for sample in samples[:number])
    expected[first:first + len(samples[number].points)] = 0
    at = np.flatnonzero(expected)
    return Readings(at, distance[at], expected[at], np.flatnonzero(_seen_through(scan, whole.points, reach)))


def _seen_through(scan: PreparedScan, points: np.ndarray, reach: float) -> np.ndarray:
    """Return [n] bool, the points (metres, world) that lie before all that a scan measured around their line of sight, by `reach`."""
    image = scan.image
    there = points @ image.camera_from_world[:3, :3].T + image.camera_from_world[:3, 3]
    row, col, inside = scan.camera.pixels_of(there)
    return inside & (there[:, 2] < 0) & (-there[:, 2] < np.asarray(image.clear)[row, col] - reach)


def place_scans(samples: list[Sample], readings: list[Readings], voxel: float) -> list[Placing]:
    """Compare every scan with the others and find those that are misplaced, the worst first taken out of the comparison of the rest.

    Where two scans lie beside each other, the one that others confirm stays; if they confirm neither or both, both are misplaced and name
    each other. Displacements below half a voxel (metres) do no harm. A scan that is taken out keeps the figures from before.
    """
    firsts = np.cumsum([0, *(len(sample.points) for sample in samples)])
    ranges = [np.searchsorted(each.at, firsts) for each in readings]
    everyone = set(range(len(samples)))

    def placing(number: int, apart: set[int]) -> Placing:
        distance, expected = (np.zeros((len(samples[number].points), len(samples)), dtype=np.float32) for _ in range(2))
        for other, (each, places) in enumerate(zip(readings, ranges, strict=True)):
            part = slice(places[number], places[number + 1])
            distance[each.at[part] - firsts[number], other] = each.distance[part]
            expected[each.at[part] - firsts[number], other] = each.expected[part]
        return _placing(samples[number], distance, expected, apart - {number}, voxel)

    def confirmed(number: int, without: int, displacement: float) -> bool:
        found = placing(number, {*out, without})
        return found.compared >= LEAST_COMMON and found.displacement_m <= CONFIRMED * displacement

    def taken_out(worst: int) -> dict[int, Placing]:
        beside = {other: placing(worst, everyone - {other}) for other in everyone - {worst} - set(out)
                  if ranges[other][worst + 1] - ranges[other][worst] >= LEAST_COMMON}
        rivals = [other for other in sorted(beside) if beside[other].misplaced]
        size = placings[worst].displacement_m
        told = any(confirmed(other, worst, size) for other in rivals)
        holds = len(rivals) == 1 and confirmed(worst, rivals[0], size)
        if not rivals or (told and not holds):
            return {worst: placings[worst]}
        if holds and not told:
            return {rivals[0]: beside[rivals[0]]}
        return {worst: placings[worst]._replace(against=tuple(rivals))} | {
            other: beside[other]._replace(against=(worst,)) for other in rivals}

    out = {number: placing(number, set())._replace(misplaced=True, through=part)
           for number, part in elsewhere(samples, readings).scans.items()}
    placings = [placing(number, set(out)) for number in range(len(samples))]
    while True:
        wrong = [number for number, each in enumerate(placings) if each.misplaced and number not in out]
        if not wrong:
            return [out.get(number, each)._replace(misplaced=number in out) for number, each in enumerate(placings)]
        found = taken_out(max(wrong, key=lambda number: placings[number].displacement_m))
        out |= found
        for number in everyone - set(out):
            if any(ranges[other][number + 1] > ranges[other][number] for other in found):
                placings[number] = placing(number, set(out))


class Elsewhere(NamedTuple):
    """Scans of which others saw through parts."""

    scans: dict[int, float]
    """Those that several others contradict, which contradict few themselves, with the largest part of the points of two."""
    pairs: list[tuple[int, int, float]]
    """The others that contradict each other, with the part of their points."""


def elsewhere(samples: list[Sample], readings: list[Readings]) -> Elsewhere:
    """Return the scans whose poses are wrong by what others saw through, the worst first: each is compared with those that remain."""
    firsts = np.cumsum([0, *(len(sample.points) for sample in samples)])
    through, common = (np.stack([np.diff(np.searchsorted(getattr(each, name), firsts)) for each in readings]) for name in ("through", "at"))
    through, common = through + through.T, common + common.T  # [scans, scans] points of both
    part = through / np.maximum(through + common, 1)
    against = (part > CONTRADICTED) & (through >= LEAST_THROUGH)
    scans: dict[int, float] = {}
    while True:
        count = against.sum(axis=1)
        worst = int(np.lexsort((through.sum(axis=1), count))[-1])
        if count[worst] < AGAINST or 2 * np.median(count[against[worst]]) > count[worst]:
            pairs = zip(*np.nonzero(np.triu(against)), strict=True)
            return Elsewhere(scans, [(int(one), int(two), float(part[one, two])) for one, two in pairs])
        scans[worst] = float(part[worst, against[worst]].max())
        against[worst] = against[:, worst] = False


def _placing(sample: Sample, distance: np.ndarray, expected: np.ndarray, apart: set[int], voxel: float) -> Placing:
    """Return how a scan lies to the others but those that are kept apart."""
    known = expected > 0
    known[:, sorted(apart)] = False
    agreeing = known & (np.abs(distance) <= SAME_SIGMAS * expected)
    known &= ~agreeing.any(axis=1, keepdims=True) | (distance >= -SAME_SIGMAS * expected)
    seen = known.any(axis=1)
    if np.count_nonzero(seen) < LEAST_COMMON:
        return Placing(int(seen.sum()), 0.0, 0.0, 0.0, False)
    ordered = np.sort(np.where(known[seen], distance[seen], np.inf).astype(np.float64), axis=1)
    count = known[seen].sum(axis=1)
    offset = np.take_along_axis(ordered, np.stack([(count - 1) // 2, count // 2], axis=1), axis=1).mean(axis=1)  # the median
    sigma = float(np.median(expected[seen][known[seen]]))
    place, normal = sample.points[seen] - sample.points[seen].mean(axis=0), sample.normals[seen]
    rows = np.concatenate([np.cross(place, normal), normal], axis=1) * ([1 / max(np.abs(place).max(), 1e-12)] * 3 + [1.0] * 3)
    fit = rows @ fitted_motion(rows, offset, ROUNDS)
    displacement = float(np.sqrt(np.mean(fit**2)))
    return Placing(int(seen.sum()), displacement, float(np.median(np.abs(offset))), sigma,
                   displacement > max(LARGEST_SIGMAS * sigma, voxel / 2))


def fitted_motion(rows: np.ndarray, distance: np.ndarray, rounds: int) -> np.ndarray:
    """Return the small motion [6] that explains distances [n] of points from other surfaces best, with Cauchy weights.
    `rows`: [n, 6] how fast each distance grows with the motion. `rounds`: of reweighting, which begins with no motion."""
    motion = np.zeros(rows.shape[1])
    for _ in range(rounds):
        rest = np.abs(distance - rows @ motion)
        weighted = rows / (1 + (rest / max(1.5 * float(np.median(rest)), 1e-9)) ** 2)[:, None]
        motion = np.linalg.pinv(weighted.T @ rows, rcond=UNDETERMINED, hermitian=True) @ (weighted.T @ distance)
    return motion
