"""Calibration of the lamps of a rig: a capture in which one primary shines at a time gives its irradiance, colour and response."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.calibrate.balls import ball_entry, balls_of, find_grey_ball, find_mirror_ball
from service.calibrate.results import LightCaptures, digits, three_numbers, write_report
from service.calibrate.solvers.apply import LitFrame
from service.calibrate.solvers.chart_patches import ChartPatches, find_patches
from service.calibrate.solvers.lamp_faults import check_images, other_encoding
from service.calibrate.solvers.lamp_readings import (
    LEAST_DRIVES,
    LambertTemplate,
    MeasuredPrimary,
    MirrorTemplate,
    card_template,
    facing_cosine,
    fit_primary,
    grey_ball_template,
    mirror_ball_template,
)
from service.errors import RequestError
from service.light_estimation.ball import Ball, BallView, view_ball
from service.reporting.progress import Progress, Timings
from service.requests.rig import RigCalibrationRequest, RigTarget
from stage.capture.capture import Capture
from stage.capture.light import DistantLight
from stage.capture.manifest import Frame
from stage.colour.colour_spaces import linear_space
from stage.errors import CalibrationError, ManifestError
from stage.files import write_text
from stage.formats.csv_table import read_table
from stage.pixels import Crop
from stage.rig.chart import CHART_SCHEMA
from stage.rig.patch import drive_for_light
from stage.rig.rig import Rig, read_rig, write_rig
from stage.stack.correction import Correction, Radiance

COLUMNS = ("frame", "light", "primary", "level")
CHART_FILE = "chart.json"
GLOSS = 0.1
"""A misfit of Lambert's law from here on is flagged."""


class RigCalibration(NamedTuple):
    """The files that were written, and a table of the primaries, the least certain first; a chart's readings are CHART_FILE beside them."""

    rig_path: Path
    report_path: Path
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    summary: str
    warnings: tuple[str, ...]


class Shot(NamedTuple):
    """An image under one primary."""

    frame: Frame
    drive: float


class Sweep(NamedTuple):
    """The frames of a capture as the table of the sweep lists them."""

    shots: dict[int, list[Shot]]
    """By the index of the emitter in `rig.emitters`."""
    dark: list[Frame]
    """Frames in which no primary shines."""


class Target(NamedTuple):
    """The ball or card, and the part of the images that shows it."""

    box: tuple[slice, slice]
    template: Any
    """Called with radiance, saturated pixels and the direction of a lamp; returns the pixels in which it is read."""
    entry: dict[str, Any]
    """What the report says of it."""
    chart: ChartPatches | None = None
    grey: BallView | None = None
    """The view of a grey ball."""


def calibrate_rig(request: RigCalibrationRequest, progress: Progress | None = None) -> RigCalibration:
    """Measure the primaries of a rig, and write its file.
    Raises RequestError for options that do not fit. Raises StageError for bad input, or an image from which a primary cannot be measured;
    it names the image, and nothing is written. Raises StorageError if a file cannot be written."""
    timings = Timings(progress)
    timings.stage("open", 1)
    capture, rig = Capture.open(request.capture), read_rig(request.rig)
    sweep = _read_table(request.table, capture, rig)
    missing = [f"{primary.name} of {rig.lights[index].name}" for column, (index, primary) in enumerate(rig.emitters)
               if column not in sweep.shots]
    space = linear_space(capture.manifest.color_space)
    if missing and not _absolute(request):
        raise RequestError(f"--albedo: is missing: without it irradiances are relative, and the table {request.table} has no frame of "
                           f"{missing[0]} ({len(missing)} primaries) to compare with")
    if missing and space != rig.color_space:
        raise ManifestError(f"{request.rig}: color_space: is {rig.color_space}, the capture is in {space}, and the table {request.table} "
                            f"has no frame of {missing[0]} ({len(missing)} primaries): measure all, or set the space of the capture")
    correction = Correction.of(capture, full_scale=True)
    target = _target(request, capture, sweep)
    timings.stage("frames", sum(map(len, sweep.shots.values())))
    ambient = _ambient(correction, sweep.dark, target.box)
    found: dict[int, MeasuredPrimary | CalibrationError] = {}
    shading: dict[int, tuple[float, list[str]]] = {}
    patches: dict[int, np.ndarray] = {}
    done = 0
    for column, shots in sweep.shots.items():
        index, primary = rig.emitters[column]
        try:
            found[column], shading[column] = _measure(shots, correction, target, ambient, rig.directions[index],
                                                      capture.manifest.color_space)
            if target.chart is not None:
                patches[column] = _read_patches(shots, correction, target.chart, ambient, rig.directions[index], request.card_normal)
        except CalibrationError as error:
            found[column] = CalibrationError(f"{capture.folder}: {primary.name} of {rig.lights[index].name}: {error}")
        done += len(shots)
        timings.advance(done)
    errors = [each for each in found.values() if isinstance(each, CalibrationError)]
    if errors and (not request.drop_failed or len(errors) == len(found) or not _absolute(request) or space != rig.color_space):
        more = f" (and {len(errors) - 1} more primaries)" if len(errors) > 1 else ""
        raise CalibrationError(f"{errors[0]}{more}")
    measured = {column: each for column, each in found.items() if isinstance(each, MeasuredPrimary)}
    factor = _scale(request, measured)
    result = _with_measured(rig, measured, factor, space)
    entries = [_entry(rig, column, found[column], factor, *shading.get(column, (0.0, [])), sweep.shots[column]) for column in found]
    timings.close()
    flagged = sum(bool(entry["flags"]) for entry in entries)
    report = write_report("rig", request, request.out.parent, {
        "capture": str(capture.folder), "rig": str(request.rig), "measured": len(measured), "left": len(errors) + len(missing),
        "flagged": flagged, "irradiance_scale": "absolute" if _absolute(request) else "relative", "color_space": space,
        "dark_frames": len(sweep.dark), **target.entry, "warnings": capture.doubts, "primaries": entries})
    write_rig(result, request.out)
    if target.chart is not None:
        _write_chart(request.out.parent / CHART_FILE, target.chart, result, patches)
    rows: list[tuple[str, ...]] = [
        (f"{entry['light']} {entry['primary']}", three_numbers(entry["irradiance"]), f"{entry['relative_sigma']:.2%}",
         entry["curve"], ", ".join(entry["flags"]))
        for entry in sorted((entry for entry in entries if "irradiance" in entry), key=lambda each: -float(each["relative_sigma"]))]
    counts = (len(measured), "measured"), (len(errors) + len(missing), "left as they were"), (flagged, "flagged")
    return RigCalibration(request.out, report, ("primary", "irradiance", "sure to", "response", "flags"), rows,
                          ", ".join(f"{count} {what}" for count, what in counts if count), capture.doubts)


