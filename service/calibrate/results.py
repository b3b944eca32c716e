"""Files that the commands of `relit calibrate` share: the captures that they read and write, and calibration.json."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.calibrate.solvers.apply import LitFrame, SingleLight, check_same_setup, lit_frames, with_lights
from service.calibrate.solvers.procam import Lens
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import reported_versions, requested, with_names
from service.requests.base.base import Options
from service.requests.calibrate import FramesRequest, LightsRequest, ResponseRequest, SaturationRequest
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, ColorMatrix, Manifest, write_manifest
from stage.errors import CalibrationError
from stage.files import write_text

CALIBRATION_FILE = "calibration.json"
SCHEMA = "relit.calibration/1"


class LightCalibration(NamedTuple):
    """The files that a calibration of lights wrote, and its table."""

    manifest_path: Path
    report_path: Path
    headings: tuple[str, ...]
    rows: list[tuple[str, ...]]
    """One row for each measured light, the least certain first."""
    summary: str
    warnings: list[str]


class LightCaptures(NamedTuple):
    """The capture in which lights are measured, and the capture that they are written to."""

    source: Capture
    target: Capture
    manifest_path: Path
    lit: list[LitFrame]
    """Lit frames of the source."""


class MeasuredLight(NamedTuple):
    """The result of one light."""

    light: SingleLight | None
    """The light to write; None: its frame is left out."""
    entry: dict[str, Any]
    """The entry in the report; `flags` name what to look at."""
    row: tuple[str, ...] = ()
    """The cells of the table."""
    doubt: float = 0.0
    """Uncertainty or residual, by which the table is sorted."""


def open_capture(request: FramesRequest | SaturationRequest | ResponseRequest,
                 progress: Progress | None) -> tuple[Capture, Path, Timings]:
    """Begin the stage "open", and return the capture of a request, the manifest to write, and the timings."""
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    return capture, manifest_to_write(capture, request.out), timings


def open_captures(request: LightsRequest, progress: Progress | None) -> tuple[LightCaptures, Timings]:
    """Begin the stage "open", and return the captures of a request and the timings."""
    timings = Timings(progress)
    timings.stage("open", 1)
    source = Capture.open(request.capture)
    lit = lit_frames(source)
    target = source
    if request.apply_to is not None:
        target = Capture.open(request.apply_to)
        check_same_setup(source, target)
    return LightCaptures(source, target, manifest_to_write(target, request.out), lit), timings


def manifest_to_write(capture: Capture, out: Path | None) -> Path:
    """Return the path of the manifest that a calibration writes: `out`, or that of the capture."""
    path = capture.folder / FILE_NAME if out is None else out
    if path.suffix.lower() != ".json" or path.name == CALIBRATION_FILE or path.is_dir():
        raise RequestError(f"--out {path}: must be a .json file of its own: it takes the place of {FILE_NAME}")
    return path


def leave_out_failures(captures: LightCaptures, results: Sequence[MeasuredLight | CalibrationError], *,
                       drop_failed: bool) -> list[MeasuredLight]:
    """Return the results with each failure as a frame that is left out; without `drop_failed`, or where every light failed, raise."""
    failed = [(lit, result) for lit, result in zip(captures.lit, results, strict=True) if isinstance(result, CalibrationError)]
    if failed and (not drop_failed or len(failed) == len(results)):
        lit, error = failed[0]
        others = f" (and {len(failed) - 1} more frames)" if len(failed) > 1 else ""
        hint = "" if len(failed) == len(results) else "; --drop-failed leaves such frames out"
        raise CalibrationError(f"{captures.source.file(lit.frame.image)}: {error}{others}{hint}")
    return [MeasuredLight(None, {"dropped": str(result), "flags": ["dropped"]}) if isinstance(result, CalibrationError) else result
            for result in results]


def write_lights(
    kind: str,  # the section of the report
    request: Options, captures: LightCaptures, results: Sequence[MeasuredLight], *,
    headings: tuple[str, ...],  # of the table, between frame and flags
    summary: dict[str, Any],  # what the report says beside the lights
    relative: bool | None = None,  # whether the common scale of the measured lights is unknown; None: their strength was not measured
    warnings: Sequence[str] = (),  # what there is to say of all lights
) -> LightCalibration:
    """Write the report, then the manifest, each whole or not at all, and return what was written."""
    warnings = [*warnings, *captures.source.doubts]
    manifest = with_lights(captures.target, [result.light for result in results])
    if relative is not None:
        manifest = manifest.model_copy(update={"irradiance_scale": "relative" if relative else "absolute"})
    lights = [{"frame": lit.number, "image": lit.frame.image, **result.entry,
               "was": lit.light.model_dump(mode="json", exclude_defaults=True)}
              for lit, result in zip(captures.lit, results, strict=True)]
    measured = [(lit, result) for lit, result in zip(captures.lit, results, strict=True) if result.light is not None]
    dropped = len(results) - len(measured)
    flagged = sum(bool(result.entry["flags"]) for _, result in measured)
    report = write_results(kind, request, manifest, captures.manifest_path, {
        "capture": str(captures.source.folder), "applied_to": str(captures.target.folder),
        "measured": len(measured), "dropped": dropped, "flagged": flagged, "warnings": warnings, **summary, "lights": lights})
    measured.sort(key=lambda pair: pair[1].doubt, reverse=True)
    rows = [(lit.frame.image, *result.row, ", ".join(result.entry["flags"])) for lit, result in measured]
    counts = (len(measured), "measured"), (dropped, "left out"), (flagged, "flagged")
    text = ", ".join(f"{count} {what}" for count, what in counts if count)
    return LightCalibration(captures.manifest_path, report, ("frame", *headings, "flags"), rows, text, warnings)


def write_results(kind: str, request: Options, manifest: Manifest, manifest_path: Path, section: dict[str, Any]) -> Path:
    """Write calibration.json beside the manifest, with the sections of other commands that it held, then the manifest; return the path
    of the report."""
    path = write_report(kind, request, manifest_path.parent, section)
    write_manifest(manifest, manifest_path)
    return path


def write_report(kind: str, request: Options, folder: Path, section: dict[str, Any]) -> Path:
    """Write calibration.json into a folder, with the sections of other commands that it held; return its path."""
    path = folder / CALIBRATION_FILE
    data = {"schema": SCHEMA, **_earlier(path), kind: {"options": requested(request), **section, "versions": reported_versions()}}
    write_text(path, with_names(json.dumps(data, indent=2) + "\n"))
    return path


def manifests_to_replace(captures: Iterable[Capture], chosen: Sequence[Path] | None) -> tuple[Path, ...]:
    """Return the manifest to write for each capture: those that are chosen, one for each; None: their own."""
    return tuple(capture.folder / FILE_NAME for capture in captures) if chosen is None else tuple(chosen)


def lens_facts(lens: Lens) -> dict[str, Any]:
    """Return a lens as the report has it."""
    return {"focal_px": digits(lens.focal), "principal_px": digits(lens.principal), "k": digits(lens.distortion.k),
            "p": digits(lens.distortion.p), "rms_alone_px": float(f"{lens.rms_px:.4g}")}


def calibrated_camera(old: Camera, lens: Lens) -> Camera:
    """Return a camera with a lens that was calibrated; its place in the world and the height of its surface stay."""
    return Camera(projection="perspective", resolution=old.resolution, focal_px=lens.focal, principal_px=lens.principal,
                  distortion=lens.distortion, surface_z_m=old.surface_z_m if old.projection == "perspective" else None,
                  world_from_camera=old.world_from_camera)


def digits(values: Iterable[float]) -> list[float]:
    """Return numbers for the report, rounded to the six digits that a measurement may have."""
    return [float(f"{value:.6g}") for value in values]


def color_matrix(matrix: np.ndarray) -> ColorMatrix:
    """Return a matrix [3, 3] for the manifest, rounded to eight digits."""
    red, green, blue = ((float(f"{r:.8g}"), float(f"{g:.8g}"), float(f"{b:.8g}")) for r, g, b in matrix)
    return red, green, blue


def three_numbers(values: Iterable[float]) -> str:
    """Return three numbers as a cell of the table."""
    return " ".join(f"{value:7.3f}" for value in values)


def _earlier(path: Path) -> dict[str, Any]:
    """Return the sections of an existing report; nothing of a file that is something else."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) and data.get("schema") == SCHEMA else {}
