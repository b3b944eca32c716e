"""Inspect a board and write board.exr, deviation.exr, findings.csv, inspection.png and report.json.

The way of the data: tiles (depth results, or captures that the depth product decodes) → service/boards/stitching/stitching.py (where every
tile lies, by all overlaps at once) → blended on the grid of the nominal heights → registered to them → deviation, less a plane → windows
and regions judged by σ → the files.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import binary_closing, binary_erosion, binary_fill_holes, map_coordinates

from kernels import device as devices
from service.boards.findings import FINDINGS_FILE, Defect, entries, find_areas, find_defects, findings_csv, six_digits
from service.boards.height_files import BOARD_FILE, Match, Nominal, check_size, match, read_design, read_golden, write_board
from service.boards.inspection_picture import PICTURE_FILE, Frame, write_picture
from service.boards.shared_deviation import SharedDeviation, shared_deviation
from service.boards.stitching.form import bow_and_twist, fit_form, fit_spline
from service.boards.stitching.grid import HeightMap
from service.boards.stitching.overlap import Evidence
from service.boards.stitching.regions import RegionResult, Verdict, check_regions, tolerances_over, too_wide
from service.boards.stitching.significance import Scan, compare, scan_windows
from service.boards.stitching.stitching import Stitched, blend, stitch
from service.boards.tiles import BoardTiles, check_lengths, read_tiles, without_hidden_outliers
from service.depth.base.solution import statistics
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.inspect_board import BoardForm, InspectBoardRequest
from stage.errors import BoardError
from stage.files import write_text
from stage.formats import exr
from stage.results.result_metadata import result_metadata
from stage.stack.fingerprint import digest

DEVIATION_FILE = "deviation.exr"
METHOD = "board inspection"
REGISTER_STEPS = 100
"""Steps of the progress of the registration."""
LEAST_STIFF = 8
"""The least distance of the knots of a spline, in sides of the smallest defect: of a defect half as wide it takes less than 1 %."""
LEAST_OF_REGIONS = 0.9
"""The least part of a region, and of a board with regions, that must be inspected, where neither it nor the request says it."""
SMALLEST_PX = 3
"""Side of the smallest defect in pixels, where the request names none."""


class InspectBoardResult(NamedTuple):
    """The files and findings of an inspection that was written."""

    board_path: Path
    report_path: Path
    picture_path: Path
    findings_path: Path | None
    """The findings.csv; None if there was nothing to compare with."""
    verdict: Verdict | None
    """The verdict on the whole board; None if there was nothing to compare with."""
    defects: list[Defect]
    regions: list[RegionResult]
    inspected: float | None
    """Part of the nominal pixels that was inspected."""
    heights: HeightMap
    warnings: tuple[str, ...]
    """A sentence for each thing that does not fit on the whole board."""


class _Judged(NamedTuple):
    nominal: Nominal
    match: Match
    deviation: HeightMap
    shared: SharedDeviation | None
    bow_m: float
    wanted: np.ndarray  # [rows, cols] bool: pixels with a nominal height, but for a frame that is narrower than a defect
    inspected: np.ndarray  # [rows, cols] bool
    scan: Scan
    defects: list[Defect]
    regions: list[RegionResult]
    region_threshold: float
    verdict: Verdict


def inspect_board(request: InspectBoardRequest, progress: Progress | None = None) -> InspectBoardResult:
    """Inspect a board; nothing is written where tiles or heights do not fit together."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    nominal = None
    if request.golden is not None:
        nominal = read_golden(request.golden, request.regions)
    elif request.design is not None:
        nominal = read_design(request.design)
    board = read_tiles(request.board, device=device, cache=request.cache, progress=timings)
    stitched = stitch_board(board, request.pixel_m, request.placement_m, timings)
    if nominal is None:
        timings.stage("blend", len(board.tiles))
        heights, judged = blend(board.tiles, stitched, stitched.grid, progress=timings.advance), None
        heights = heights._replace(height=heights.height - fit_form(heights.grid, heights.height, quadratic=False).over(heights.grid))
    else:
        heights, judged = _judge(board, stitched, nominal, request, timings)
    warnings = stitched.warnings + ([] if judged is None else judged.match.warnings)
    if judged is not None and judged.shared is not None:
        warnings += judged.shared.sentences()
    timings.stage("write", 1)
    contents = {name: digest(path) for name, path in (("golden", None if nominal is None or request.golden is None else nominal.path),
                                                      ("regions", request.regions), ("design", request.design)) if path is not None}
    provenance = metadata(request, capture=board.scan.name, inputs=" ".join(board.contents.values()), method=METHOD, contents=contents)
    write_board(request.out / BOARD_FILE, heights, provenance)
    findings_path = None
    if judged is not None:
        _write_deviation(request.out / DEVIATION_FILE, judged, provenance)
        areas, area_count = find_areas(judged.deviation.grid, judged.wanted & ~judged.inspected)
        findings_path = request.out / FINDINGS_FILE
        write_text(findings_path, findings_csv(judged.defects, judged.regions, areas))
    picture_path, report_path = request.out / PICTURE_FILE, request.out / REPORT_FILE
    write_picture(picture_path, heights, *((None, None, None, (), ()) if judged is None else (
        judged.deviation, judged.inspected, judged.wanted, judged.defects,
        [Frame(each.region.centre_m, each.region.size_m, each.verdict) for each in judged.regions])))
    write_text(report_path, report(
        request,
        inputs={"board": str(request.board), "name": board.scan.name, "tiles": board.contents, **contents},
        method=METHOD, stitching=stitching_entries(board, stitched), warnings=warnings, device=devices.describe(device),
        height={"pixel_m": heights.grid.pixel_m, "resolution": [heights.grid.cols, heights.grid.rows],
                "top_left_m": [heights.grid.left_m, heights.grid.top_m], "measured_pixels": int(heights.measured.sum()),
                "sigma_m": statistics(heights.sigma[heights.measured])},
        **({} if judged is None else {"comparison": _comparison(judged, area_count), **entries(judged.defects, judged.regions)}),
        timings_s=timings.close()))
    if judged is None:
        return InspectBoardResult(request.out / BOARD_FILE, report_path, picture_path, None, None, [], [], None, heights, tuple(warnings))
    return InspectBoardResult(request.out / BOARD_FILE, report_path, picture_path, findings_path, judged.verdict, judged.defects,
                              judged.regions, float(judged.inspected.sum() / judged.wanted.sum()), heights, tuple(warnings))


