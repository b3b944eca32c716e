"""Calibration of several cameras from a chessboard that they see at the same moments, with the error of each view.

All cameras, and the poses of the board in all frames, are fitted to all corners at once (solvers/boards/bundle.py), also to those of frames
that some of the cameras alone see.

Convention: as in solvers/procam.py: image coordinates have pixel centres at halves, points in space are on OpenCV's axes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.calibrate.results import calibrated_camera, digits, lens_facts, manifests_to_replace, write_results
from service.calibrate.solvers.boards.alone import Sight, each_alone
from service.calibrate.solvers.boards.bundle import Certainty, adjust
from service.calibrate.solvers.boards.contradictions import contradiction
from service.calibrate.solvers.charuco import charuco_of, find_board
from service.calibrate.solvers.procam import LEAST_VIEWS, Lens, board_points, first_alike, lens_of
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import StereoRequest
from stage.capture.camera import OtherCamera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Manifest
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import CalibrationError, ManifestError
from stage.model import Resolution

MOST_ERROR_PX = 0.5
"""Error of a view, root mean square, from which it is remarked on."""


class BoardFrame(NamedTuple):
    """The corners that each camera sees in one frame, or why it sees none."""

    name: str
    corners: tuple[np.ndarray | str, ...]  # [corners, 2] of the first camera and of each other one


class OtherCalibration(NamedTuple):
    """Another camera, with its errors."""

    lens: Lens
    camera_from_other: np.ndarray  # [4, 4] float64, metres, camera frames
    rms_px: float
    certainty: Certainty
    views: list[tuple[str, float, float]]
    """For each frame in which the first camera sees the board too: the frame's name, and the root mean square errors of both in pixels."""


