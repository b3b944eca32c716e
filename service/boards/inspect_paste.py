"""Inspect the solder paste on a board and write board.exr, pads.csv, inspection.png and report.json.

The way of the data: tiles → stitched and blended → registered to the openings of the stencil, filled as high as it is thick → the paste of
every pad (paste.py), whose offsets count from marks or from most of the paste (datum.py) → verdicts by limits and σ → the files.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from service.boards.datum import Datum, find_mark, fit_datum, lay
from service.boards.findings import six_digits
from service.boards.height_files import BOARD_FILE, write_board
from service.boards.inspect_board import stitch_board, stitching_entries
from service.boards.inspection_picture import PICTURE_FILE, Frame, write_picture
from service.boards.paste import Measured, PadPaste, Paste, measure_paste, openings_of
from service.boards.shared_print import shared_sentences
from service.boards.stitching.blending import TileErrors
from service.boards.stitching.grid import BoardGrid, HeightMap
from service.boards.stitching.regions import Verdict
from service.boards.stitching.significance import threshold
from service.boards.stitching.stitching import SEARCH_SIGMA, SHIFT_SIGMA_PX, Stitched, blend, blended
from service.boards.tiles import BoardTiles, read_tiles
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, report
from service.requests.inspect_board import BoardSide, InspectPasteRequest
from stage.errors import BoardError
from stage.files import write_text
from stage.formats.centroids import names_of, read_components
from stage.formats.csv_table import table_text
from stage.formats.gerber import Pad, read_marks, read_pads
from stage.sets.paste_limits import PadLimits, limits_of, read_limits
from stage.stack.fingerprint import digest

PADS_FILE = "pads.csv"
METHOD = "solder paste inspection"
LEAST_SEEN = 0.5
"""The least part of the pads that must lie within what was measured."""
LEAST_MARKS, LEAST_PADS = 2, 3
"""The fewest marks, and the fewest pads with paste, that offsets can count from."""
LEAST_MARK_PX = 4.0
"""The smallest diameter of a mark, pixels: in a smaller place noise alone looks like a mark."""
MOST_TURN_DEGREES = 2.0
"""The largest angle between marks and paste: prints are turned by less, and marks that are none by any angle."""


class PadResult(NamedTuple):
    """The paste of a pad, and what is said of it."""

    name: str
    pad: Pad
    verdict: Verdict | None
    """None: no limits are given for it."""
    paste: PadPaste | None
    values: dict[str, Measured]
    """Per cent: volume, height and area of the nominal ones, offsets of the pad's sides."""
    limits: dict[str, tuple[float, float]]
    bridged: tuple[str, ...]
    """The pads that paste connects it to."""


class InspectPasteResult(NamedTuple):
    """The files and pads of an inspection that was written."""

    board_path: Path
    report_path: Path
    picture_path: Path
    pads_path: Path
    verdict: Verdict | None
    """The worst of all pads; None where no limits are given."""
    pads: list[PadResult]
    datum: Datum
    warnings: tuple[str, ...]


class _Marks(NamedTuple):
    datum: Datum
    found: int
    asked: int
    """Marks of the file that lie within what was measured; 0: offsets count from the paste."""


