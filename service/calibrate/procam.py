"""Calibration of a projector-camera pair from poses of a chessboard under projected patterns, with the error of each view."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.status import SOLVED
from kernels.structured.pattern_frames import NoiseModel
from service.calibrate.results import calibrated_camera, digits, lens_facts, manifests_to_replace, write_results
from service.calibrate.solvers.boards.bundle import Certainty
from service.calibrate.solvers.charuco import charuco_of, find_board, holds_a_pose
from service.calibrate.solvers.procam import BoardView, ProCam, calibrate, first_alike, outliers, projector_corners
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import sample_of
from service.depth.patterns.patterns import checked, decoded_bands, read_codes
from service.depth.patterns.readings import full_scale, scene_colour
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import ProcamRequest
from service.requests.depth import DepthRequest
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Manifest
from stage.capture.projector import Projector
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import CalibrationError, ManifestError
from stage.model import Resolution
from stage.stack.pattern_exposures import JoinedExposures, frames_shown
from stage.stack.planes import frame_planes

LEAST_CORNERS = 0.5
"""Part of the corners that the camera sees which must be found in the projector, for a view to count."""


class ProcamResult(NamedTuple):
    """The files that were written, and the errors of the views."""

    manifest_paths: tuple[Path, ...]
    report_path: Path
    """Beside the first manifest; each manifest has one."""
    rows: list[tuple[str, ...]]
    """View, camera error, projector error, remark."""
    rms_px: float
    baseline_m: float
    certainty: Certainty

    @property
    def warnings(self) -> list[str]:
        """What the boards leave open."""
        return self.certainty.warnings()


def procam(request: ProcamRequest, progress: Progress | None = None, *, manifest_paths: Sequence[Path] | None = None) -> ProcamResult:
    """Calibrate a projector-camera pair, and write camera, projector and their pose to the manifests.
    `manifest_paths`: the manifest to write for each of `captures`, then for each of `apply_to`; None: their own."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    captures = [Capture.open(path) for path in request.captures]
    others = [Capture.open(path) for path in request.apply_to]
    size = _projector_size(captures, request)
    for capture in (*captures, *others):
        if capture.camera.resolution != captures[0].camera.resolution:
            raise ManifestError(f"{capture.folder / FILE_NAME}: camera.resolution: differs from that of {captures[0].folder}: "
                                "one calibration is for one camera")
    views: list[BoardView] = []
    remarks: dict[str, str] = {}
    timings.stage("views", len(captures))
    for number, capture in enumerate(captures, start=1):
        view = view_of(capture, size, request, device)
        if isinstance(view, str):
            remarks[str(capture.folder)] = view
        else:
            views.append(view)
        timings.advance(number)
    timings.stage("fit", 1)
    camera_size = captures[0].camera.resolution
    if not views and remarks:
        folder, reason = next(iter(remarks.items()))
        raise CalibrationError(f"{folder}: {reason} (and so with every view)")
    firsts = first_alike([(view.camera, view.projector) for view in views])
    remarks |= {views[number].name: f"left out: a copy of {views[first].name}" for number, first in enumerate(firsts) if first < number}
    views = [view for number, view in enumerate(views) if firsts[number] == number]
    found = calibrate(views, request.board, request.square_m, camera_size, size)
    out = outliers(found)
    if request.drop_outliers and out.any():
        remarks |= {view.name: "left out: its error stands out" for view, bad in zip(views, out, strict=True) if bad}
        views = [view for view, bad in zip(views, out, strict=True) if not bad]
        found = calibrate(views, request.board, request.square_m, camera_size, size)
        out = outliers(found)
    remarks |= {view.name: "its error stands out: see --drop-outliers" for view, bad in zip(views, out, strict=True) if bad}
    timings.close()
    targets = [*captures, *others]
    paths = manifests_to_replace(targets, manifest_paths)
    return _write(request, targets, paths, found, views, remarks, size)


