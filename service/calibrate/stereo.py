"""Calibration of several cameras from a chessboard that they see at the same moments, with the error of each view.

Each camera is calibrated by Zhang's method from its own views of the board; the pose of each other camera then follows from the views
that it shares with the first, with the intrinsics of both held. So the first camera has the same intrinsics beside every other one.

Source: Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, section 3.

Convention: as in solvers/procam.py: image coordinates have pixel centres at halves, points in space are on OpenCV's axes.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from service.calibrate.results import calibrated_camera, lens_facts, manifests_to_replace, write_results
from service.calibrate.solvers.charuco import charuco_of, find_board, holds_a_pose
from service.calibrate.solvers.procam import LEAST_VIEWS, LENS_FLAGS, Lens, board_points, lens_of
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import StereoRequest
from stage.capture.camera import OtherCamera
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Manifest
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import CalibrationError, ManifestError
from stage.importers.opencv_file import camera_from_projector
from stage.model import Resolution

MOST_ERROR_PX = 0.5
"""Error of a view, root mean square, from which it is remarked on."""


class SharedView(NamedTuple):
    """The corners of the board in one pose, as two cameras see them."""

    name: str
    first: np.ndarray  # [corners, 2] image coordinates of the first camera
    other: np.ndarray  # [corners, 2] image coordinates of the other camera, in the same order


class StereoPose(NamedTuple):
    """The pose of another camera, with the errors of the views that it shares with the first."""

    camera_from_other: np.ndarray  # [4, 4] float64, metres, camera frames
    first_error_px: np.ndarray  # [views] root mean square of each view, of the first camera
    other_error_px: np.ndarray  # [views] the same of the other camera
    rms_px: float


def alike_order(first: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the corners of another camera in the order of those of the first.

    A board of two odd or two even counts looks the same upside down, and each camera's corners may begin at either end. Cameras that are
    turned against each other by less than a quarter turn see the first and the last corner in the same direction.
    """
    return other if (first[-1] - first[0]) @ (other[-1] - other[0]) >= 0 else other[::-1]


def _seen_by_both(first: np.ndarray, other: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(first).all(axis=-1) & np.isfinite(other).all(axis=-1))


def calibrate_lens(corners: Sequence[np.ndarray], board: tuple[int, int], square_m: float, size: Resolution, name: str) -> Lens:
    """Calibrate one camera from the image coordinates of all corners of the board in each view, [corners, 2], NaN where
    one is not seen."""
    if len(corners) < LEAST_VIEWS:
        raise CalibrationError(f"{name}: {len(corners)} of the views show the board: give {LEAST_VIEWS} or more, the board tilted "
                               "differently in each")
    every, seen = board_points(board, square_m), [np.isfinite(view).all(axis=-1) for view in corners]
    points = [every[kept] for kept in seen]
    shown = [view[kept].astype(np.float32) for view, kept in zip(corners, seen, strict=True)]
    try:
        rms, k, d, _, _ = cv2.calibrateCamera(points, shown, size, None, None, flags=LENS_FLAGS)
    except cv2.error as error:
        raise CalibrationError(f"{name}: the poses of the board do not determine the camera ({str(error.err).strip().lower()}): tilt it "
                               "differently from view to view") from error
    lens = lens_of(k, d, rms)
    if not (np.isfinite(lens.focal).all() and 0.1 < max(lens.focal) / max(size) < 100):
        raise CalibrationError(f"{name}: the focal length comes out as {lens.focal[0]:.3g} px: the poses do not determine it, tilt the "
                               "board differently from view to view")
    return lens


def calibrate_pose(views: Sequence[SharedView], board: tuple[int, int], square_m: float, first: Lens, other: Lens, size: Resolution,
                   name: str) -> StereoPose:
    """Find where another camera stands, from three views or more of the corners that both see; `size` is that of the first camera's
    images."""
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(f"{name}: {len(views)} of the views show the board to it and to the first camera: give {LEAST_VIEWS} or "
                               "more")
    every, kept = board_points(board, square_m), [_seen_by_both(view.first, view.other) for view in views]
    points = [every[both] for both in kept]
    seen = [view.first[both].astype(np.float32) for view, both in zip(views, kept, strict=True)]
    also = [view.other[both].astype(np.float32) for view, both in zip(views, kept, strict=True)]
    stop = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9
    rms, _, _, _, _, rotation, translation, _, _, _, _, errors = cv2.stereoCalibrateExtended(
        points, seen, also, *_matrices(first), *_matrices(other), size, np.eye(3), np.zeros((3, 1)), flags=cv2.CALIB_FIX_INTRINSIC,
        criteria=stop)
    return StereoPose(camera_from_projector(rotation, translation.ravel()), errors[:, 0], errors[:, 1], float(rms))


