"""Calibration of a projector and a camera from poses of a chessboard under projected patterns.

A projector records no image, but the decoded patterns give the projector coordinates of each camera pixel. Near a corner of the board
this map is a homography of the plane of the board; fitted to the decoded pixels around the corner it gives the corner in the
projector with sub-pixel accuracy. With corners in both images, both are calibrated as cameras are (boards/bundle.py).

Source: Moreno and Taubin, "Simple, accurate, and robust projector-camera calibration", 3DIMPVT 2012 (local homographies);
    Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, section 3.

Convention: image coordinates have pixel centres at halves. OpenCV's corners have them at whole numbers and get 0.5 added once, when
they are found. Points in space are on OpenCV's axes: y down, z forward.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.boards.alone import Pinhole, Sight, each_alone
from service.calibrate.solvers.boards.bundle import Certainty, adjust
from service.calibrate.solvers.boards.contradictions import contradiction
from stage.capture.camera import Distortion
from stage.errors import CalibrationError
from stage.importers.opencv_file import distortion_of

LEAST_VIEWS = 3
"""The least count of poses that determine a camera; more and differently tilted poses make it more accurate."""
REACH_OF_SPACING = 0.75
"""Half the side of the neighbourhood of a corner, relative to the distance to the next corner."""
REACH_PX = 6, 40
"""The least and the largest half side of a neighbourhood, in camera pixels."""
SADDLE_OF_SPACING, SADDLE_PX = 0.3, (2, 11)
"""Half the side of the window for the sub-pixel position of a corner: relative to the corner distance, and its bounds in pixels."""
LEAST_PART = 0.2
"""The part of the pixels of a neighbourhood that must be decoded; its white squares are half of it."""
HOMOGRAPHY_PX = 2.0
"""A decoded pixel that lies farther from the homography, in projector pixels, is an outlier."""
OUTLIER_FACTOR, OUTLIER_PX = 2.5, 0.5
"""A view is an outlier when its error exceeds this multiple of the median error, and this many pixels."""


class BoardView(NamedTuple):
    """The corners of the board in one pose, as camera and projector see them."""

    name: str
    camera: np.ndarray  # [corners, 2] image coordinates of the camera
    projector: np.ndarray  # [corners, 2] coordinates of the projector
    kept: np.ndarray  # [corners] int, indices of these corners on the board


class Lens(NamedTuple):
    """The calibrated intrinsics of a camera or projector."""

    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: Distortion
    rms_px: float


class ProCam(NamedTuple):
    """The calibration of a projector and a camera, with its errors."""

    camera: Lens
    projector: Lens
    camera_from_projector: np.ndarray  # [4, 4] float64, metres, camera frames
    camera_error_px: np.ndarray  # [views] root mean square of each view in the joint fit
    projector_error_px: np.ndarray  # [views] the same for the projector
    rms_px: float  # of camera and projector in the joint fit
    certainty: Certainty


def eight_bits(image: np.ndarray) -> np.ndarray:
    """Return a linear image as 8 bits, brightened to its white and encoded by a square root."""
    white = max(float(np.percentile(image, 99.5)), 1e-12)
    return np.asarray(np.rint(255 * np.sqrt(np.clip(image / white, 0, 1))), dtype=np.uint8)


def find_corners(image: np.ndarray, board: tuple[int, int]) -> np.ndarray | None:
    """Find the inner corners of a chessboard in an image.
    `image`: [rows, cols] float32, linear, evenly lit. Returns [corners, 2] sub-pixel image coordinates, row by row of the board; None when
    a corner is not visible."""
    shown = eight_bits(image)
    found, corners = cv2.findChessboardCornersSB(shown, board, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        found, corners = cv2.findChessboardCorners(shown, board, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    return refined(shown, np.asarray(corners).reshape(-1, 2), board, SADDLE_OF_SPACING)


def refined(shown: np.ndarray, corners: np.ndarray, board: tuple[int, int], window_of_spacing: float) -> np.ndarray:
    """Return the image coordinates [corners, 2] of the saddle points of the grey values beside corners in OpenCV's pixels; NaN stays."""
    # the finders alone are accurate to 0.2 pixels, the saddle point of the grey values to 0.1 pixels even without blur
    window = int(np.clip(window_of_spacing * _spacing(corners.reshape(board[1], board[0], 2)), *SADDLE_PX))
    stop = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4
    seen = np.isfinite(corners).all(axis=-1)
    result = np.full(corners.shape, np.nan)
    start = corners[seen].astype(np.float32).reshape(-1, 1, 2)
    result[seen] = cv2.cornerSubPix(shown, start, (window, window), (-1, -1), stop).reshape(-1, 2) + 0.5
    return result


