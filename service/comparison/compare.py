"""Compare a scan with its design: read → place → deviations → verdicts → deviations.ply, regions.csv, comparison.png, report.json."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from service.boards.inspection_picture import HIGH, LOW, MIDDLE, OUTSIDE
from service.boards.stitching.regions import Verdict
from service.comparison.deviations import (
    REGIONS_FILE,
    Deviations,
    RegionVerdict,
    decide,
    deviations_of,
    inside,
    patches_of,
    standing_on,
    table,
)
from service.comparison.placing import Placement, place
from service.comparison.size import Size, size_of
from service.comparison.surfaces import Design, Offsets, ScannedSurface, read_design, read_scanned
from service.errors import RequestError
from service.relight.sheet import write_sheet
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.register import Alignment, CompareRequest
from service.scans.points.neighbours import neighbours_are_installed
from stage.files import write_text
from stage.formats.ply import COLOUR, NORMAL, POSITION, write_vertices
from stage.sets.scan_set import UNITS_M
from stage.sets.tolerance_regions import ToleranceRegion, read_tolerances
from stage.stack import fingerprint

DEVIATIONS_FILE = "deviations.ply"
REACH = 0.02
"""The part of the design's size within which points belong to it."""
PATCH_SPACINGS = 4.0
"""Side of a patch in distances of neighbouring points: it holds some sixteen."""
ROUNDED_SPACINGS = 4.0
"""The distance from the design, in those of neighbouring points, up to which a scan rounds its edges."""
SPACING_POINTS = 2000
"""Points whose distances to their neighbours are looked at."""
NEIGHBOUR = 4
"""The neighbour of a point that is one step away on a square grid."""
WHOLE = "whole surface"
FAR = 0.1
"""Part of the scan that does not belong to the design from which it is said."""
PICTURE_FILE = "comparison.png"
SIDE_PX = 480
BINS = 100
FULL_COLOUR = 99.0
"""The percentile of the sizes of the deviations that has the full colour."""
LEFT_OUT = np.array([0.35, 0.35, 0.37])
"""The colour of points that do not belong to the design."""
VIEWS = {"front": np.array([0.5, 0.35, 0.8]), "back": np.array([-0.5, -0.35, -0.8])}
"""Directions towards the viewer, in the frame of the design."""
LIT = 0.45
"""Share of the colour that surfaces keep where they turn away from the viewer."""