def _matrices(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera matrix and the distortion vector of OpenCV, for corners whose pixel centres lie at halves."""
    (k1, k2, k3), (p1, p2) = lens.distortion.k, lens.distortion.p
    matrix = np.array([[lens.focal[0], 0, lens.principal[0]], [0, lens.focal[1], lens.principal[1]], [0, 0, 1]])
    return matrix, np.array([k1, k2, p1, p2, k3])


class StereoResult(NamedTuple):
    """The files that were written, and the errors of the views."""

    manifest_paths: tuple[Path, ...]
    report_path: Path
    """Beside the first manifest; each manifest has one."""
    rows: list[tuple[str, ...]]
    """Frame, other camera, error of the first camera, of the other, remark."""
    summary: str
    """Error and baseline of each other camera."""


class BoardFrame(NamedTuple):
    """The corners that each camera sees in one frame, or why it sees none."""

    name: str
    corners: tuple[np.ndarray | str, ...]  # [corners, 2] of the first camera and of each other one


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
        found.append(BoardFrame(frame.image, tuple(_corners(capture, name, request) for name in names)))
        timings.advance(len(found))
    timings.stage("fit", 1)
    cameras = capture.manifest.other_cameras
    named = [(capture.camera.resolution, "the camera"), *((other.resolution, other.name) for other in cameras)]
    for number, (_, name) in enumerate(named):
        reasons = [corners for frame in found if isinstance(corners := frame.corners[number], str)]
        if len(reasons) == len(found):
            raise CalibrationError(f"{name}: 0 of the views show the board: {reasons[0]}")
    lenses = [calibrate_lens([corners for frame in found if not isinstance(corners := frame.corners[number], str)], request.board,
                             request.square_m, size, name) for number, (size, name) in enumerate(named)]
    shared = [[view for frame in found if (view := _shared(frame, number, request)) is not None] for number in range(1, len(named))]
    poses = [calibrate_pose(views, request.board, request.square_m, lenses[0], lens, capture.camera.resolution, other.name)
             for views, lens, other in zip(shared, lenses[1:], cameras, strict=True)]
    timings.close()
    paths = manifests_to_replace(targets, manifest_paths)
    return _write(request, targets, paths, lenses, poses, shared)


def _check_cameras(target: Capture, capture: Capture) -> None:
    theirs, ours = ([(other.name, other.resolution) for other in each.manifest.other_cameras] for each in (target, capture))
    if theirs != ours:
        raise ManifestError(f"{target.folder / FILE_NAME}: other_cameras: differ in name or resolution from those of {capture.folder}: one "
                            "calibration is for the same cameras")
    if target.camera.resolution != capture.camera.resolution:
        raise ManifestError(f"{target.folder / FILE_NAME}: camera.resolution: differs from that of {capture.folder}: one calibration is "
                            "for the same cameras")


def _shared(frame: BoardFrame, number: int, request: StereoRequest) -> SharedView | None:
    """Return the corners of a frame that the first camera and another one see; None where these are too few."""
    first, theirs = frame.corners[0], frame.corners[number]
    if isinstance(first, str) or isinstance(theirs, str):
        return None
    if request.markers is None:
        theirs = alike_order(first, theirs)
    return SharedView(frame.name, first, theirs) if holds_a_pose(np.flatnonzero(_seen_by_both(first, theirs)), request.board) else None


def _corners(capture: Capture, name: str, request: StereoRequest) -> np.ndarray | str:
    """Return the corners of the board in an image, or why there are none."""
    linear = linearise(capture.recorded_whole(name), capture.manifest.color_space)
    return find_board(linear @ np.array(GREY_WEIGHTS, np.float32), request.board, charuco_of(request))


def _write(request: StereoRequest, targets: list[Capture], paths: tuple[Path, ...], lenses: list[Lens], poses: list[StereoPose],
           shared: list[list[SharedView]]) -> StereoResult:
    cameras = targets[0].manifest.other_cameras
    rows: list[tuple[str, ...]] = []
    entries: list[dict[str, Any]] = []
    for other, lens, pose, views in zip(cameras, lenses[1:], poses, shared, strict=True):
        errors = list(zip(pose.first_error_px, pose.other_error_px, strict=True))
        rows += [(view.name, other.name, f"{first:.3f}", f"{second:.3f}", "stands out" if max(first, second) > MOST_ERROR_PX else "")
                 for view, (first, second) in zip(views, errors, strict=True)]
        entries.append({"name": other.name, **lens_facts(lens), "rms_px": float(f"{pose.rms_px:.4g}"), "baseline_m": _baseline(pose),
                        "views": [{"frame": view.name, "camera_px": float(f"{first:.4g}"), "other_px": float(f"{second:.4g}")}
                                  for view, (first, second) in zip(views, errors, strict=True)]})
    section = {"capture": str(request.capture), "camera": lens_facts(lenses[0]), "other_cameras": entries}
    reports = [write_results("stereo", request, _updated(target.manifest, lenses, poses), path, section)
               for target, path in zip(targets, paths, strict=True)]
    summary = ", ".join(f"{other.name}: {pose.rms_px:.3f} px RMS, baseline {_baseline(pose):.4f} m"
                        for other, pose in zip(cameras, poses, strict=True))
    return StereoResult(paths, reports[0], rows, summary)


def _baseline(pose: StereoPose) -> float:
    return float(f"{np.linalg.norm(pose.camera_from_other[:3, 3]):.6g}")


def _updated(manifest: Manifest, lenses: list[Lens], poses: list[StereoPose]) -> Manifest:
    """Return the manifest with all cameras."""
    others = tuple(OtherCamera.model_validate({
        "name": other.name, "resolution": other.resolution, "focal_px": lens.focal, "principal_px": lens.principal,
        "distortion": lens.distortion, "camera_from_other": pose.camera_from_other.tolist()})
        for other, lens, pose in zip(manifest.other_cameras, lenses[1:], poses, strict=True))
    return manifest.model_copy(update={"camera": calibrated_camera(manifest.camera, lenses[0]), "other_cameras": others})