def _read_table(path: Path, capture: Capture, rig: Rig) -> Sweep:
    """Return the frames of each primary by a table with the columns of cues.csv. Raises ManifestError if a line is wrong; names it."""
    rows = read_table(path, COLUMNS)
    emitters = {(rig.lights[index].name, primary.name): column for column, (index, primary) in enumerate(rig.emitters)}
    frames = capture.manifest.frames
    by_name = {name: frame for frame in frames for name in (frame.image, Path(frame.image).name)}
    lit: dict[str, tuple[int, float]] = {}
    named: dict[str, Frame] = {}
    for row in rows:
        where = f"{path}: line {rows.line_num}"
        name, emitter = (row["frame"] or "").strip(), ((row["light"] or "").strip(), (row["primary"] or "").strip())
        if name not in named:
            frame = by_name.get(name)
            if frame is None and name.isdecimal() and 1 <= int(name) <= len(frames):
                frame = frames[int(name) - 1]
            if frame is None:
                raise ManifestError(f"{where}: frame: is {name}: must be an image of {capture.folder}, or its number, 1 to {len(frames)}")
            named[name] = frame
        if emitter not in emitters:
            raise ManifestError(f"{where}: {emitter[1]} of {emitter[0]} is no primary of the rig {rig.name}")
        try:
            level = float(row["level"])
        except (TypeError, ValueError) as error:
            raise ManifestError(f"{where}: level: is {row['level']}: must be a number from 0 to 1") from error
        if not 0 <= level <= 1:
            raise ManifestError(f"{where}: level: is {level:g}: must be a number from 0 to 1")
        if level > 0:
            if name in lit and lit[name][0] != emitters[emitter]:
                raise ManifestError(f"{where}: the frame {name} has several primaries above 0: light one at a time")
            lit[name] = emitters[emitter], level
    shots: dict[int, list[Shot]] = {}
    for name, (column, level) in lit.items():
        index, primary = rig.emitters[column]
        most = 2 ** rig.lights[index].bits - 1
        drive = float(np.rint(drive_for_light(np.array(level), primary) * most) / most)
        shots.setdefault(column, []).append(Shot(named[name], drive))
    if not shots:
        raise ManifestError(f"{path}: has no level above 0")
    return Sweep(shots, [frame for name, frame in named.items() if name not in lit])


