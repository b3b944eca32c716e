"""Scans that lie beside the surface of the others by more than their noise explains: their poses are wrong."""

from typing import NamedTuple

import numpy as np

from kernels.fusion.compare import compare_views
from kernels.fusion.views import upload_views
from service.scans.range_images import PreparedScan
from service.scans.surface import world_points

SAMPLES = 3000
"""Pixels of a scan that are compared with the others."""
BATCH_PIXELS = 1 << 25
"""Most pixels of views that are compared at one time, which bounds the memory."""
LEAST_COMMON = 50
"""Fewest pixels of a scan, of SAMPLES, that another must see before the place of the scan can be told."""
REACH = 0.02
"""Largest distance between two surfaces that are still compared, in extents of the object."""
LARGEST_SIGMAS = 2.0
"""Displacement, in median standard deviations of the comparison, from which on a scan counts as misplaced; smaller ones harm little."""
ROUNDS = 5
"""Rounds of reweighting of the fit of a motion."""


class Placing(NamedTuple):
    """How a scan lies to the others."""

    compared: int  # pixels that another scan sees too
    displacement_m: float  # RMS over the compared pixels along their normals, of the small motion that fits best
    median_m: float  # median distance to the others, without a motion
    sigma_m: float  # median standard deviation of that distance
    misplaced: bool


class _Sample(NamedTuple):
    """Points of one scan that are compared with the others."""

    points: np.ndarray  # [n, 3] metres, world
    normals: np.ndarray  # [n, 3] unit, world
    variance: np.ndarray  # [n] square metres, of each point along its normal


def place_scans(scans: list[PreparedScan], voxel: float, *, device: str) -> list[Placing]:
    """Compare every scan with the others and find those that are misplaced, the worst first taken out of the comparison of the rest.

    Args:
        scans: with their poses.
        voxel: side of a voxel, metres; displacements below half of it do no harm.
        device: where to compute.
    """
    points = [world_points(scan) for scan in scans]
    extent = float(np.ptp(np.concatenate([given[0][::max(len(given[0]) // 1000, 1)] for given in points]), axis=0).max())
    reach = max(REACH * extent, 10 * voxel)
    chosen = []
    for number, (there, used) in enumerate(points):
        image = scans[number].image
        normal = np.asarray(image.normal).reshape(-1, 3)[used]
        usable = np.flatnonzero(normal.any(axis=1))
        picked = np.sort(np.random.default_rng(number).choice(usable, min(SAMPLES, len(usable)), replace=False))
        world = np.linalg.inv(image.camera_from_world)
        turned = normal[picked] @ world[:3, :3].T
        sight = there[picked] - world[:3, 3]
        depth = np.asarray(image.depth).ravel()[used[picked]].astype(np.float64)
        along = np.asarray(image.sigma).ravel()[used[picked]] / depth * np.einsum("ni,ni->n", turned, sight)
        chosen.append(_Sample(there[picked], turned, along**2))
    distances = _compared(scans, chosen, reach, device)
    left_out: set[int] = set()
    while True:
        placings = [_placing(chosen[number], *distances[number], left_out - {number}, voxel) for number in range(len(scans))]
        wrong = [number for number, placing in enumerate(placings) if placing.misplaced and number not in left_out]
        if not wrong:
            return [placing._replace(misplaced=number in left_out) for number, placing in enumerate(placings)]
        left_out.add(max(wrong, key=lambda number: placings[number].displacement_m))


def _compared(scans: list[PreparedScan], chosen: list[_Sample], reach: float, device: str) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return for each scan the distances of its points from every scan and their standard deviations, [n, scans] metres, 0 where there is
    none."""
    found = [(np.zeros((len(each.points), len(scans)), np.float32), np.zeros((len(each.points), len(scans)), np.float32))
             for each in chosen]
    last = 0
    while last < len(scans):
        first, size = last, 0
        while last < len(scans) and (last == first or size + scans[last].image.depth.size <= BATCH_PIXELS):
            size += scans[last].image.depth.size
            last += 1
        views = upload_views([scan.image for scan in scans[first:last]], np.zeros(3), device=device)
        for number, sample in enumerate(chosen):
            for whole, part in zip(found[number], compare_views(
                    views, *sample, skipped=number - first if first <= number < last else -1, reach=reach, device=device), strict=True):
                whole[:, first:last] = part
    return found


def _placing(sample: _Sample, distance: np.ndarray, expected: np.ndarray, left_out: set[int], voxel: float) -> Placing:
    """Return how a scan lies to those that are not left out."""
    known = expected > 0
    known[:, sorted(left_out)] = False
    seen = known.any(axis=1)
    if np.count_nonzero(seen) < LEAST_COMMON:
        return Placing(int(seen.sum()), 0.0, 0.0, 0.0, False)
    offset = np.nanmedian(np.where(known[seen], distance[seen], np.nan), axis=1).astype(np.float64)
    sigma = float(np.median(expected[seen][known[seen]]))
    place, normal = sample.points[seen] - sample.points[seen].mean(axis=0), sample.normals[seen]
    rows = np.concatenate([np.cross(place, normal), normal], axis=1)
    scale = np.array([1 / max(np.abs(place).max(), 1e-12)] * 3 + [1.0] * 3)
    weight, fit = np.ones(len(rows)), np.zeros(len(rows))
    for _ in range(ROUNDS):
        motion = np.linalg.lstsq((rows * scale) * weight[:, None], offset * weight, rcond=1e-6)[0]
        fit = (rows * scale) @ motion
        rest = np.abs(offset - fit)
        weight = np.sqrt(1 / (1 + (rest / max(1.5 * float(np.median(rest)), 1e-9)) ** 2))
    displacement = float(np.sqrt(np.mean(fit**2)))
    return Placing(int(seen.sum()), displacement, float(np.median(np.abs(offset))), sigma,
                   displacement > max(LARGEST_SIGMAS * sigma, voxel / 2))