def stitch_board(board: BoardTiles, pixel_m: float | None, placement_m: float | None, timings: Timings) -> Stitched:
    """Find where every tile of a board lies; `pixel_m` and `placement_m` as in the request."""
    check_lengths(board, pixel_m=pixel_m, placement_m=placement_m)
    timings.stage("register", REGISTER_STEPS)
    try:
        found = stitch(board.tiles, shift_sigma_m=board.scan.stage_sigma_m, turn_sigma_degrees=board.scan.stage_sigma_degrees,
                       pixel_m=pixel_m, progress=lambda share: timings.advance(int(share * REGISTER_STEPS)))
    except BoardError as error:
        raise BoardError(f"{board.path}: {error}") from error
    timings.advance(REGISTER_STEPS)
    return found


def _judge(board: BoardTiles, stitched: Stitched, nominal: Nominal, request: InspectBoardRequest,
           timings: Timings) -> tuple[HeightMap, _Judged]:
    """Compare the board with its nominal heights; the height map that is returned lies on their grid."""
    grid = nominal.heights.grid
    timings.stage("match", 2 * len(board.tiles))
    first = blend(board.tiles, stitched, grid, progress=timings.advance)
    check_size(first, board.tiles, stitched, nominal)
    found = match(first, stitched, nominal, placement_m=request.placement_m)
    tiles = []
    for tile, own in zip(board.tiles, stitched.motions.values, strict=True):
        x, y, z = tile.moved(own + found.motion, centre=stitched.centre, length_m=stitched.length_m)
        tiles.append(without_hidden_outliers(tile, z - map_coordinates(nominal.heights.height, grid.place(x, y), order=1, cval=np.nan)))
    heights = blend(tiles, stitched, grid, motion=found.motion, relief=nominal.heights.height,
                    progress=lambda done: timings.advance(len(tiles) + done))
    timings.stage("judge", 1)
    deviation = compare(heights, nominal.heights, shift_sigma_m=found.shift_sigma_m)
    plane = fit_form(grid, deviation.height, quadratic=False)
    curved = fit_form(grid, deviation.height, quadratic=True)
    smallest = SMALLEST_PX if request.smallest_defect_m is None else max(1, round(request.smallest_defect_m / grid.pixel_m))
    stiffness = max(grid.size_m) / 4 if request.stiffness_m is None else request.stiffness_m
    if request.remove is BoardForm.SPLINE:
        if stiffness < LEAST_STIFF * smallest * grid.pixel_m:
            raise BoardError(f"{nominal.path}: --stiffness-m {stiffness:.3g} is less than {LEAST_STIFF} smallest defects, which the spline "
                             "would take away: give a larger one, or a smaller --smallest-defect-m")
        spline = fit_spline(grid, deviation.height, knots_m=stiffness)
        deviation = deviation._replace(height=deviation.height - spline.over(grid),
                                       systematic=np.hypot(deviation.systematic, spline.sigma(grid)))
    else:
        deviation = deviation._replace(height=deviation.height - (curved if request.remove is BoardForm.QUADRATIC else plane).over(grid))
    heights = heights._replace(height=heights.height - plane.over(grid))
    if smallest > min(grid.rows, grid.cols):
        raise BoardError(f"{nominal.path}: --smallest-defect-m {request.smallest_defect_m:g} is larger than the board")
    tolerance = tolerances_over(grid, nominal.regions, elsewhere_m=request.tolerance_m)
    found.warnings.extend(too_wide(nominal.heights, nominal.regions, elsewhere_m=request.tolerance_m, smallest_m=smallest * grid.pixel_m))
    scan = scan_windows(deviation, tolerance_m=tolerance, false_alarm=request.false_alarm / 2, smallest_px=smallest)
    wanted = _asked(nominal.heights.measured, smallest)
    inspected = wanted & np.isfinite(scan.mean_sigma)  # a hole with enough measured pixels around it hides no defect
    if request.must_find_m is not None:
        inspected &= np.nan_to_num(scan.findable, nan=np.inf) <= request.must_find_m
    defects, significant = find_defects(deviation, scan, tolerance)
    scan = scan._replace(significant=significant)
    inspected |= wanted & significant & deviation.measured
    regions, k = check_regions(deviation, nominal.regions, false_alarm=request.false_alarm / 2,
                               least_inspected=LEAST_OF_REGIONS if request.least_inspected is None else request.least_inspected)
    shared = shared_deviation(deviation, nominal.heights)
    return heights, _Judged(nominal, found, deviation, shared, bow_and_twist(curved, grid), wanted, inspected, scan, defects, regions, k,
                            _verdict(defects, regions, inspected, wanted, request))