def _target(request: RigCalibrationRequest, capture: Capture, sweep: Sweep) -> Target:
    """Return the target that a request names, or the ball that is found in the brightest images."""
    camera = capture.camera
    if request.target is not RigTarget.CHART and (request.corners or request.reflectances):
        raise RequestError(f"--corners and --reflectances: are for --target {RigTarget.CHART}")
    normal = np.array(request.card_normal) / np.linalg.norm(request.card_normal)
    if request.target is RigTarget.CHART:
        if request.corners is None or request.reflectances is None:
            raise RequestError(f"--target {RigTarget.CHART}: give its place as --corners and its --reflectances")
        if request.albedo or request.region or request.circles or request.masks:
            raise RequestError(f"--target {RigTarget.CHART}: takes no ball, --region or --albedo")
        chart = find_patches(request.reflectances, request.grid, np.reshape(request.corners, (4, 2)), camera.resolution)
        return Target(chart.box, lambda radiance, saturated, direction: card_template(radiance, saturated, direction, normal, chart),
                      {"corners": list(request.corners), "card_normal": digits(normal), "patches": len(chart.names)}, chart)
    if request.target is RigTarget.CARD:
        if request.region is None or request.circles or request.masks:
            raise RequestError("--target card: give its place as --region X,Y,W,H, and no ball")
        region = Crop(*request.region)
        if not region.is_within(camera.resolution):
            raise RequestError(f"--region {region}: leads out of the images of {capture.folder}, which are {camera.width}x{camera.height}")
        return Target((slice(region.y, region.y + region.height), slice(region.x, region.x + region.width)),
                      lambda radiance, saturated, direction: card_template(radiance, saturated, direction, normal),
                      {"region": list(request.region), "card_normal": digits(normal)})
    if request.region is not None:
        raise RequestError(f"--region: is for --target {RigTarget.CARD}: give the outline of a ball as --ball U,V,R")
    grey = request.target is RigTarget.GREY_BALL
    ball = _ball(request, capture, sweep, grey=grey)
    view = view_ball(ball, camera)
    return Target(view.box, (lambda radiance, saturated, direction: grey_ball_template(radiance, saturated, direction, view)) if grey else
                  (lambda radiance, saturated, direction: mirror_ball_template(radiance, saturated, direction, ball, view)),
                  {"balls": [ball_entry(ball)]}, grey=view if grey else None)


def _ball(request: RigCalibrationRequest, capture: Capture, sweep: Sweep, *, grey: bool) -> Ball:
    if request.circles or request.masks:
        return balls_of(request, capture.camera, exactly=1)[0]
    light = DistantLight(type="distant", direction=(0.0, 0.0, 1.0), irradiance=(1.0, 1.0, 1.0))
    numbers = {id(frame): number for number, frame in enumerate(capture.manifest.frames)}
    lit = [LitFrame(numbers[id(shot.frame)], shot.frame, light) for shots in sweep.shots.values()
           for shot in (max(shots, key=lambda each: each.drive),)]
    captures = LightCaptures(capture, capture, request.out, lit)
    return find_grey_ball(captures, None, None) if grey else find_mirror_ball(captures, request.level)


def _ambient(correction: Correction, dark: Sequence[Frame], box: tuple[slice, slice]) -> np.ndarray | float:
    """Return the mean of the dark frames in a box, [h, w, 3] float32, or 0 where there are none."""
    if not dark:
        return 0.0
    total = np.zeros_like(correction.apply(dark[0]).pixels[box])
    for frame in dark:
        total += correction.apply(frame).pixels[box]
    return total / np.float32(len(dark))


def _measure(shots: list[Shot], correction: Correction, target: Target, ambient: np.ndarray | float,
             direction: np.ndarray, declared: str) -> tuple[MeasuredPrimary, tuple[float, list[str]]]:
    """Return a primary, and what its brightest image leaves of the model of the target with what its images say that is flagged."""
    if max(shot.drive for shot in shots) < 1:
        raise CalibrationError("the table has no frame of it at level 1, full level")
    shots = sorted(shots, key=lambda shot: -shot.drive)
    template: LambertTemplate | MirrorTemplate | None = None
    values, sigmas, pixels, encoding = [], [], [], None
    for shot in shots:
        image: Radiance = correction.apply(shot.frame)
        seen, radiance = image.pixels[target.box], image.pixels[target.box] - ambient
        saturated = None if image.saturated is None else image.saturated[target.box]
        try:
            if template is None:
                template = target.template(radiance, saturated, direction)
                encoding = None if target.grey is None else other_encoding(seen, ambient, saturated, direction, target.grey,
                                                                           exposure=shot.frame.exposure_s or 1.0, declared=declared)
            reading = template.read(radiance, saturated)
        except CalibrationError as error:
            raise CalibrationError(f"{shot.frame.image}: {error}") from error
        values.append(reading.value)
        sigmas.append(reading.sigma)
        pixels.append(seen.tobytes())
    assert template is not None
    colour = check_images([shot.frame.image for shot in shots], [shot.drive for shot in shots], pixels, np.array(values), np.array(sigmas))
    found = fit_primary(np.array([shot.drive for shot in shots]), np.array(values), np.array(sigmas))
    # what the target's shading misses is an error of the model, which does not average out
    found = found._replace(sigma=np.hypot(found.sigma, template.misfit * found.irradiance))
    return found, (template.misfit, [flag for flag in (encoding, colour) if flag])


