"""The deviation of each point of a placed scan from its design with its σ, and the means over patches, by which regions of the design are
judged to be within their tolerances or not (ISO 14253-1).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from service.boards.stitching.regions import Verdict
from service.boards.stitching.significance import threshold
from service.comparison.patch_errors import shared_error
from service.comparison.placing import ALIKE, Placement, gradient
from service.comparison.surfaces import Design, Offsets, ScannedSurface
from service.scans.points.cloud import cell_numbers
from service.scans.points.rigid import applied
from stage.errors import ScanError
from stage.formats.csv_table import table_text
from stage.sets.tolerance_regions import ToleranceRegion

BATCH = 1 << 18
"""Points that are looked at together, which bounds the memory."""
LEAST_POINTS = 4
"""The fewest points of a patch that is judged."""
BY_CHANCE = 1e-5
"""Probability of a scatter in a patch from which σ of the points does not explain it, and the scatter itself counts."""
ACROSS, TURNED = 0.2, 0.2
"""Standard deviation of the place of a surface along itself, in distances of neighbouring points: scans round edges by about their
resolution. Times the length by which the mean normals of scan and design differ it is an error across the surface, which the points of a
patch share. Shorter ones are noise of the normals."""
NEARBY = 0.25
"""The part of the design's size within which points that do not lie on it are taken for something that stands on it."""
SAMPLES, BESIDE, AROUND = 40_000, 0.1, 16
"""Points of the design on which others may stand, how far beside the surface these may lie along it, in sides of a patch, and how many
points of the design tell whether there is an edge."""
REGIONS_FILE = "regions.csv"
REGION_SAMPLES = 40_000
"""Points of the design that tell how much of it the scan shows."""
LEAST_SAMPLES = 200
"""The fewest of them in a region: of a smaller one more are drawn."""
MOST_SAMPLES = 2_000_000
REGION_BESIDE, FACING = 1.5, 1.5
"""A point of the design is seen if a patch lies within this many sides of a patch, where normals at a right angle count as 2.1 of them."""


class Deviations(NamedTuple):
    """The deviations of the points that belong to the design; n points of the scan, m of these."""

    placed: np.ndarray  # [n, 3] float32 metres, frame of the design
    normals: np.ndarray  # [n, 3] float32
    near: np.ndarray  # [m] int64: the points that belong to the design
    distance: np.ndarray  # [m] float64 metres, positive outside
    at: np.ndarray  # [m, 3] metres: their nearest points of the design
    face: np.ndarray  # [m] int32
    moves: np.ndarray  # [m, 6] float32: what a small motion of the scan adds to the distance
    noise: np.ndarray  # [m] metres: σ of the point itself
    turned: np.ndarray  # [m, 3] float32: its normal less that of the design; 0 where that is not its own


class Patches(NamedTuple):
    """Means of deviations over patches of the surface."""

    middle: np.ndarray  # [p, 3] metres, frame of the design
    normal: np.ndarray  # [p, 3] of the design there, unit
    deviation: np.ndarray  # [p] metres
    sigma: np.ndarray  # [p] metres
    points: np.ndarray  # [p] number of points
    shared_m: float
    """Standard deviation of errors that the points of a patch share, which σ holds."""


def deviations_of(design: Design, scan: ScannedSurface, placement: Placement, reach_m: float) -> Deviations:
    """Return how far the points of a placed scan lie from the design, those that are nearer than a reach and face as it does; ScanError if
    there is none."""
    pose = placement.pose
    placed, normals = applied(pose, scan.points), scan.normals @ pose[:3, :3].T
    parts: list[Offsets] = []
    for first in range(0, len(placed), BATCH):
        found = design.offsets(placed[first:first + BATCH], reach_m)
        alike = np.einsum("ni,ni->n", normals[first + found.near], design.normals[found.face]) > ALIKE
        parts.append(Offsets(found.near[alike] + first, *(each[alike] for each in found[1:])))
    near, distance, across, at, face = (np.concatenate(each) for each in zip(*parts, strict=True))
    if not len(near):
        raise ScanError(f"the scan does not lie on the design: no point comes within {1e3 * reach_m:.3g} mm of it and faces the same way")
    turned = (normals[near] - design.normals[face]) * scan.told[near, None]
    return Deviations(placed.astype(np.float32), normals.astype(np.float32), near, distance, at, face,
                      gradient(at, across, placement.pivot).astype(np.float32), scan.sigma[near], turned.astype(np.float32))