def _asked(nominal: np.ndarray, smallest_px: int) -> np.ndarray:
    """Return the pixels, [rows, cols] bool, that must be inspected: those with a nominal height but for the frame around all that is
    narrower than the smallest defect, which no board that is placed anew covers."""
    solid = binary_fill_holes(binary_closing(np.pad(nominal, smallest_px), iterations=smallest_px))
    inner = binary_erosion(solid, iterations=smallest_px - 1) if smallest_px > 1 else solid
    cut = slice(smallest_px, -smallest_px)
    asked = nominal & inner[cut, cut]
    return asked if asked.any() else nominal


def _verdict(defects: list[Defect], regions: list[RegionResult], inspected: np.ndarray, wanted: np.ndarray,
             request: InspectBoardRequest) -> Verdict:
    """Return the verdict about the whole board: the worst of all, and no pass with too little inspected."""
    verdicts = [result.verdict for result in regions]
    if defects:
        verdicts.append(Verdict.FAIL)
    least = (LEAST_OF_REGIONS if regions else 1.0) if request.least_inspected is None else request.least_inspected
    if inspected.sum() < least * wanted.sum():
        verdicts.append(Verdict.NOT_INSPECTED)
    return Verdict.worst(verdicts)


def _write_deviation(path: Path, judged: _Judged, provenance: dict[str, str]) -> None:
    """Write deviation.exr: deviation, σ, score, mask (inspected) and defect (1 in significant areas), 0 where nothing is known."""
    deviation, scan = judged.deviation, judged.scan
    known = deviation.measured
    layers: dict[str, np.ndarray] = {"deviation.Z": deviation.height, "sigma.Z": deviation.sigma, "score.Y": np.where(known, scan.score, 0)}
    channels = {name: np.where(known, values, 0).astype(np.float32) for name, values in layers.items()}
    exr.write(path, {**channels, "mask.Y": judged.inspected.astype(np.float16), "defect.Y": scan.significant.astype(np.float16)},
              color_space=exr.DATA, metadata=result_metadata(deviation.grid.camera(), provenance))


