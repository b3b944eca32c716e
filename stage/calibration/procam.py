"""Projector and camera from poses of a chessboard under projected light.

The projector sees nothing, but the decoded coordinates say which of its pixels lights each camera pixel. Around a corner of the board
that map is, on the plane of the board, a homography: fitted to the decoded pixels of a neighbourhood it gives the corner's place in
the projector below a pixel. With corners in both images the pair is a stereo pair: Zhang's method for each, then their pose.

Source: Moreno and Taubin, "Simple, accurate, and robust projector-camera calibration", 3DIMPVT 2012.

Convention: image coordinates here are ours, pixel centres at halves. OpenCV's corners have theirs at whole numbers and get 0.5 added
once, where they are found; what it makes of them is then in our coordinates too. Points of space are OpenCV's: y down, z forward.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stage.camera import Distortion
from stage.errors import CalibrationError

LEAST_VIEWS = 3
"""Poses that determine a camera; more, and tilted ones, make it sure."""
REACH_OF_SPACING = 0.75
"""Half side of a corner's neighbourhood, of the distance to the next corner …"""
REACH_PX = 6, 40
"""… within these bounds, camera pixels."""
SADDLE_OF_SPACING, SADDLE_PX = 0.3, (2, 11)
"""Half side of the window in which a corner's saddle is placed below a pixel, in the same way."""
LEAST_PART = 0.2
"""Of a neighbourhood's pixels that must be decoded: the light squares alone are half."""
HOMOGRAPHY_PX = 2.0
"""Projector pixels from the homography beyond which a decoded pixel is an outlier."""
OUTLIER_FACTOR, OUTLIER_PX = 2.5, 0.5
"""A view is an outlier when its error exceeds this factor of the median view's, and this many pixels."""
LENS_FLAGS = cv2.CALIB_FIX_K3
"""k3 needs corners out to the image's border to be more than a fit of noise."""


class BoardView(NamedTuple):
    """One pose of the board."""

    name: str
    camera: np.ndarray  # [corners, 2] image coordinates of the camera
    projector: np.ndarray  # [corners, 2] coordinates of the projector
    kept: np.ndarray  # [corners] int, which corners of the board these are


class Lens(NamedTuple):
    """A calibrated device."""

    focal: tuple[float, float]
    principal: tuple[float, float]
    distortion: Distortion
    rms_px: float


class ProCam(NamedTuple):
    """A calibrated pair."""

    camera: Lens
    projector: Lens
    camera_from_projector: np.ndarray  # [4, 4] float64, metres, our frames
    camera_error_px: np.ndarray  # [views] RMS of each view, in the joint fit
    projector_error_px: np.ndarray  # [views]
    rms_px: float  # of both devices in the joint fit


def find_corners(image: np.ndarray, board: tuple[int, int]) -> np.ndarray | None:
    """Inner corners of a chessboard.

    Args:
        image: [rows, cols] float32 linear, evenly lit.
        board: inner corners across and down.

    Returns:
        [corners, 2] image coordinates below a pixel, row by row of the board; None when it is not all seen.
    """
    white = max(float(np.percentile(image, 99.5)), 1e-12)
    shown = np.rint(255 * np.sqrt(np.clip(image / white, 0, 1))).astype(np.uint8)
    found, corners = cv2.findChessboardCornersSB(shown, board, flags=cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE)
    if not found:
        found, corners = cv2.findChessboardCorners(shown, board, flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    # the finder alone is good to 0.2 pixels, the saddle of the grey values to 0.1 even without blur
    window = int(np.clip(SADDLE_OF_SPACING * _spacing(np.asarray(corners).reshape(board[1], board[0], 2)), *SADDLE_PX))
    stop = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4
    corners = cv2.cornerSubPix(shown, corners, (window, window), (-1, -1), stop)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) + 0.5