def _read_patches(shots: list[Shot], correction: Correction, chart: ChartPatches, ambient: np.ndarray | float, direction: np.ndarray,
                  normal: Sequence[float]) -> np.ndarray:
    """Return what the camera sees of each patch [patches, 3] under a primary at full level, as albedo times irradiance."""
    cosine = facing_cosine(direction, np.array(normal) / np.linalg.norm(normal))
    seen = []
    for shot in shots:
        if shot.drive == 1:
            image = correction.apply(shot.frame)
            seen.append(chart.means(image.pixels[chart.box] - ambient, None if image.saturated is None else image.saturated[chart.box]))
    return np.mean(seen, axis=0) * np.pi / cosine


def _write_chart(path: Path, chart: ChartPatches, rig: Rig, patches: dict[int, np.ndarray]) -> None:
    """Write the readings of a chart under each primary, the mean over the lamps, with the irradiance that gave them."""
    lamps: dict[str, list[int]] = {}
    for column in patches:
        lamps.setdefault(rig.emitters[column][1].name, []).append(column)
    readings = {name: np.maximum(np.mean([patches[column] for column in columns], axis=0), 0) for name, columns in lamps.items()}
    irradiance = {name: np.mean([rig.emitters[column][1].irradiance for column in columns], axis=0) for name, columns in lamps.items()}
    write_text(path, json.dumps({
        "schema": CHART_SCHEMA, "target": chart.reflectance[:-1].tolist(),
        "irradiance": {name: digits(each) for name, each in irradiance.items()},
        "primaries": {name: [digits(patch) for patch in each] for name, each in readings.items()}}, indent=1) + "\n")


def _absolute(request: RigCalibrationRequest) -> bool:
    """Return whether the target says what an irradiance is."""
    return request.albedo is not None or request.target is RigTarget.CHART


def _scale(request: RigCalibrationRequest, measured: dict[int, MeasuredPrimary]) -> np.ndarray:
    """Return the factors [3] of readings to irradiances: by the albedo, or such that the mean of all irradiances is 1."""
    if request.target is RigTarget.CHART:  # whose reflectances are part of its shading
        return np.full(3, np.pi)
    if request.albedo is not None:
        return (1.0 if request.target is RigTarget.MIRROR_BALL else np.pi) / np.array(request.albedo)
    return np.full(3, 1 / np.mean([each.irradiance for each in measured.values()]))


def _with_measured(rig: Rig, measured: dict[int, MeasuredPrimary], factor: np.ndarray, space: str) -> Rig:
    """Return the rig with the measured primaries; a response that was not measured stays."""
    lamps, column = [], 0
    for lamp in rig.lights:
        primaries = []
        for primary in lamp.primaries:
            if column in measured:
                each = measured[column]
                update: dict[str, Any] = {"irradiance": tuple(digits(each.irradiance * factor))}
                if each.drives >= LEAST_DRIVES:
                    update["response"] = each.response
                primary = primary.model_copy(update=update)
            primaries.append(primary)
            column += 1
        lamps.append(lamp.model_copy(update={"primaries": tuple(primaries)}))
    return rig.model_copy(update={"lights": tuple(lamps), "color_space": space})


def _entry(rig: Rig, column: int, found: MeasuredPrimary | CalibrationError, factor: np.ndarray, misfit: float,
           said: Sequence[str], shots: list[Shot]) -> dict[str, Any]:
    index, primary = rig.emitters[column]
    named = {"light": rig.lights[index].name, "primary": primary.name, "images": [shot.frame.image for shot in shots]}
    if isinstance(found, CalibrationError):
        return {**named, "left": str(found), "flags": ["left as it was"]}
    flags = [*said, *([f"the target misses Lambert's law by {misfit:.0%}"] if misfit > GLOSS else [])]
    if found.drives == 2:
        flags.append("two levels: the response is not measured")
    irradiance = found.irradiance * factor
    curve = "not measured" if found.drives < LEAST_DRIVES else "linear" if found.response is None else f"{found.drives} levels"
    return {**named, "irradiance": digits(irradiance), "sigma": digits(found.sigma * factor),
            "relative_sigma": float(f"{(found.sigma * factor).max() / irradiance.max():.3g}"), "residual": float(f"{found.residual:.3g}"),
            "misfit": float(f"{misfit:.3g}"), "curve": curve, "response_sigma": float(f"{found.response_sigma:.3g}"),
            "was": list(primary.irradiance), "flags": flags}