class CompareResult(NamedTuple):
    """The files of a comparison and its findings."""

    deviations_path: Path
    picture_path: Path
    report_path: Path
    regions_path: Path | None
    """None: nothing was judged."""
    median_m: float
    rms_m: float
    """Median and root mean square of the deviations."""
    sigma_m: float
    """Median of their σ."""
    placement_sigma_m: float
    """Largest standard deviation of the place of the surface by that of the pose."""
    smallest_fault_m: float
    """Side of the smallest fault that was looked for."""
    regions: tuple[RegionVerdict, ...]
    warnings: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether all regions are within their tolerances."""
        return all(region.verdict is Verdict.PASS for region in self.regions)


def compare(request: CompareRequest, progress: Progress | None = None) -> CompareResult:
    """Lay a scan on its design, and say by how much it deviates, how sure that is, and which regions are within their tolerances.
    Raises RequestError if small_gicp is not installed. Raises ScanError if the scan cannot be laid on the design. Raises StageError if a
    file is wrong, damaged or missing. Raises StorageError if the results cannot be written."""
    if not neighbours_are_installed():
        raise RequestError("a scan is laid on its design with small_gicp, which is not installed: pip install 'relit[scans]'")
    timings = Timings(progress)
    timings.stage("design", 1)
    regions, unit_m = _regions(request)
    device = devices.resolve(request.device)
    design = read_design(request.design, UNITS_M[request.design_unit], device=device)
    timings.stage("scan", 1)
    scan = read_scanned(request.scan, UNITS_M[request.scan_unit], request.sigma_m)
    reach = request.reach_m or REACH * design.size
    _check_limits(request, design, reach, regions, unit_m)
    timings.stage("place", 1)
    placement = _place(request, design, scan, reach, regions, unit_m)
    timings.stage("deviations", 1)
    found = deviations_of(design, scan, placement, reach)
    by_pose = np.einsum("mi,ij,mj->m", found.moves, placement.covariance, found.moves)
    sigma = np.sqrt(found.noise**2 + by_pose + request.shared_sigma_m**2)
    timings.stage("patches", 1)
    spacing = _spacing(scan.points)
    patch = PATCH_SPACINGS * spacing if request.smallest_fault_m is None else request.smallest_fault_m / 2
    patches = patches_of(found, design, placement, patch_m=patch, shared_m=request.shared_sigma_m)
    strange = standing_on(design, found, patches, patch_m=patch, rounded_m=min(ROUNDED_SPACINGS * spacing, reach))
    verdicts, k = decide(regions, patches, strange, design, unit_m=unit_m, patch_m=patch, false_alarm=request.false_alarm,
                         least_seen=request.least_seen, one_pose=not placement.rivals)
    size = size_of(patches, placement.pivot)
    warnings = _warnings(scan, placement, found, size, by_datum=any(region.datum for region in regions))
    if design.turned_edges:
        warnings.append(f"{request.design}: at {design.turned_edges} edges its faces turn their fronts opposite ways: points at faces that "
                        "are turned inward are not compared; make its normals consistent")
    timings.stage("write", 1)
    span = max(float(np.percentile(np.abs(found.distance), FULL_COLOUR)), 1e-12)  # the deviation that has the full colour, metres
    colours = colours_of(found, span)
    deviations_path, picture_path, report_path = (request.out / name for name in (DEVIATIONS_FILE, PICTURE_FILE, REPORT_FILE))
    _write_ply(deviations_path, scan, found, sigma, colours)
    write_picture(picture_path, found, colours, span, spacing)
    regions_path = request.out / REGIONS_FILE if verdicts else None
    if regions_path is not None:
        write_text(regions_path, table(verdicts))
    write_text(report_path, report(
        request, inputs={"scan": _input(request.scan), "design": _input(request.design)}, device=devices.describe(device),
        timings_s=timings.close(), placement=_placement_facts(placement, size), deviations=_facts(found, sigma, len(scan.points), span),
        sigma_source=scan.sigma_source, reach_m=reach, smallest_fault_m=2 * patch, patches=len(patches.deviation),
        patch_shared_error_m=patches.shared_m, decided_at_sigma=round(k, 3), regions=[region._asdict() for region in verdicts],
        warnings=warnings))
    return CompareResult(deviations_path, picture_path, report_path, regions_path, float(np.median(found.distance)),
                         float(np.sqrt(np.mean(found.distance**2))), float(np.median(sigma)), placement.sigma_m, 2 * patch,
                         tuple(verdicts), tuple(warnings))


def _regions(request: CompareRequest) -> tuple[list[ToleranceRegion], float]:
    """Return the regions that are judged, and the unit of their boxes and limits in metres."""
    regions: list[ToleranceRegion] = []
    unit_m = 1.0
    if request.regions is not None:
        tolerances = read_tolerances(request.regions)
        regions, unit_m = list(tolerances.regions), UNITS_M[tolerances.unit]
    if request.tolerance_m is not None:
        low, high = request.tolerance_m
        regions.append(ToleranceRegion(name=WHOLE, tolerance=(low / unit_m, high / unit_m)))
    return regions, unit_m


def _check_limits(request: CompareRequest, design: Design, reach_m: float, regions: list[ToleranceRegion], unit_m: float) -> None:
    """Refuse limits that no deviation which is looked for exceeds, and faults that are larger than the part."""
    for region in regions:
        low, high = (1e3 * limit * unit_m for limit in region.tolerance)
        if min(-low, high) >= 1e3 * reach_m:
            where = "--tolerance-m" if region.name == WHOLE else f"{request.regions}: region {region.name}"
            raise RequestError(f"{where}: allows {low:+.4g} to {high:+.4g} mm, but deviations are looked for up to "
                               f"{1e3 * reach_m:.3g} mm, so that nothing can fail: check their unit, or give a larger --reach-m")
    if request.smallest_fault_m is not None and request.smallest_fault_m > design.size:
        raise RequestError(f"--smallest-fault-m {request.smallest_fault_m:g}: is larger than the design, which is "
                           f"{design.size:.3g} m large: give it in metres")


def _place(request: CompareRequest, design: Design, scan: ScannedSurface, reach: float, regions: list[ToleranceRegion], unit_m: float
           ) -> Placement:
    datums = [region for region in regions if region.datum]
    if request.align is Alignment.NONE:
        if datums:
            raise RequestError(f"--align none: the scan stays where it is, but region {datums[0].name} is a datum: leave one of them out")
        return Placement(np.eye(4), design.points.mean(axis=0), np.zeros((6, 6)), 0, 0, 0.0)

    def of_datum(found: Offsets) -> np.ndarray:
        return np.any([inside(region, found.at, design.normals[found.face], unit_m) for region in datums], axis=0)

    return place(design, scan, search=request.align is Alignment.SEARCH, reach_m=reach, datum=of_datum if datums else None)


def _spacing(points: np.ndarray) -> float:
    """Return the median distance of a point to its fourth neighbour, which on a square grid is one step."""
    from scipy.spatial import cKDTree

    chosen = points[np.random.default_rng(0).permutation(len(points))[:SPACING_POINTS]]
    return float(np.median(cKDTree(points).query(chosen, k=NEIGHBOUR + 1)[0][:, NEIGHBOUR]))


def _warnings(scan: ScannedSurface, placement: Placement, found: Deviations, size: Size | None, *, by_datum: bool) -> list[str]:
    warnings = []
    if size is not None:
        warnings.append(f"the scan is {size.factor:.5f} times as large as the design (± {size.sigma:.1g}), as where the calibration of the "
                        "scanner, a unit or a temperature is off: deviations hold that too")
    if placement.rivals:
        warnings.append(f"{placement.rivals} other poses fit about as well, as of a part that looks the same when it is turned: regions "
                        "may be those of another side, and none is decided; place the scan roughly, and give --align refine")
    if placement.held and by_datum:
        warnings.append(f"the datum regions leave {placement.held} of 6 motions of the scan open: they are as the whole surface has them")
    elif placement.held:
        warnings.append(f"the surface leaves {placement.held} of 6 motions of the scan open, as that of a cylinder about its axis: they "
                        "stay as they are, and what is shifted along the surface is not seen")
    if (far := 1 - len(found.near) / len(scan.points)) > FAR:
        warnings.append(f"{far:.0%} of the scan lie farther from the design than --reach-m, or face another way, and are not compared: a "
                        "fixture, or a larger fault")
    if scan.sigma_source == "estimated":
        warnings.append("the file of the scan has no σ: it is taken from the scatter of the points, without errors that neighbours share: "
                        "give --shared-sigma-m")
    return warnings


def _input(path: Path) -> dict[str, Any]:
    return {"path": str(path)} if path.is_dir() else {"path": str(path), "content": fingerprint.digest(path)}


def _placement_facts(placement: Placement, size: Size | None) -> dict[str, Any]:
    return {"design_from_scan": placement.pose.tolist(), "pivot_m": placement.pivot.tolist(), "covariance": placement.covariance.tolist(),
            "sigma_m": placement.sigma_m, "other_poses": placement.rivals, "open_motions": placement.held,
            **({} if size is None else {"size_factor": size.factor, "size_factor_sigma": size.sigma})}


def _facts(found: Deviations, sigma: np.ndarray, points: int, span: float) -> dict[str, Any]:
    low, median, high = np.percentile(found.distance, (2.5, 50, 97.5))
    count, edges = np.histogram(found.distance, bins=BINS, range=(-span, span))
    return {"points": points, "compared": len(found.near), "mean_m": float(found.distance.mean()), "median_m": float(median),
            "rms_m": float(np.sqrt(np.mean(found.distance**2))), "least_m": float(found.distance.min()),
            "most_m": float(found.distance.max()), "p2_5_m": float(low), "p97_5_m": float(high), "sigma_median_m": float(np.median(sigma)),
            "histogram": {"edges_m": edges.tolist(), "points": count.tolist(), "below": int((found.distance < -span).sum()),
                          "above": int((found.distance > span).sum())}}


def _write_ply(path: Path, scan: ScannedSurface, found: Deviations, sigma: np.ndarray, colours: np.ndarray) -> None:
    """Write the placed scan with its deviations and their σ, NaN where a point does not belong to the design."""
    measured = np.full((len(scan.points), 2), np.nan)
    measured[found.near] = np.column_stack([found.distance, sigma])
    write_vertices(path, {POSITION: found.placed, NORMAL: found.normals, ("deviation", "sigma"): measured,
                          COLOUR: np.rint(255 * colours).astype(np.uint8)}, faces=scan.faces,
                   comments=("deviations from a design by relit compare", "coordinates in metres, in the frame of the design"))


def colours_of(found: Deviations, span_m: float) -> np.ndarray:
    """Return the colour of each point of the scan, [n, 3] from 0 to 1: blue inside of the design, red outside, grey far from it."""
    part = np.clip(found.distance / span_m, -1, 1)[:, None]
    colours = np.tile(LEFT_OUT, (len(found.placed), 1))
    colours[found.near] = MIDDLE + np.where(part < 0, LOW - MIDDLE, HIGH - MIDDLE) * np.abs(part)
    return colours


def write_picture(path: Path, found: Deviations, colours: np.ndarray, span_m: float, spacing_m: float) -> None:
    """Write two views and the histogram as one PNG.
    `colours`: [n, 3] of `colours_of`, whose full colour is at `span_m`. `spacing_m`: the distance of neighbouring points."""
    views = [(f"from the {name}, {-1e3 * span_m:.3g} to {1e3 * span_m:.3g} mm", _view(found, colours, toward, spacing_m))
             for name, toward in VIEWS.items()]
    write_sheet(path, [[*views, ("deviations, share of the points", _histogram(found, span_m))]], height=SIDE_PX)


def _view(found: Deviations, colours: np.ndarray, toward: np.ndarray, spacing_m: float) -> np.ndarray:
    toward = toward / np.linalg.norm(toward)
    right = np.cross([0.0, 1.0, 0.0], toward)
    right /= np.linalg.norm(right)
    frame = np.stack([right, np.cross(toward, right), toward])
    points = found.placed @ frame.T
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    scale = (SIDE_PX - 20) / max(float((high - low).max()), 1e-12)
    col, row = np.rint((points[:, :2] - (low + high) / 2) * scale * [1, -1] + SIDE_PX / 2).astype(int).T
    facing = found.normals @ toward
    order = np.argsort(points[:, 2])
    order = order[facing[order] > 0]
    shown = colours[order] * (LIT + (1 - LIT) * facing[order])[:, None]
    image = np.tile(OUTSIDE, (SIDE_PX, SIDE_PX, 1))
    half = int(np.clip(np.ceil(0.6 * spacing_m * scale), 1, 8))
    for down in range(-half, half + 1):
        for along in range(-half, half + 1):
            if down * down + along * along <= half * half:  # the nearest comes last at each offset, and the middle last of all
                image[(row[order] + down).clip(0, SIDE_PX - 1), (col[order] + along).clip(0, SIDE_PX - 1)] = shown
    image[row[order], col[order]] = shown
    return image.astype(np.float32)


def _histogram(found: Deviations, span_m: float) -> np.ndarray:
    count, edges = np.histogram(np.clip(found.distance, -span_m, span_m), bins=BINS, range=(-span_m, span_m))
    height = np.rint(count / max(count.max(), 1) * (SIDE_PX - 20)).astype(int)
    image = np.tile(OUTSIDE, (SIDE_PX, SIDE_PX, 1))
    wide = SIDE_PX // BINS
    for number, (tall, middle) in enumerate(zip(height, (edges[1:] + edges[:-1]) / 2, strict=True)):
        part = abs(middle) / span_m
        colour = MIDDLE + ((LOW if middle < 0 else HIGH) - MIDDLE) * part
        image[SIDE_PX - 10 - tall:SIDE_PX - 10, number * wide + (SIDE_PX - BINS * wide) // 2:][:, :wide] = colour
    return image.astype(np.float32)
