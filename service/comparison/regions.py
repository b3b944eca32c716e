"""Decide whether regions of a design are within their tolerances, by the means of their patches and σ (ISO 14253-1)."""

import csv
import io
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from service.boards.stitching.regions import Verdict
from service.boards.stitching.significance import threshold
from service.comparison.deviations import Patches
from service.comparison.surfaces import Design
from stage.sets.tolerance_regions import ToleranceRegion

REGIONS_FILE = "regions.csv"
SAMPLES = 40_000
"""Points of the design that tell how much of it the scan shows."""
LEAST_SAMPLES = 200
"""The fewest of them in a region: of a smaller one more are drawn."""
MOST_SAMPLES = 2_000_000
BESIDE, FACING = 1.5, 1.5
"""A point of the design is seen if a patch lies within this many sides of a patch, where normals at a right angle count as 2.1 of them."""


class RegionVerdict(NamedTuple):
    """The verdict of a scan on a region."""

    name: str
    verdict: Verdict
    low_m: float
    high_m: float
    """The limits."""
    mean_m: float | None
    """Mean deviation of the patches; None: there is none."""
    least_m: float | None
    least_sigma_m: float | None
    most_m: float | None
    most_sigma_m: float | None
    """The smallest and the largest deviation of a patch, and their σ."""
    seen: float
    """Part of the region that the scan shows."""
    patches: int
    strange: int
    """Number of patches above or below which the scan has points that do not belong to the design."""
    area_m2: float


def inside(region: ToleranceRegion, points: np.ndarray, normals: np.ndarray, unit_m: float) -> np.ndarray:
    """Return which points [n, 3] of the design, metres, with their normals [n, 3], lie in a region, [n] bool."""
    found = np.ones(len(points), dtype=bool)
    if region.box is not None:
        low, high = (np.array(corner) * unit_m for corner in region.box)
        found &= ((points >= low) & (points <= high)).all(axis=1)
    if region.facing is not None:
        found &= normals @ np.array(region.facing) >= np.cos(np.radians(region.within_deg))
    return found


def decide(regions: Sequence[ToleranceRegion], patches: Patches, strange: tuple[np.ndarray, np.ndarray], design: Design, *,
           unit_m: float, patch_m: float, false_alarm: float, least_seen: float, one_pose: bool) -> tuple[list[RegionVerdict], float]:
    """Decide about every region, and return with how many σ.

    A region fails if the mean of any patch is more than k σ outside of a limit, and passes if all are more than k σ inside of both, the
    scan shows enough of it, and nothing strange stands on it. k is that of as many one-sided tests as there are patches and limits
    (Bonferroni's bound). `strange`: places and normals of `deviations.standing_on`. `one_pose`: no other pose fits about as well: else
    nobody knows what lies in a part of the surface, and only the whole is decided."""
    of_region = [inside(region, patches.middle, patches.normal, unit_m) for region in regions]
    k = threshold(false_alarm, 2 * max(sum(int(each.sum()) for each in of_region), 1), sides=1)
    tree = cKDTree(_facing_points(patches.middle, patches.normal, patch_m)) if len(patches.middle) else None
    found = [_decide(region, patches, chosen, int(inside(region, *strange, unit_m).sum()), design, tree, k, unit_m, patch_m, least_seen)
             for region, chosen in zip(regions, of_region, strict=True)]
    if not one_pose:
        found = [each if region.is_whole or each.verdict is Verdict.NOT_INSPECTED else each._replace(verdict=Verdict.UNDECIDED)
                 for region, each in zip(regions, found, strict=True)]
    return found, k


def _decide(region: ToleranceRegion, patches: Patches, chosen: np.ndarray, strange: int, design: Design, tree: cKDTree | None, k: float,
            unit_m: float, patch_m: float, least_seen: float) -> RegionVerdict:
    low, high = (limit * unit_m for limit in region.tolerance)
    samples, part = _samples(region, design, unit_m, patch_m)
    seen = 0.0 if tree is None or not len(samples) else float((tree.query(samples)[0] <= BESIDE * patch_m).mean())
    deviation, sigma = patches.deviation[chosen], patches.sigma[chosen]
    if not len(deviation):
        return RegionVerdict(region.name, Verdict.NOT_INSPECTED, low, high, None, None, None, None, None, seen, 0, strange, part)
    least, most = int(deviation.argmin()), int(deviation.argmax())
    if ((deviation - k * sigma > high) | (deviation + k * sigma < low)).any():
        verdict = Verdict.FAIL
    elif seen < least_seen:
        verdict = Verdict.NOT_INSPECTED
    else:
        within = bool(((deviation + k * sigma <= high) & (deviation - k * sigma >= low)).all())
        verdict = Verdict.PASS if within and not strange else Verdict.UNDECIDED
    return RegionVerdict(region.name, verdict, low, high, float(np.average(deviation, weights=patches.points[chosen])),
                         float(deviation[least]), float(sigma[least]), float(deviation[most]), float(sigma[most]), seen, len(deviation),
                         strange, part)


def _facing_points(points: np.ndarray, normals: np.ndarray, patch_m: float) -> np.ndarray:
    """Return points [n, 3] with their normals [n, 3] as [n, 6], so that points of surfaces that face other ways are far from each other."""
    return np.concatenate([points, FACING * patch_m * normals], axis=1)


def _samples(region: ToleranceRegion, design: Design, unit_m: float, patch_m: float) -> tuple[np.ndarray, float]:
    """Return points that lie evenly in a region, [n, 6] of `_facing_points`, and its area, square metres."""
    count = SAMPLES
    while True:
        points, face = design.sample(count)
        chosen = inside(region, points, design.normals[face], unit_m)
        if chosen.sum() >= LEAST_SAMPLES or count >= MOST_SAMPLES:
            return (_facing_points(points[chosen], design.normals[face[chosen]], patch_m),
                    float(chosen.mean() * design.areas.sum()))
        count *= 5


def table(regions: Sequence[RegionVerdict]) -> str:
    """Return the verdicts as CSV."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(RegionVerdict._fields)
    for region in regions:
        writer.writerow(["" if value is None else f"{value:.9g}" if isinstance(value, float) else str(value) for value in region])
    return text.getvalue()