def view_of(capture: Capture, size: Resolution, request: ProcamRequest, device: str) -> BoardView | str:
    """Return the corners of the board as camera and projector see them, or a sentence that says why there are none."""
    frames, series = frames_shown(capture)
    given = capture.manifest.projector
    shown = PatternProjector(size) if given is None else PatternProjector(size, given.response, given.crosstalk)
    codes = read_codes(capture, frames, shown)
    columns, rows = codes.columns, codes.rows
    if columns is None or rows is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: no {'column' if columns is None else 'row'} code: "
                            "calibration needs columns and rows")
    joined = None if series is None else JoinedExposures(capture, series)
    scene = scene_colour(capture, frames, codes.collected, joined)
    if scene is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: no white frame, no inverses and no phases: "
                            "the board must be seen evenly lit")
    shape = (capture.camera.height, capture.camera.width)
    u, v, decoded = np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, bool)
    options = DepthRequest.model_fields
    with frame_planes(capture, frames, colour=codes.colour, cache=request.cache, joined=joined) as planes:
        full = full_scale(planes, capture, frames) if joined is None else joined.full_scale
        reads = 1 if series is None else len(series.times_s)
        noise = NoiseModel(options["read_noise"].default * full * reads**0.5, options["photon_gain"].default * full)
        found = checked(sample_of(planes, capture.camera, np.ones(shape, bool)), codes, shown, None, capture, frames, noise, noise, device,
                        refine=False)
        if not found.declared:
            return found.warnings[0]
        corners = find_board(scene @ np.array(GREY_WEIGHTS, np.float32), request.board, charuco_of(request))
        if isinstance(corners, str):
            return corners
        for band, axes in decoded_bands(planes, (found.codes.columns, found.codes.rows), noise, device):
            part = u[band].shape
            count = part[0] * part[1]
            first, second = (axis for axis in axes if axis is not None)
            u[band], v[band] = (to_numpy(axis.coordinate)[:count].reshape(part) for axis in (first, second))
            decoded[band] = np.logical_and(*(np.isin(to_numpy(axis.status)[:count], SOLVED).reshape(part) for axis in (first, second)))
    lit = projector_corners(corners, u, v, decoded, request.board)
    kept = np.flatnonzero(np.isfinite(lit).all(axis=-1))
    seen = int(np.isfinite(corners).all(axis=-1).sum())
    if len(kept) < LEAST_CORNERS * seen:
        return f"only {len(kept)} of {seen} corners are decoded around"
    if not holds_a_pose(kept, request.board):
        return f"{len(kept)} corners are decoded around, too few in two rows and columns to hold a pose"
    return BoardView(str(capture.folder), corners[kept], lit[kept], kept)


def _projector_size(captures: list[Capture], request: ProcamRequest) -> Resolution:
    if request.projector is not None:
        return request.projector
    sizes = {capture.manifest.projector.resolution for capture in captures if capture.manifest.projector is not None}
    if len(sizes) != 1:
        fault = "differs between the captures" if sizes else "is missing"
        raise ManifestError(f"{captures[0].folder / FILE_NAME}: projector: {fault}: "
                            "--projector WIDTHxHEIGHT says how many pixels it has")
    return sizes.pop()


def _write(request: ProcamRequest, targets: list[Capture], paths: tuple[Path, ...], found: ProCam, views: list[BoardView],
           remarks: dict[str, str], size: Resolution) -> ProcamResult:
    entries = [{"view": view.name, "corners": len(view.kept), "camera_px": float(f"{camera:.4g}"), "projector_px": float(f"{lit:.4g}"),
                "remark": remarks.get(view.name, "")}
               for view, camera, lit in zip(views, found.camera_error_px, found.projector_error_px, strict=True)]
    used = {view.name for view in views}
    left = [{"view": name, "remark": remark} for name, remark in remarks.items() if name not in used]
    baseline = float(np.linalg.norm(found.camera_from_projector[:3, 3]))
    section = {"captures": [str(path) for path in request.captures], "rms_px": float(f"{found.rms_px:.4g}"),
               "baseline_m": float(f"{baseline:.6g}"), "board_bend_m": digits(found.certainty.bend)[0], "sigma": found.certainty.facts(),
               "camera": lens_facts(found.camera), "projector": lens_facts(found.projector),
               "views": entries, "left_out": left}
    reports = [write_results("procam", request, _updated(capture.manifest, found, size), path, section)
               for capture, path in zip(targets, paths, strict=True)]
    rows: list[tuple[str, ...]] = [
        (view.name, f"{camera:.3f}", f"{lit:.3f}", remarks.get(view.name, ""))
        for view, camera, lit in zip(views, found.camera_error_px, found.projector_error_px, strict=True)]
    rows += [(name, "", "", remark) for name, remark in remarks.items() if name not in used]
    return ProcamResult(paths, reports[0], rows, found.rms_px, baseline, found.certainty)


def _updated(manifest: Manifest, found: ProCam, size: Resolution) -> Manifest:
    """Return the manifest with camera and projector, whose radiometry stays."""
    before = manifest.projector
    projector = Projector.model_validate({
        "resolution": size, "focal_px": found.projector.focal, "principal_px": found.projector.principal,
        "distortion": found.projector.distortion, "camera_from_projector": found.camera_from_projector.tolist(),
        "depth_sigma": float(f"{found.certainty.depth:.3g}"),
        **({} if before is None else {"response": before.response, "crosstalk": before.crosstalk})})
    return manifest.model_copy(update={"camera": calibrated_camera(manifest.camera, found.camera), "projector": projector})