def standing_on(design: Design, found: Deviations, patches: Patches, *, patch_m: float, rounded_m: float
                ) -> tuple[np.ndarray, np.ndarray]:
    """Return places of the design [k, 3], metres, and its normals there [k, 3], above or below which enough points for a patch lie that do
    not belong to it: something else stands there, or the part is not what was designed. They stand on what is nearest, and on what is
    before or behind them and faces as they do: the floor of a deep pocket may be nearer to the other side of its wall. Points that come
    within `rounded_m` of both sides of an edge are that edge, as the scan rounds it."""
    others, normals = (np.delete(each, found.near, axis=0).astype(np.float64) for each in (found.placed, found.normals))
    reach = NEARBY * design.size
    samples, face = design.sample(SAMPLES)
    away = ~_at_edge(samples, design.normals[face], others, rounded_m)
    others, normals = others[away], normals[away]
    there = [design.offsets(others, reach)]
    tree = cKDTree(np.concatenate([samples, reach * design.normals[face]], axis=1))
    nearest = tree.query(np.concatenate([others, reach * normals], axis=1))[1]
    across = design.normals[face[nearest]]
    height = np.einsum("ni,ni->n", others - samples[nearest], across)
    alike = (np.abs(height) < reach) & (np.einsum("ni,ni->n", normals, across) > ALIKE)
    there.append(design.offsets((others - height[:, None] * across)[alike], BESIDE * patch_m))
    usual = float(np.median(patches.points)) / 2 if len(patches.points) else 0.0
    places: list[tuple[np.ndarray, np.ndarray]] = []
    for each in there:
        _, first, count = np.unique(np.floor(each.at / patch_m).astype(np.int64), axis=0, return_index=True, return_counts=True)
        many = first[count >= max(usual, LEAST_POINTS)]
        places.append((each.at[many], design.normals[each.face[many]]))
    at, facing = (np.concatenate(each) for each in zip(*places, strict=True))
    return at, facing


def _at_edge(samples: np.ndarray, facing: np.ndarray, points: np.ndarray, within_m: float) -> np.ndarray:
    """Return which points [n, 3] have samples of a surface around them, [k, 3] with their normals [k, 3], of two sides of an edge."""
    near, found = cKDTree(samples).query(points, k=AROUND, distance_upper_bound=within_m)
    cosine = np.einsum("nki,ni->nk", *(np.append(facing, [[0, 0, 0]], axis=0)[each] for each in (found, found[:, 0])))
    return np.asarray((np.isfinite(near) & (np.abs(cosine) < ALIKE)).any(axis=1))


def patches_of(found: Deviations, design: Design, placement: Placement, *, patch_m: float, shared_m: float) -> Patches:
    """Return the means over patches: the points of a cell of a side in metres that face about the same way."""
    normal = design.normals[found.face]
    largest = np.abs(normal).argmax(axis=1)
    facing = 2 * largest + (normal[np.arange(len(normal)), largest] > 0)
    _, of_point, count = np.unique(cell_numbers(found.at, patch_m) * 6 + facing, return_inverse=True, return_counts=True)
    kept = count >= LEAST_POINTS

    def mean(values: np.ndarray) -> np.ndarray:
        columns = [np.bincount(of_point, column, minlength=len(count)) / count for column in np.atleast_2d(values.T)]
        return np.stack(columns, axis=1)[kept]

    moves = mean(found.moves.astype(np.float64))
    deviation = mean(found.distance)[:, 0]
    scatter = np.maximum(mean(found.distance**2)[:, 0] - deviation**2, 0) * count[kept] / (count[kept] - 1)
    noise = mean(found.noise**2)[:, 0]
    unlike = scatter > noise * chdtri(count[kept] - 1, BY_CHANCE) / (count[kept] - 1)  # stray points, or a fault in a part of the patch
    noise = np.where(unlike, scatter, noise)
    middle, across = mean(found.at), mean(normal)
    turned = np.linalg.norm(mean(found.turned), axis=1)
    spacing = patch_m / np.sqrt(np.median(count[kept])) if kept.any() else 0.0
    alone = noise / count[kept] + np.where(turned > TURNED, ACROSS * spacing * turned, 0) ** 2  # each patch without those around
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
    together = shared_error(deviation, alone, middle, across, patch_m)
    noise = alone + np.minimum(together**2, noise) * (1 - 1 / count[kept])  # a mean errs by no more than its points
    pose = np.einsum("pi,ij,pj->p", moves, placement.covariance, moves)
    return Patches(middle, across, deviation, np.sqrt(noise + pose + shared_m**2), count[kept], together)


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
    seen = 0.0 if tree is None or not len(samples) else float((tree.query(samples)[0] <= REGION_BESIDE * patch_m).mean())
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
    count = REGION_SAMPLES
    while True:
        points, face = design.sample(count)
        chosen = inside(region, points, design.normals[face], unit_m)
        if chosen.sum() >= LEAST_SAMPLES or count >= MOST_SAMPLES:
            return (_facing_points(points[chosen], design.normals[face[chosen]], patch_m),
                    float(chosen.mean() * design.areas.sum()))
        count *= 5


def table(regions: Sequence[RegionVerdict]) -> str:
    """Return the verdicts as CSV."""
    return table_text(RegionVerdict._fields, ([f"{value:.9g}" if isinstance(value, float) else value for value in region]
                                              for region in regions))
