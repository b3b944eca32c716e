"""Calibration of the colours of a capture from a colour chart: a matrix for each kind of light under which its frames show the chart."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.calibrate.results import color_matrix, digits, manifest_to_write, write_results
from service.calibrate.solvers.chart_colors import ChartColors, PatchReadings, combine, orient, read_patches, solve_colors
from service.calibrate.solvers.chart_patches import PatchPlaces, place_patches
from service.calibrate.solvers.chart_reference import ChartReference, built_in, read_reference
from service.calibrate.solvers.chart_search import find_charts, refine_corners
from service.calibrate.solvers.cielab import xyz_from_linear
from service.calibrate.solvers.light_kinds import LightKind, kinds_of, matching_kind
from service.relight.sheet import BACKGROUND, display, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.chart import ChartKind, ChartRequest
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import FILE_NAME, ColorMatrix, Manifest
from stage.colour.colour_spaces import Review, linear_space
from stage.errors import CalibrationError, ManifestError
from stage.formats.camera_raw import path_is_raw
from stage.stack.correction import Correction

PATCHES = {ChartKind.CLASSIC: 24, ChartKind.PASSPORT: 24, ChartKind.SG: 140}
SURE = 0.9
"""The part of the patches that have the colours of the chart where no other place is looked for."""
LEAST = 0.6
"""The part of the patches that must have them: a place that is off by a row has half of them."""
SAME = 0.1
"""The distance of two places of the chart that count as one, in spacings of patches: the outlines of the patches move both to the same."""
MOST_SEARCHED = 16
"""The most frames whose mean is searched for the chart; of more, evenly spaced ones are."""
COLOURED = 0.02
"""The part of its largest channel by which the irradiance of a light that is not grey differs."""
PICTURE_FILE = "chart.png"
PATCH, GAP = 42, 6
"""The side of a patch in the picture, and the gap between two, pixels."""
AROUND = 0.15
"""The part of the chart's width that is shown around it."""
WHITE = 0.9
"""The value that the brightest patch has in the photograph."""
MOST_ROWS = 480
"""The most rows of the photograph in the picture, before it is scaled to the height of the others."""


class KindColors(NamedTuple):
    """The colours of the camera under one kind of light."""

    kind: LightKind
    colors: ChartColors
    summary: str
    rows: list[tuple[str, ...]]
    """A row for each patch, the farthest off first: name, CIEDE2000 before and after, and why it is left out."""


class ChartCalibration(NamedTuple):
    """The colours that a chart measured, and the files that were written."""

    manifest_path: Path
    report_path: Path
    picture_path: Path
    kinds: tuple[KindColors, ...]
    corners: np.ndarray  # [4, 2] pixels of the centres of the corner patches, as `--corners` takes them
    warnings: tuple[str, ...]