def stitching_entries(board: BoardTiles, stitched: Stitched) -> dict[str, Any]:
    """Return where the tiles lie, and what their overlaps said, for a report."""
    motions, length = stitched.motions, stitched.length_m
    tiles = []
    for number, tile in enumerate(board.tiles):
        x, y = (tile.middle - stitched.centre) / length
        motion = motions.values[number]
        to_middle = np.array([[1, 0, -y, 0, 0, 0], [0, 1, x, 0, 0, 0]])
        shift = to_middle @ motion
        sigma = np.sqrt(np.diag(to_middle @ motions.of_tile(number) @ to_middle.T))
        tiles.append({"tile": tile.name, "shift_m": [float(f"{value:.4g}") for value in shift],
                      "shift_sigma_m": [float(f"{value:.3g}") for value in sigma],
                      "rotation_degrees": float(f"{np.degrees(motion[2] / length):.4g}"),
                      "height_m": float(f"{motion[3] + motion[4] * x + motion[5] * y:.4g}"),
                      "slope": [float(f"{value / length:.4g}") for value in motion[4:]]})
    overlaps = [{"tiles": [board.tiles[i].name, board.tiles[j].name], "evidence": str(overlap.evidence), "pixels": overlap.pixels,
                 "correlation": float(f"{overlap.correlation:.4g}"), "residual_m": float(f"{overlap.residual_m:.4g}"),
                 "noise_factor": float(f"{overlap.noise_factor:.4g}"),
                 "used": "nothing" if overlap.evidence is Evidence.DIFFERS else
                         "height" if overlap.evidence is Evidence.FLAT or (i, j) in motions.contradicted else "height and shift"}
                for (i, j), overlap in stitched.overlaps.items()]
    return {"tiles": tiles, "overlaps": overlaps, "noise_factor": float(f"{stitched.noise_factor:.4g}"),
            "shared_sigma_m": float(f"{stitched.shared_m:.4g}")}


def _comparison(judged: _Judged, area_count: int) -> dict[str, Any]:
    scan, found = judged.scan, judged.match
    known = judged.deviation.measured
    return {
        "nominal": judged.nominal.name, "verdict": str(judged.verdict),
        "registration": {"evidence": str(found.evidence), "shift_m": [float(f"{value:.4g}") for value in found.motion[:2]],
                         "shift_sigma_m": [float(f"{value:.3g}") for value in found.shift_sigma_m],
                         "correlation": float(f"{found.correlation:.4g}")},
        "bow_and_twist_m": float(f"{judged.bow_m:.4g}"),
        "shared": None if judged.shared is None else {
            name: {"value": six_digits(factor.value), "sigma": float(f"{factor.sigma:.3g}")}
            for name, factor in judged.shared.named().items()},
        "deviation_m": statistics(judged.deviation.height[known]), "sigma_m": statistics(judged.deviation.sigma[known]),
        "windows": {"sides_px": list(scan.sides_px), "tests": scan.tests, "threshold_sigma": float(f"{scan.threshold:.4g}"),
                    "spread": {str(side): float(f"{value:.4g}") for side, value in scan.spread.items()},
                    "detectable_m": {str(side): float(f"{value:.4g}") for side, value in scan.detectable_m.items()}},
        "regions": {"tests": 2 * len(judged.regions), "threshold_sigma": float(f"{judged.region_threshold:.4g}")},
        "pixels": {"nominal": int(judged.wanted.sum()), "inspected": int(judged.inspected.sum()),
                   "not_inspected": int((judged.wanted & ~judged.inspected).sum())},
        "areas_not_inspected": area_count,
    }