def projector_corners(corners: np.ndarray, u: np.ndarray, v: np.ndarray, decoded: np.ndarray, board: tuple[int, int]) -> np.ndarray:
    """Return the corners of the board in the image of the projector, by a homography around each corner.
    `corners`: [corners, 2] image coordinates of the camera, NaN where one is not seen. `u`, `v`: [rows, cols] decoded projector
    coordinates. `decoded`: [rows, cols] bool, True where both coordinates are decoded. Returns [corners, 2] projector coordinates; NaN
    where too few pixels around a corner are decoded, or they fit no homography."""
    result = np.full(corners.shape, np.nan)
    grid = corners.reshape(board[1], board[0], 2)
    reach = int(np.clip(REACH_OF_SPACING * _spacing(grid), *REACH_PX))
    for index in np.flatnonzero(np.isfinite(corners).all(axis=-1)):
        x, y = corners[index]
        row, col = int(y), int(x)
        top, left = max(row - reach, 0), max(col - reach, 0)
        box = slice(top, row + reach + 1), slice(left, col + reach + 1)
        rows, cols = np.nonzero(decoded[box])
        if len(rows) < LEAST_PART * (2 * reach + 1) ** 2:
            continue
        # about the corner, so that the homography is well conditioned
        here = np.stack([cols + left + 0.5 - x, rows + top + 0.5 - y], axis=-1)
        there = np.stack([u[box][rows, cols], v[box][rows, cols]], axis=-1).astype(np.float64)
        middle = np.median(there, axis=0)
        matrix, inside = cv2.findHomography(here, there - middle, cv2.RANSAC, HOMOGRAPHY_PX)
        if matrix is None or inside.mean() < 0.5:
            continue
        result[index] = matrix[:2, 2] / matrix[2, 2] + middle
    return result


def board_points(board: tuple[int, int], square_m: float) -> np.ndarray:
    """Return the corners [corners, 3] float32 in metres in the frame of the board, row by row."""
    across, down = np.meshgrid(np.arange(board[0]), np.arange(board[1]))
    return np.stack([across.ravel(), down.ravel(), np.zeros(across.size)], axis=-1).astype(np.float32) * np.float32(square_m)


def calibrate(views: Sequence[BoardView], board: tuple[int, int], square_m: float, camera_size: tuple[int, int],
              projector_size: tuple[int, int]) -> ProCam:
    """Calibrate projector and camera from the corners of three views or more; sizes are width and height in pixels."""
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(f"{len(views)} of the views can be used: give {LEAST_VIEWS} or more, the board tilted differently in each")
    every = board_points(board, square_m)
    sights = [Sight(device, number, every[view.kept], (view.camera, view.projector)[device]) for device in (0, 1)
              for number, view in enumerate(views)]
    names = "the camera", "the projector"
    devices = each_alone(sights, (camera_size, projector_size), names)
    found = adjust(sights, devices)
    camera, projector = (lens_of(lens, device.rms_px) for lens, device in zip(found.lenses, devices, strict=True))
    errors, lit = found.errors_px.reshape(2, len(views))
    said = contradiction(found, names, [view.name for view in views])
    return ProCam(camera, projector, found.pose(1), errors, lit, found.rms_px(), found.certainty(1, "camera and projector", said))


def first_alike(views: Sequence[Sequence[np.ndarray | str]]) -> list[int]:
    """Return of each view the first view with exactly the same corners, which is itself but for copies: noise is never the same twice.
    `views`: corners [corners, 2] as each device sees them, or why it sees none."""
    keys = [tuple(corners if isinstance(corners, str) else corners.tobytes() for corners in view) for view in views]
    return [keys.index(key) for key in keys]


def outliers(found: ProCam) -> np.ndarray:
    """Return [views] bool, True for views whose error is far above that of the others."""
    worst = np.maximum(found.camera_error_px, found.projector_error_px)
    return np.asarray((worst > OUTLIER_FACTOR * np.median(worst)) & (worst > OUTLIER_PX))


def _spacing(grid: np.ndarray) -> float:
    """Return the median distance in pixels between neighbouring corners of a grid [rows, cols, 2]; NaN is left out."""
    return float(np.nanmedian(np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)])))


def lens_of(lens: Pinhole, rms_px: float) -> Lens:
    """Return a lens from OpenCV's. `rms_px`: of the device alone."""
    (fx, _, cx), (_, fy, cy) = lens.matrix[:2]
    return Lens((float(fx), float(fy)), (float(cx), float(cy)), distortion_of(lens.distortion), rms_px)
