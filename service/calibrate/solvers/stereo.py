"""Calibration of several cameras that see one chessboard at the same moments.

Each camera is calibrated by Zhang's method from its own views of the board; the pose of each other camera then follows from the views
that it shares with the first, with the intrinsics of both held. So the first camera has the same intrinsics beside every other one.

Source: Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, section 3.

Convention: as in procam.py: image coordinates have pixel centres at halves, points in space are on OpenCV's axes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.procam import LEAST_VIEWS, LENS_FLAGS, Lens, board_points, lens_of
from stage.errors import CalibrationError
from stage.importers.opencv_file import camera_from_projector
from stage.model import Resolution


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


def calibrate_lens(corners: Sequence[np.ndarray], board: tuple[int, int], square_m: float, size: Resolution, name: str) -> Lens:
    """Calibrate one camera from the image coordinates of all corners of the board in each view, [corners, 2]."""
    if len(corners) < LEAST_VIEWS:
        raise CalibrationError(f"{name}: {len(corners)} of the views show the board: give {LEAST_VIEWS} or more, the board tilted "
                               "differently in each")
    points = [board_points(board, square_m)] * len(corners)
    try:
        rms, k, d, _, _ = cv2.calibrateCamera(points, [view.astype(np.float32) for view in corners], size, None, None, flags=LENS_FLAGS)
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
    """Find where another camera stands, from three views or more of the whole board; `size` is that of the first camera's images."""
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(f"{name}: {len(views)} of the views show the board to it and to the first camera: give {LEAST_VIEWS} or "
                               "more")
    points = [board_points(board, square_m)] * len(views)
    seen, also = [view.first.astype(np.float32) for view in views], [view.other.astype(np.float32) for view in views]
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
