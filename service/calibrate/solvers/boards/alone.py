"""Cameras and projectors that are calibrated alone, each from the boards that it sees.

Source: Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, section 3; Hartley and Zisserman, "Multiple View
    Geometry in Computer Vision", 2nd ed. 2004, section 7.1, for the direct linear transformation.

Convention: the axes of OpenCV, y down, z forward.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from stage.errors import CalibrationError

TILT = "tilt the board by 30° or more, to another side in each view, and bring it nearer and farther"


class Pinhole(NamedTuple):
    """A lens as OpenCV has it."""

    matrix: np.ndarray  # [3, 3]
    distortion: np.ndarray  # [k1, k2, p1, p2]


class Sight(NamedTuple):
    """The corners of the board of one view, as one device sees them."""

    device: int
    view: int
    board: np.ndarray  # [corners, 3] in the frame of the board
    corners: np.ndarray  # [corners, 2]


class Alone(NamedTuple):
    """A device that was calibrated from its own sights alone."""

    lens: Pinhole
    boards: dict[int, np.ndarray]
    """By the number of each view that the device sees: rotation vector and translation [6] from the board to the device."""
    rms_px: float
    size: tuple[int, int]
    """Width and height of its image."""


def alone(sights: Sequence[Sight], size: tuple[int, int], name: str, start: np.ndarray | None = None) -> Alone:
    """Calibrate a device from its own sights, by Zhang's method. `size`: width and height in pixels. `start`: its matrix,
    roughly, which boards that are not flat need."""
    matrix = np.eye(3) if start is None else start.copy()
    aside = np.minimum(matrix[:2, 2], 0)  # OpenCV begins elsewhere than in the middle with a principal point in the image alone
    matrix[:2, 2] -= aside
    within = size if start is None else np.ceil(np.maximum(size, matrix[:2, 2] + 1)).astype(int).tolist()
    try:
        rms, matrix, distortion, turns, shifts = cv2.calibrateCamera(
            [sight.board.astype(np.float32) for sight in sights], [(sight.corners - aside).astype(np.float32) for sight in sights], within,
            matrix, np.zeros(5),  # without corners at the border of the image k3 would fit noise
            flags=cv2.CALIB_FIX_K3 | (0 if start is None else cv2.CALIB_USE_INTRINSIC_GUESS))
        matrix[:2, 2] += aside
    except cv2.error as error:
        raise CalibrationError(f"the poses of the board do not determine {name} ({str(error.err).strip().lower()}): {TILT}") from error
    focal = np.diag(matrix)[:2]
    if not (np.isfinite(matrix).all() and focal.min() > 0.1 * max(size) and focal.max() < 100 * max(size)):
        wrong = focal.max() if focal.min() > 0.1 * max(size) else focal.min()
        raise CalibrationError(f"the focal length of {name} comes out as {wrong:.3g} px: the poses do not determine it: {TILT}")
    boards = {sight.view: np.concatenate([turn.ravel(), shift.ravel()]) for sight, turn, shift in zip(sights, turns, shifts, strict=True)}
    return Alone(Pinhole(matrix, distortion.ravel()[:4]), boards, float(rms), size)


def each_alone(sights: Sequence[Sight], sizes: Sequence[tuple[int, int]], names: Sequence[str]) -> list[Alone]:
    """Calibrate all devices, each from its own sights alone. The others begin also where they see the boards as the first one has them, and
    the better fit counts: a principal point far outside the image, as of lens shift, is missed from the middle."""
    found = [alone(sights_of(0, sights), sizes[0], names[0])]
    for device, (size, name) in enumerate(zip(sizes[1:], names[1:], strict=True), start=1):
        own = sights_of(device, sights)
        fits: list[Alone] = []
        failures: list[CalibrationError] = []
        for start in (None, camera_matrix(own, found[0]) * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]):  # without shear
            try:
                fits.append(alone(own, size, name, start))
            except CalibrationError as error:
                failures.append(error)
        if not fits:
            raise failures[0]
        found.append(min(fits, key=lambda fit: fit.rms_px))
    return found


def sights_of(device: int, sights: Sequence[Sight]) -> list[Sight]:
    """Return the sights of one device."""
    return [sight for sight in sights if sight.device == device]


def camera_matrix(sights: Sequence[Sight], first: Alone) -> np.ndarray:
    """Return the matrix [3, 3] of a device without distortion, with shear, from its sights of boards that another one places, by the direct
    linear transformation (Hartley and Zisserman, section 7.1)."""
    shared = [sight for sight in sights if sight.view in first.boards]
    points, corners = (np.concatenate(parts) for parts in zip(
        *((moved(sight.board, first.boards[sight.view]), sight.corners) for sight in shared), strict=True))
    middle, spread = corners.mean(axis=0), corners.std()
    centred = np.column_stack([(points - points.mean(axis=0)) / points.std(), np.ones(len(points))])
    rows = [np.column_stack([centred * (axis == 0), centred * (axis == 1), -seen[:, None] * centred])
            for axis, seen in enumerate(((corners - middle) / spread).T)]
    projection = np.linalg.svd(np.concatenate(rows), full_matrices=False)[2][-1].reshape(3, 4)
    matrix = cv2.decomposeProjectionMatrix(projection)[0]
    matrix = matrix / matrix[2, 2] * np.where(np.diag(matrix) * matrix[2, 2] < 0, -1, 1)  # which axes of the device are turned over
    return np.asarray([[spread, 0, middle[0]], [0, spread, middle[1]], [0, 0, 1]] @ matrix)


def moved(points: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return points [points, 3] moved by a pose [6]."""
    return np.asarray(points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])