def projector_corners(corners: np.ndarray, u: np.ndarray, v: np.ndarray, decoded: np.ndarray, board: tuple[int, int]) -> np.ndarray:
    """Where the corners are in the projector, by a homography around each.

    Args:
        corners: [corners, 2] camera coordinates.
        u, v: [rows, cols] decoded projector coordinates.
        decoded: [rows, cols] bool, where both are.
        board: inner corners across and down.

    Returns:
        [corners, 2] projector coordinates; NaN where too few pixels around a corner are decoded or they fit no homography.
    """
    result = np.full(corners.shape, np.nan)
    grid = corners.reshape(board[1], board[0], 2)
    reach = int(np.clip(REACH_OF_SPACING * _spacing(grid), *REACH_PX))
    for index, (x, y) in enumerate(corners):
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
    """[corners, 3] float32, the board's own frame, row by row."""
    across, down = np.meshgrid(np.arange(board[0]), np.arange(board[1]))
    return np.stack([across.ravel(), down.ravel(), np.zeros(across.size)], axis=-1).astype(np.float32) * np.float32(square_m)


def calibrate(views: Sequence[BoardView], board: tuple[int, int], square_m: float, camera_size: tuple[int, int],
              projector_size: tuple[int, int]) -> ProCam:
    """Lenses and pose from the corners of several views.

    Args:
        views: three or more.
        board: inner corners across and down.
        square_m: side of a square.
        camera_size, projector_size: width and height, pixels.

    Raises:
        CalibrationError: too few views, or poses that do not determine a camera.
    """
    if len(views) < LEAST_VIEWS:
        raise CalibrationError(f"{len(views)} of the views can be used: give {LEAST_VIEWS} or more, the board tilted differently in each")
    every = board_points(board, square_m)
    objects = [every[view.kept] for view in views]
    seen = [np.ascontiguousarray(view.camera, dtype=np.float32) for view in views]
    lit = [np.ascontiguousarray(view.projector, dtype=np.float32) for view in views]
    try:
        camera_rms, camera_k, camera_d, _, _ = cv2.calibrateCamera(objects, seen, camera_size, None, None, flags=LENS_FLAGS)
        projector_rms, projector_k, projector_d, _, _ = cv2.calibrateCamera(objects, lit, projector_size, None, None, flags=LENS_FLAGS)
        stop = cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9
        rms, camera_k, camera_d, projector_k, projector_d, turn, shift, _, _, _, _, errors = cv2.stereoCalibrateExtended(
            objects, seen, lit, camera_k, camera_d, projector_k, projector_d, camera_size, np.eye(3), np.zeros((3, 1)),
            flags=LENS_FLAGS | cv2.CALIB_USE_INTRINSIC_GUESS, criteria=stop)
    except cv2.error as error:
        raise CalibrationError(f"the poses of the board do not determine the devices ({str(error.err).strip().lower()}): "
                               "tilt it differently from view to view") from error
    flip = np.diag([1.0, -1.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = flip @ turn.T @ flip, flip @ (-turn.T @ shift).ravel()
    lenses = [_lens(k, d, rms) for k, d, rms in ((camera_k, camera_d, camera_rms), (projector_k, projector_d, projector_rms))]
    for lens, size, what in zip(lenses, (camera_size, projector_size), ("camera", "projector"), strict=True):
        if not (np.isfinite(lens.focal).all() and 0.1 < max(lens.focal) / max(size) < 100):
            raise CalibrationError(f"the focal length of the {what} comes out as {lens.focal[0]:.3g} px: the poses do not determine it, "
                                   "tilt the board differently from view to view")
    return ProCam(lenses[0], lenses[1], pose, errors[:, 0], errors[:, 1], float(rms))


def outliers(found: ProCam) -> np.ndarray:
    """[views] bool: views whose error stands out of the others'."""
    worst = np.maximum(found.camera_error_px, found.projector_error_px)
    return np.asarray((worst > OUTLIER_FACTOR * np.median(worst)) & (worst > OUTLIER_PX))


def _spacing(grid: np.ndarray) -> float:
    """Median distance between neighbouring corners, [rows, cols, 2], pixels."""
    return float(np.median(np.concatenate([np.linalg.norm(np.diff(grid, axis=axis), axis=-1).ravel() for axis in (0, 1)])))


def _lens(k: np.ndarray, d: np.ndarray, rms: float) -> Lens:
    k1, k2, p1, p2, k3 = (float(value) for value in np.append(d.ravel(), np.zeros(5))[:5])
    return Lens((float(k[0, 0]), float(k[1, 1])), (float(k[0, 2]), float(k[1, 2])),
                Distortion(model="brown_conrady", k=(k1, k2, k3), p=(p1, p2)), float(rms))