def alike_order(first: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the corners of another camera in the order of those of the first.

    A board of two odd or two even counts looks the same upside down, and each camera's corners may begin at either end. Cameras that are
    turned against each other by less than a quarter turn see the first and the last corner in the same direction.
    """
    return other if (first[-1] - first[0]) @ (other[-1] - other[0]) >= 0 else other[::-1]


def calibrate(frames: Sequence[BoardFrame], cameras: Sequence[tuple[str, Resolution]], board: tuple[int, int],
              square_m: float) -> tuple[Lens, list[OtherCalibration]]:
    """Calibrate cameras from all that they see of a board at the same moments.
    `cameras`: name and size of each. Returns the lens of the first one, and the other ones."""
    every = board_points(board, square_m)
    sights: list[list[Sight]] = [[] for _ in cameras]
    for view, frame in enumerate(frames):
        for device, corners in enumerate(frame.corners):
            if not isinstance(corners, str):
                seen = np.isfinite(corners).all(axis=-1)
                sights[device].append(Sight(device, view, every[seen], corners[seen]))
    firsts = {sight.view for sight in sights[0]}
    for device, (name, _) in enumerate(cameras):
        reasons = [corners for frame in frames if isinstance(corners := frame.corners[device], str)]
        if len(reasons) == len(frames):
            raise CalibrationError(f"{name}: 0 of the views show the board: {reasons[0]}")
        if len(sights[device]) < LEAST_VIEWS:
            raise CalibrationError(f"{name}: {len(sights[device])} of the views show the board: give {LEAST_VIEWS} or more, the board "
                                   "tilted differently in each")
        shared = sum(sight.view in firsts for sight in sights[device])
        if shared < LEAST_VIEWS:
            raise CalibrationError(f"{name}: {shared} of the views show the board to it and to the first camera: give {LEAST_VIEWS} or "
                                   "more")
    every_sight, (names, sizes) = [sight for own in sights for sight in own], zip(*cameras, strict=True)
    devices = each_alone(every_sight, sizes, names)
    found = adjust(every_sight, devices)
    lenses = [lens_of(lens, device.rms_px) for lens, device in zip(found.lenses, devices, strict=True)]
    errors = {(sight.device, sight.view): float(error) for sight, error in zip(found.sights, found.errors_px, strict=True)}
    said = contradiction(found, names, [frame.name for frame in frames])
    others = []
    for device, (name, _) in enumerate(cameras[1:], start=1):
        both = [sight.view for sight in sights[device] if sight.view in firsts]
        pairs = [(frames[view].name, errors[0, view], errors[device, view]) for view in both]
        rms = found.rms_px([sight.device in (0, device) and sight.view in both for sight in found.sights])
        others.append(OtherCalibration(lenses[device], found.pose(device), rms, found.certainty(device, name, said), pairs))
    return lenses[0], others


class StereoResult(NamedTuple):
    """The files that were written, and the errors of the views."""

    manifest_paths: tuple[Path, ...]
    report_path: Path
    """Beside the first manifest; each manifest has one."""
    rows: list[tuple[str, ...]]
    """Frame, other camera, error of the first camera, of the other, remark."""
    summary: str
    """Error and baseline of each other camera, and how sure depths are."""
    warnings: list[str]


def stereo(request: StereoRequest, progress: Progress | None = None, *, manifest_paths: Sequence[Path] | None = None) -> StereoResult:
    """Calibrate several cameras, and write them to the manifests.
    `manifest_paths`: the manifest to write for the capture, then for each of `apply_to`; None: their own."""
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    targets = [capture, *(Capture.open(path) for path in request.apply_to)]
    frames = [frame for frame in capture.manifest.frames if frame.stereo is not None]
    if not frames:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: none has stereo images: give one frame for each pose of the board, "
                            "with the images of all cameras")
    for target in targets:
        _check_cameras(target, capture)
    timings.stage("views", len(frames))
    found: list[BoardFrame] = []
    for frame in frames:
        assert frame.stereo is not None  # chosen so
        names = frame.image, *frame.stereo.images
        corners = [_corners(capture, name, request) for name in names]
        shown = next((each for each in corners if not isinstance(each, str)), None)
        if request.markers is None and shown is not None:
            corners = [each if isinstance(each, str) else alike_order(shown, each) for each in corners]
        found.append(BoardFrame(frame.image, tuple(corners)))
        timings.advance(len(found))
    timings.stage("fit", 1)
    named = [("the camera", capture.camera.resolution), *((other.name, other.resolution) for other in capture.manifest.other_cameras)]
    copies = []
    for number, first in enumerate(first_alike([frame.corners for frame in found])):
        if first < number and not all(isinstance(corners, str) for corners in found[number].corners):
            reason = f"left out: a copy of {found[first].name}"
            copies.append(f"{found[number].name}: {reason}")
            found[number] = BoardFrame(found[number].name, (reason,) * len(named))
    lens, others = calibrate(found, named, request.board, request.square_m)
    timings.close()
    paths = manifests_to_replace(targets, manifest_paths)
    return _write(request, targets, paths, lens, others, copies)


def _check_cameras(target: Capture, capture: Capture) -> None:
    theirs, ours = ([(other.name, other.resolution) for other in each.manifest.other_cameras] for each in (target, capture))
    if theirs != ours:
        raise ManifestError(f"{target.folder / FILE_NAME}: other_cameras: differ in name or resolution from those of {capture.folder}: one "
                            "calibration is for the same cameras")
    if target.camera.resolution != capture.camera.resolution:
        raise ManifestError(f"{target.folder / FILE_NAME}: camera.resolution: differs from that of {capture.folder}: one calibration is "
                            "for the same cameras")


def _corners(capture: Capture, name: str, request: StereoRequest) -> np.ndarray | str:
    """Return the corners of the board in an image, or why there are none."""
    linear = linearise(capture.recorded_whole(name), capture.manifest.color_space)
    return find_board(linear @ np.array(GREY_WEIGHTS, np.float32), request.board, charuco_of(request))


def _write(request: StereoRequest, targets: list[Capture], paths: tuple[Path, ...], lens: Lens,
           others: list[OtherCalibration], copies: list[str]) -> StereoResult:
    names = [other.name for other in targets[0].manifest.other_cameras]
    rows: list[tuple[str, ...]] = []
    entries: list[dict[str, Any]] = []
    for name, other in zip(names, others, strict=True):
        rows += [(frame, name, f"{first:.3f}", f"{second:.3f}", "stands out" if max(first, second) > MOST_ERROR_PX else "")
                 for frame, first, second in other.views]
        entries.append({"name": name, **lens_facts(other.lens), "rms_px": float(f"{other.rms_px:.4g}"), "baseline_m": _baseline(other),
                        "sigma": other.certainty.facts(),
                        "views": [{"frame": frame, "camera_px": float(f"{first:.4g}"), "other_px": float(f"{second:.4g}")}
                                  for frame, first, second in other.views]})
    section = {"capture": str(request.capture), "camera": lens_facts(lens), "other_cameras": entries,
               "board_bend_m": digits(others[0].certainty.bend)[0]}
    reports = [write_results("stereo", request, _updated(target.manifest, lens, others), path, section)
               for target, path in zip(targets, paths, strict=True)]
    summary = ", ".join(f"{name}: {other.rms_px:.3f} px RMS, baseline {_baseline(other):.4f} m, "
                        f"depths known to {100 * other.certainty.depth:.2g} %" for name, other in zip(names, others, strict=True))
    warnings = [*copies, *(f"{name}: {said}" for name, other in zip(names, others, strict=True) for said in other.certainty.warnings())]
    return StereoResult(paths, reports[0], rows, summary, warnings)


def _baseline(other: OtherCalibration) -> float:
    return float(f"{np.linalg.norm(other.camera_from_other[:3, 3]):.6g}")


def _updated(manifest: Manifest, lens: Lens, others: list[OtherCalibration]) -> Manifest:
    """Return the manifest with all cameras."""
    cameras = tuple(OtherCamera.model_validate({
        "name": camera.name, "resolution": camera.resolution, "focal_px": other.lens.focal, "principal_px": other.lens.principal,
        "distortion": other.lens.distortion, "camera_from_other": other.camera_from_other.tolist(),
        "depth_sigma": float(f"{other.certainty.depth:.3g}")})
        for camera, other in zip(manifest.other_cameras, others, strict=True))
    return manifest.model_copy(update={"camera": calibrated_camera(manifest.camera, lens), "other_cameras": cameras})