def calibrate_chart(request: ChartRequest, progress: Progress | None = None) -> ChartCalibration:
    """Measure the colours of a camera from a chart in the frames of a capture, and write their matrices into a manifest.
    Raises StageError for bad input, no chart, or one whose patches do not tell the colours; it names what is wrong, and nothing is written.
    Raises RequestError for options that do not fit."""
    timings = Timings(progress)
    timings.stage("open", 1)
    source = Capture.open(request.capture)
    target = source if request.apply_to is None else Capture.open(request.apply_to)
    manifest_path = manifest_to_write(target, request.out)
    _check_cameras(source, target)
    space = linear_space(source.manifest.color_space)
    patches = PATCHES[request.chart]
    chart = built_in(patches) if request.reflectances is None else read_reference(request.reflectances, patches, request.illuminant, space)
    manifest = source.manifest
    kinds = kinds_of(manifest)
    if not kinds:
        raise ManifestError(f"{source.folder / FILE_NAME}: frames: none is lit by a light: the chart is read in such frames")
    correction = Correction.of(replace(source, manifest=manifest.with_colors(None)), full_scale=True)
    try:
        mean, clipped = _mean(correction, sorted(index for kind in kinds for index in kind.frames), timings)
        xyz_from_rgb = xyz_from_linear(space)
        reference = chart.xyz @ np.linalg.inv(xyz_from_rgb).T
        found_at = _found(chart, reference, mean, clipped) if request.corners is None else _placed(
            np.reshape(request.corners, (4, 2)), chart, reference, mean, clipped)
    except CalibrationError as error:
        raise CalibrationError(f"{source.folder}: {error}") from error
    corners, places, order, turned, _ = found_at
    found: list[KindColors] = []
    timings.stage("frames", sum(len(kind.frames) for kind in kinds))
    for kind in kinds:
        readings = _read(correction, kind, places, patches, timings, sum(len(each.kind.frames) for each in found))
        earlier = manifest.frames[kind.frames[0]].color_matrix or manifest.color_matrix
        try:
            colors = solve_colors(readings.ordered(order), chart, xyz_from_rgb, np.eye(3) if earlier is None else np.array(earlier))
        except CalibrationError as error:
            light = f"{kind.words(manifest)}: " if len(kinds) > 1 else ""
            raise CalibrationError(f"{source.folder}: {light}{error}") from error
        found.append(_with_words(kind, colors, chart, f"{kind.words(manifest)}: " if len(kinds) > 1 else ""))
    timings.close()
    corners = corners[turned]
    written, unseen = _corrected(source, target, found)
    warnings = (*_stance(corners), *(finding for each in found for finding in _findings(each, len(found), manifest)), *unseen,
                *source.doubts)
    shown = [(each.kind.words(manifest) if len(found) > 1 else "corrected", each.colors) for each in found]
    picture = write_picture(manifest_path.parent / PICTURE_FILE, mean, corners, chart, shown, space, request.review)
    report = write_results("chart", request, written, manifest_path, {
        "capture": str(source.folder), "applied_to": str(target.folder), "reference": chart.source,
        "corners": [digits(corner) for corner in corners], "kinds": [_entry(each, chart, manifest) for each in found],
        "warnings": list(warnings)})
    return ChartCalibration(manifest_path, report, picture, tuple(found), corners, warnings)


class _Placed(NamedTuple):
    """A place of the chart, as the picture shows it."""

    corners: np.ndarray
    places: PatchPlaces
    order: np.ndarray
    """The order of patches in which the chart shows its colours."""
    turned: np.ndarray
    """The order of the corners."""
    agreeing: int
    """The number of patches with the colours of the chart."""


def _placed(corners: np.ndarray, chart: ChartReference, reference: np.ndarray, mean: np.ndarray, clipped: np.ndarray) -> _Placed:
    """Return the chart at a place, which the outlines of its patches refine.
    Raises CalibrationError if the corners span no chart, or there are other colours."""
    place_patches(chart.names, chart.grid, corners, mean.shape[1::-1])  # checks them
    corners = refine_corners(mean, corners, chart.grid)
    places = place_patches(chart.names, chart.grid, corners, mean.shape[1::-1])
    return _Placed(corners, places, *orient(read_patches(places, len(chart.names), mean[places.box], clipped[places.box]), reference,
                                            chart.grid))


def _found(chart: ChartReference, reference: np.ndarray, mean: np.ndarray, clipped: np.ndarray) -> _Placed:
    """Return the chart where most of its patches have its colours, of all places that are proposed.
    Raises CalibrationError if there is none; says what is wrong with the first within the picture."""
    faults: list[CalibrationError] = []
    best: _Placed | None = None
    judged: list[np.ndarray] = []
    for corners in find_charts(mean, len(chart.names)):
        near = SAME * np.linalg.norm(corners[1] - corners[0]) / (chart.grid[0] - 1)
        if any(np.abs(corners - other).max() < near for other in judged):
            continue
        judged.append(corners)
        try:
            place_patches(chart.names, chart.grid, corners, mean.shape[1::-1])
        except CalibrationError:
            continue  # is no place within the picture
        try:
            found = _placed(corners, chart, reference, mean, clipped)
        except CalibrationError as error:
            faults.append(error)
            continue
        best = found if best is None or found.agreeing > best.agreeing else best
        if best.agreeing >= SURE * len(chart.names):
            break
    if best is None:
        raise faults[0] if faults else CalibrationError("no chart is found in the picture: give the centres of its corner patches as "
                                                        "--corners")
    if best.agreeing < LEAST * len(chart.names):
        raise CalibrationError(f"{best.agreeing} of {len(chart.names)} patches of what looks like the chart have its colours: give the "
                               "centres of its corner patches as --corners, or cover other patches beside it")
    return best