def inspect_paste(request: InspectPasteRequest, progress: Progress | None = None) -> InspectPasteResult:
    """Inspect the paste on a board; nothing is written where board and layer do not fit together."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    limits = () if request.limits is None else read_limits(request.limits, request.limit_class)
    layer = read_pads(request.paste)
    names = names_of(layer, [] if request.centroids is None else _components(request, layer))
    mirrored = request.side is BoardSide.BOTTOM
    pads = [pad.placed(mirrored=mirrored, origin_m=request.origin_m) for pad in layer]
    marks = np.zeros((0, 3)) if request.marks is None else read_marks(request.marks) - (*request.origin_m, 0.0)
    marks[:, 0] *= -1 if mirrored else 1
    board = read_tiles(request.board, device=device, cache=request.cache, progress=timings)
    stitched = stitch_board(board, request.pixel_m, request.placement_m, timings)
    search_m = SEARCH_SIGMA * (request.placement_m or SHIFT_SIGMA_PX * stitched.grid.pixel_m)
    heights, errors = _placed(board, stitched, pads, request, search_m, timings)
    warnings = list(stitched.warnings)
    timings.stage("measure", 1)
    paste = measure_paste(heights, pads, errors, stencil_m=request.stencil_m, area_level=request.area_level,
                          bridge_level=request.bridge_level)
    found = _datum(paste, pads, marks, request, search_m)
    results = _judge(paste, pads, names, found.datum, limits, _tile_variance(board, stitched, pads), request)
    verdict = Verdict.worst(result.verdict for result in results if result.verdict is not None) if limits else None
    if not found.asked:
        warnings.append("offsets count from where most of the paste lies: an offset of the whole print is not seen without --marks")
    warnings += _shared(results, heights.grid.pixel_m)
    if unlimited := sum(result.verdict is None for result in results) if limits else 0:
        warnings.append(f"{unlimited} pads are measured and not judged: no limits of {request.limits} fit their names")
    timings.stage("write", 1)
    files = {"paste": request.paste, "centroids": request.centroids, "marks": request.marks, "limits": request.limits}
    contents = {name: digest(path) for name, path in files.items() if path is not None}
    write_board(request.out / BOARD_FILE, heights, metadata(request, capture=board.scan.name, inputs=" ".join(board.contents.values()),
                                                            method=METHOD, contents=contents))
    pads_path, picture_path, report_path = (request.out / name for name in (PADS_FILE, PICTURE_FILE, REPORT_FILE))
    rows = [_row(result) for result in results]
    write_text(pads_path, table_text(list(rows[0]), ({**row, "bridged_with": " ".join(row["bridged_with"])}.values() for row in rows)))
    full = np.where(openings_of(heights.grid, pads) > 0, request.stencil_m, 0.0)
    deviation = paste.height._replace(height=paste.height.height - full)
    write_picture(picture_path, heights, deviation, heights.measured, full > 0, [],
                  [Frame(_pair(each.pad.centre_m), _pair(each.pad.size_m), each.verdict) for each in results])
    datum = found.datum
    write_text(report_path, report(
        request, inputs={"board": str(request.board), "name": board.scan.name, "tiles": board.contents, **contents}, method=METHOD,
        stitching=stitching_entries(board, stitched), warnings=warnings, device=devices.describe(device),
        verdict=None if verdict is None else str(verdict), bridge_level_m=paste.bridge_level_m,
        datum={"by": "marks" if found.asked else "paste", "marks_found": found.found, "marks_looked_for": found.asked,
               "shift_m": [six_digits(value) for value in datum.shift_m], "turn_degrees": six_digits(np.degrees(datum.turn)),
               "shift_sigma_m": [six_digits(value) for value in np.sqrt(np.diag(datum.covariance)[:2])]},
        pads=[{**row, "limits": result.limits} for row, result in zip(rows, results, strict=True)], timings_s=timings.close()))
    return InspectPasteResult(request.out / BOARD_FILE, report_path, picture_path, pads_path, verdict, results, datum, tuple(warnings))


def _shared(results: list[PadResult], pixel_m: float) -> list[str]:
    there = [(result.values, result.pad, result.paste.offset_m) for result in results
             if result.paste is not None and np.isfinite(result.paste.offset_m).all()]
    volume, area = (np.array([values[name].value for values, _, _ in there]) for name in ("volume_percent", "area_percent"))
    return shared_sentences(volume, area, np.array([pad.centre_m for _, pad, _ in there]), np.array([off for _, _, off in there]),
                            pixel_m=pixel_m)


def _components(request: InspectPasteRequest, pads: list[Pad]) -> list[Any]:
    """Return the components of the side, of which most must lie among the pads."""
    path = request.centroids
    assert path is not None
    every = read_components(path)
    components = [component for component in every if component.bottom is (request.side is BoardSide.BOTTOM)]
    if not components:
        raise BoardError(f"{path}: names no component on the {request.side} side")
    low = np.min([pad.low_m for pad in pads], axis=0)
    high = np.max([pad.low_m + pad.size_m for pad in pads], axis=0)
    within = np.mean([bool((component.place_m >= low).all() and (component.place_m <= high).all()) for component in components])
    if within < LEAST_SEEN:
        raise BoardError(f"{path}: {100 * (1 - within):.0f} % of its components lie beyond the pads of {request.paste}: both must have one "
                         "origin, and lengths are millimetres where the table names no unit")
    return components


def _on(grid: BoardGrid, places_m: np.ndarray) -> np.ndarray:
    """Return which places, [n, 2], lie on the grid, [n] bool."""
    row, col = grid.place(*places_m.T)
    return np.asarray((row > 0) & (row < grid.rows) & (col > 0) & (col < grid.cols))


def _placed(board: BoardTiles, stitched: Stitched, pads: list[Pad], request: InspectPasteRequest, search_m: float, timings: Timings
            ) -> tuple[HeightMap, TileErrors]:
    """Return the heights of the board where its paste lies on the openings, and the errors of its tiles."""
    grid = stitched.grid
    timings.stage("match", 2 * len(board.tiles))
    first = blend(board.tiles, stitched, grid, progress=timings.advance)
    within = _on(grid, np.array([pad.centre_m for pad in pads])).mean()
    if within < LEAST_SEEN:
        raise BoardError(f"{request.paste}: {100 * (1 - within):.0f} % of its openings lie beyond what was measured, which is "
                         f"{1e3 * grid.size_m[0]:.4g} x {1e3 * grid.size_m[1]:.4g} mm from ({1e3 * grid.left_m:.4g}, "
                         f"{1e3 * (grid.top_m - grid.size_m[1]):.4g}) mm on: give the place of the board's origin in the layer with "
                         "--origin-m")
    search = int(np.ceil(search_m / grid.pixel_m))
    apart = np.median([pad.size_m.min() for pad in pads]) / grid.pixel_m / 2
    try:
        moved = lay(first, openings_of(grid, pads) > 0, stencil_m=request.stencil_m, search_px=search, apart_px=float(apart))
    except BoardError as error:
        raise BoardError(f"{request.paste}: {error}") from error
    sums = blended(board.tiles, stitched, grid, motion=np.array([*moved, 0.0, 0.0, 0.0, 0.0]),
                   progress=lambda done: timings.advance(len(board.tiles) + done))
    return sums.result(), sums.errors(stitched.motions)


def _datum(paste: Paste, pads: list[Pad], marks: np.ndarray, request: InspectPasteRequest, search_m: float) -> _Marks:
    """Return what offsets count from: the marks, or most of the paste."""
    grid = paste.height.grid
    by_paste = _datum_of_paste(paste, pads)
    if len(marks):
        diameters, marks = marks[:, 2], marks[_on(grid, marks[:, :2]) & (marks[:, 2] >= LEAST_MARK_PX * grid.pixel_m)]
        if not len(marks) and diameters.max() < LEAST_MARK_PX * grid.pixel_m:
            raise BoardError(f"{request.marks}: its largest mark is {diameters.max():.2g} m wide, and pixels are {grid.pixel_m:.2g} m: "
                             "check the unit of the file (METRIC or INCH)")
        offsets = [find_mark(paste.height, mark[:2], mark[2], deep_m=request.stencil_m, search_m=search_m) for mark in marks]
        there = [(mark[:2], offset) for mark, offset in zip(marks, offsets, strict=True) if offset is not None]
        if len(there) < LEAST_MARKS:
            raise BoardError(f"{request.marks}: {len(there)} of its {len(marks)} marks on the board are found within {search_m:.2g} m of "
                             f"their places, and {LEAST_MARKS} are needed: check its unit, or leave --marks out, and offsets count "
                             "from most of the paste")
        places, moved = np.array(there).swapaxes(0, 1)
        found = fit_datum(places, moved, pixel_m=grid.pixel_m)
        turn = 0.0 if by_paste is None else abs(float(np.degrees(found.turn - by_paste.turn)))
        if turn > MOST_TURN_DEGREES:
            raise BoardError(f"{request.marks}: its marks are turned by {turn:.2g}° against the paste, as where none are what is found at "
                             "their places: check the unit of the file and --origin-m, or leave --marks out")
        return _Marks(found, len(there), len(marks))
    if by_paste is None:
        raise BoardError(f"{request.board}: fewer than {LEAST_PADS} pads have paste, and {LEAST_PADS} are needed to say where it lies: "
                         "check --stencil-m")
    return _Marks(by_paste, 0, 0)


def _datum_of_paste(paste: Paste, pads: list[Pad]) -> Datum | None:
    """Return where most of the paste lies; None where too few pads have any."""
    used = [(pad.centre_m, each.offset_m) for pad, each in zip(pads, paste.pads, strict=True)
            if each is not None and each.values["area_percent"].value > 100 * LEAST_SEEN]
    if len(used) < LEAST_PADS:
        return None
    places, moved = np.array(used).swapaxes(0, 1)
    return fit_datum(places, moved, pixel_m=paste.height.grid.pixel_m)


def _tile_variance(board: BoardTiles, stitched: Stitched, pads: list[Pad]) -> np.ndarray:
    """Return the variance of the place of each pad's tile against the mean of all tiles, [pads, 2] m²."""
    count, motions = len(board.tiles), stitched.motions
    whole = motions.covariance.reshape(count, -1, count, motions.covariance.shape[1] // count)
    middles = np.array([tile.middle for tile in board.tiles])
    out = []
    for pad in pads:
        share = np.full(count, -1 / count)
        share[int(np.argmin(np.hypot(*(middles - pad.centre_m).T)))] += 1
        out.append([float(share @ whole[:, axis, :, axis] @ share) for axis in (0, 1)])
    return np.array(out)


def _judge(paste: Paste, pads: list[Pad], names: list[str], datum: Datum, limits: tuple[PadLimits, ...], tiles: np.ndarray,
           request: InspectPasteRequest) -> list[PadResult]:
    """Decide about every pad as regions are decided (ISO 14253-1): k σ outside of a limit fails, k σ inside of all passes."""
    own = [limits_of(name, limits) for name in names]
    ranges = [{} if each is None else each.ranges() for each in own]
    k = threshold(request.false_alarm, 2 * sum(map(len, ranges)), sides=1)
    bridged: list[set[int]] = [set() for _ in pads]
    for group in paste.bridges:
        for member in group:
            bridged[member] |= set(group) - {member}
    results = []
    for number, (pad, each) in enumerate(zip(pads, paste.pads, strict=True)):
        values = {} if each is None else dict(each.values)
        if each is not None and np.isfinite(each.offset_m).all():
            off = each.offset_m - datum.at(pad.centre_m)
            sigma = np.sqrt(each.offset_variance_m2 + datum.variance(pad.centre_m) + tiles[number])
            values |= {f"offset_{axis}_percent": Measured(100 * float(value / side), 100 * float(spread / side))
                       for axis, value, spread, side in zip("xy", off, sigma, pad.size_m, strict=True)}
        bad = [other for other in bridged[number] if "fail" in (getattr(own[number], "bridge", None), getattr(own[other], "bridge", None))]
        verdict = None if own[number] is None else _verdict(each, values, ranges[number], k, bool(bad), request.least_inspected)
        results.append(PadResult(names[number], pad, verdict, each, values, ranges[number],
                                 tuple(names[other] for other in sorted(bridged[number]))))
    return results


def _verdict(paste: PadPaste | None, values: dict[str, Measured], ranges: dict[str, tuple[float, float]], k: float, bridged: bool,
             least: float) -> Verdict:
    if bridged:
        return Verdict.FAIL
    if paste is None or paste.seen < least:
        return Verdict.NOT_INSPECTED
    # an offset without paste is not known; its volume and area say what is wrong
    return Verdict.worst(Verdict.of(*values[name], limits, k) if name in values else Verdict.UNDECIDED for name, limits in ranges.items())


def _row(result: PadResult) -> dict[str, Any]:
    """Return what the table and the report say of a pad."""
    pad, paste = result.pad, result.paste
    row: dict[str, Any] = {"name": result.name, "verdict": None if result.verdict is None else str(result.verdict),
                           "x_m": six_digits(pad.centre_m[0]), "y_m": six_digits(pad.centre_m[1]), "width_m": six_digits(pad.size_m[0]),
                           "height_m": six_digits(pad.size_m[1]), "opening_m2": six_digits(pad.area_m2),
                           "seen": 0.0 if paste is None else six_digits(min(paste.seen, 1.0)),
                           "volume_m3": None if paste is None else six_digits(paste.volume_m3)}
    for name in ("volume_percent", "height_percent", "area_percent", "offset_x_percent", "offset_y_percent"):
        found = result.values.get(name)
        value, sigma = (None, None) if found is None else map(six_digits, found)
        row |= {name: value, f"{name}_sigma": sigma}
    return row | {"bridged_with": list(result.bridged)}


def _pair(values: np.ndarray) -> tuple[float, float]:
    return float(values[0]), float(values[1])