def _check_cameras(source: Capture, target: Capture) -> None:
    where = target.folder / FILE_NAME
    spaces = [linear_space(each.manifest.color_space) for each in (source, target)]
    if spaces[0] != spaces[1]:
        raise ManifestError(f"{where}: color_space: leads to {spaces[1]}, that of {source.folder} to {spaces[0]}: they must agree")
    if len({path_is_raw(each.manifest.frames[0].image) for each in (source, target)}) > 1:
        raise ManifestError(f"{where}: frames: either they or those of {source.folder} are camera raw, not both: their colours differ")


def _mean(correction: Correction, frames: list[int], timings: Timings) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of frames [rows, cols, 3] float32, evenly spaced ones of many, and where all are saturated [rows, cols]."""
    shown = [frames[index] for index in np.linspace(0, len(frames), min(MOST_SEARCHED, len(frames)), endpoint=False).astype(int)]
    timings.stage("search", len(shown))
    width, height = correction.capture.camera.resolution
    total, clipped = np.zeros((height, width, 3), np.float32), np.ones((height, width), bool)
    for done, index in enumerate(shown, start=1):
        image = correction.apply(correction.capture.manifest.frames[index])
        total += image.pixels
        clipped &= False if image.saturated is None else image.saturated
        timings.advance(done)
    return total / np.float32(len(shown)), clipped


def _read(correction: Correction, kind: LightKind, places: PatchPlaces, patches: int, timings: Timings, done: int) -> PatchReadings:
    readings = []
    for number, index in enumerate(kind.frames, start=done + 1):
        image = correction.apply(correction.capture.manifest.frames[index])
        saturated = None if image.saturated is None else image.saturated[places.box]
        readings.append(read_patches(places, patches, image.pixels[places.box], saturated))
        timings.advance(number)
    return combine(readings)


def _with_words(kind: LightKind, colors: ChartColors, chart: ChartReference, light: str) -> KindColors:
    order = sorted(range(len(chart.names)), key=lambda index: (index not in colors.refused, -np.nan_to_num(colors.after[index])))
    rows: list[tuple[str, ...]] = [(chart.labels()[index], *(("", "", colors.refused[index]) if index in colors.refused else
                                      (f"{colors.before[index]:.2f}", f"{colors.after[index]:.2f}", ""))) for index in order]
    used = int(colors.used.sum())
    summary = (f"{light}CIEDE2000 {np.nanmean(colors.before):.2f} before, {np.nanmean(colors.after):.2f} after, at most "
               f"{np.nanmax(colors.after):.2f}, {used} of {len(chart.names)} patches")
    return KindColors(kind, colors, summary, rows)


def _corrected(source: Capture, target: Capture, found: list[KindColors]) -> tuple[Manifest, list[str]]:
    """Return the manifest of the target with the matrices of its kinds of light, and what is to be said."""
    warnings = []
    rows: dict[int, ColorMatrix] = {}
    for kind in kinds_of(target.manifest):
        match = matching_kind(kind, [each.kind for each in found])
        if match is None:
            raise ManifestError(f"{target.folder / FILE_NAME}: frames[{kind.frames[0]}]: {kind.words(target.manifest)}: no frame of "
                                f"{source.folder} shows the chart in such light")
        rows |= dict.fromkeys(kind.frames, color_matrix(found[match].colors.matrix))
        if kind.colour is not None and not found[match].kind.shines_alike(kind):
            warnings.append(f"frames: {kind.words(target.manifest)}: the chart was not seen in it; the matrix of "
                            f"{found[match].kind.words(source.manifest)} is used")
    if not rows:
        raise ManifestError(f"{target.folder / FILE_NAME}: frames: none is lit by a light: there is none to correct")
    coloured = sum(_is_coloured(frame.light) for frame in target.manifest.frames)
    if coloured:
        warnings.append(f"lights: {coloured} frames declare lights with a colour, and the chart is now white under them: measure them "
                        "again with `relit calibrate grey-ball`")
    common = max(rows.values(), key=list(rows.values()).count)
    return target.manifest.with_colors(common, {index: each for index, each in rows.items() if each != common}), warnings


def _is_coloured(light: Any) -> bool:
    if not isinstance(light, DistantLight | PointLight):
        return False
    strength = light.irradiance if isinstance(light, DistantLight) else light.intensity
    return max(strength) - min(strength) > COLOURED * max(strength)


def _stance(corners: np.ndarray) -> list[str]:
    """Return a sentence about a chart that is upside down or mirrored in the images."""
    across, down = corners[1] - corners[0], corners[3] - corners[0]
    if across[0] * down[1] - across[1] * down[0] < 0:
        return ["images: they show the chart mirrored: its colours are read in their order all the same"]
    upside_down = down[1] < -abs(down[0])
    return ["images: the chart is upside down in them: it was turned by its colours"] if upside_down else []


def _findings(each: KindColors, kinds: int, manifest: Manifest) -> list[str]:
    left_out = [f"{name} is {why}, and left out" for name, _, _, why in each.rows if why]
    return [f"{each.kind.words(manifest)}: {finding}" if kinds > 1 else finding for finding in (*each.colors.findings, *left_out)]


def _entry(each: KindColors, chart: ChartReference, manifest: Manifest) -> dict[str, Any]:
    colors = each.colors
    return {"light": each.kind.words(manifest), "frames": [manifest.frames[index].image for index in each.kind.frames],
            "matrix": [digits(row) for row in colors.matrix], "gains": digits(colors.gains),
            "response": None if colors.gamma is None else float(f"{colors.gamma:.4g}"),
            "light_falls_to": float(f"{colors.light.min():.3g}"),
            "delta_e_2000": {name: {"mean": float(f"{np.nanmean(values):.4g}"), "median": float(f"{np.nanmedian(values):.4g}"),
                                    "most": float(f"{np.nanmax(values):.4g}")}
                             for name, values in (("before", colors.before), ("after", colors.after))},
            "patches": [{"name": name, "left_out": colors.refused[index]} if index in colors.refused else
                        {"name": name, "before": float(f"{colors.before[index]:.4g}"), "after": float(f"{colors.after[index]:.4g}")}
                        for index, name in enumerate(chart.names)]}


def write_picture(
    path: Path,
    photograph: np.ndarray,  # [rows, cols, 3] linear, in the colours of the camera
    corners: np.ndarray,  # [4, 2] pixels of the centres of the corner patches
    chart: ChartReference,
    found: Sequence[tuple[str, ChartColors]],  # the title and the colours of each kind of light
    space: str, review: Review,
) -> Path:
    """Write the picture, and return its path."""
    reach = AROUND * float(np.ptp(corners, axis=0).max())
    (left, top), (right, bottom) = np.maximum(corners.min(axis=0) - reach, 0).astype(int), (corners.max(axis=0) + reach).astype(int) + 1
    step = -(-(bottom - top) // MOST_ROWS)
    part = photograph[top:bottom:step, left:right:step]
    reference = chart.xyz @ np.linalg.inv(xyz_from_linear(space)).T
    v, u = np.indices(part.shape[:2]) * step
    sides = np.stack([(b[0] - a[0]) * (v + top - a[1]) - (b[1] - a[1]) * (u + left - a[0])
                      for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)])
    on_chart = (sides > 0).all(axis=0) | (sides < 0).all(axis=0)
    rows = []
    for title, colors in found:
        through = np.maximum(part @ colors.matrix.T, 0)
        shown = WHITE * through / max(float(np.percentile(through[on_chart], 99)), 1e-30)
        rows.append([(title, display(shown.astype(np.float32), space, review)),
                     ("measured | reference | corrected", _patches(colors, reference, chart.grid, space, review))])
    write_sheet(path, rows)
    return path


def _patches(colors: ChartColors, reference: np.ndarray, grid: tuple[int, int], space: str, review: Review) -> np.ndarray:
    """Return display values of the patches, each in three stripes; those that are left out have the reference alone."""
    columns, rows = grid
    pitch = PATCH + GAP
    sheet = np.tile(BACKGROUND, (rows * pitch - GAP, columns * pitch - GAP, 1))
    stripes = display(np.clip(np.stack([colors.measured, reference, colors.corrected]), 1e-6, None).astype(np.float32), space, review)
    for index in range(columns * rows):
        row, column = divmod(index, columns)
        for stripe in range(3) if index not in colors.refused else (1,):
            begin = column * pitch + stripe * PATCH // 3
            sheet[row * pitch : row * pitch + PATCH, begin : begin + PATCH // 3] = stripes[stripe, index]
    return sheet
