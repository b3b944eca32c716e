"""Laser planes from their stripes on a chessboard: the board's surface by its corners, and a plane through the stripes of several poses.

Sources: the pose of a plane from points, Zhang, "A flexible new technique for camera calibration", TPAMI 22(11), 2000, refined by
Levenberg and Marquardt's method in OpenCV; the plane of light from its stripes on boards of known pose, Zhou and Zhang, "Complete
calibration of a structured light stripe vision sensor through planar target of unknown orientations", Image and Vision Computing 23(1),
2005.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.boards.bundle import BEND, UP, second_order
from service.calibrate.solvers.procam import board_points
from stage.capture.camera import Camera
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA
from stage.transforms import OPENCV_FROM_CAMERA

LARGEST_SIGMA_DEGREES = 1.0
"""The largest standard error of the tilt of a plane that is written: at a metre and 45 degrees it is a depth of 2 cm."""
ROUNDS, CAUCHY = 20, 1.5
"""Rounds of re-weighting of a plane, and the scale of its Cauchy weights in standard deviations."""
LEAST_POINTS = 20
APART = 5.0
"""Stripes lie in no common plane if they miss it by so many times what each scatters about its own line; one board is to blame without
which the others miss theirs by so many times less."""
LEAST_OTHERS = 3
"""The fewest boards that agree on a plane, and on that another is to blame: through two stripes that are nearly parallel a plane goes."""
MEETINGS = 4
"""Steps in which lines of sight find a bent board; each leaves of what is open its slope times the tangent of the line."""


class BoardSurface(NamedTuple):
    """The surface of a chessboard in the camera frame, on OpenCV's axes."""

    turn: np.ndarray  # [3, 3] from the frame of the board
    shift: np.ndarray  # [3] metres
    bend: np.ndarray  # [BEND] metres, as of `BoardLens`
    last: np.ndarray  # [2] metres, the last corner of the board in its frame; the first one is 0
    rms_px: float
    """Root mean square distance of the corners from where the pose puts them."""

    def meet(self, camera: Camera, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return where the lines of sight of image coordinates meet the board, [n, 3] metres in the camera frame."""
        x, y = camera.plane_at(u, v)
        rays = np.stack([x, -y, np.ones_like(x)], axis=1) @ self.turn  # in the frame of the board
        origin = -self.shift @ self.turn
        height = np.zeros_like(x)
        for _ in range(MEETINGS):
            points = origin + rays * ((height - origin[2]) / rays[:, 2])[:, None]
            height = second_order(points[:, :2], np.zeros(2), self.last) @ self.bend
        return np.asarray((points @ self.turn.T + self.shift) @ OPENCV_FROM_CAMERA)


class LightPlane(NamedTuple):
    """A plane of light through the stripes on boards."""

    point: np.ndarray  # [3] metres, the middle of the stripes
    normal: np.ndarray  # [3] unit
    residual_m: float
    """Root mean square distance of the points, by the weights of the fit."""
    sigma_m: float
    """Standard error of its place at the point, along the normal."""
    sigma_degrees: float
    """Standard error of the tilt about the direction in which the stripes lie closest together."""
    points: int


def board_surface(corners: np.ndarray, board: tuple[int, int], square_m: float, camera: Camera, bend: np.ndarray | None = None
                  ) -> BoardSurface:
    """Return the surface of a chessboard.
    `corners`: [across × down, 2] image coordinates, row by row, NaN where one is not seen. `board`: its inner corners across and down.
    `camera`: a calibrated perspective one. `bend`: as of `BoardLens`; None: it is flat."""
    every = board_points(board, square_m).astype(float)
    bend, last = np.zeros(BEND) if bend is None else bend, every[-1, :2]
    known = np.isfinite(corners).all(axis=-1)
    corners, points = corners[known], every[known]
    x, y = camera.plane_at(corners[:, 0], corners[:, 1])
    seen = np.stack([x, -y], axis=1)  # lens distortion is undone, OpenCV's y is down
    found, rotation, shift = cv2.solvePnP(points, seen, np.eye(3), None, flags=cv2.SOLVEPNP_ITERATIVE)
    if not found:
        raise CalibrationError("the corners of the board have no pose")
    if bend.any():
        points = points + np.outer(second_order(points[:, :2], np.zeros(2), last) @ bend, UP)
        rotation, shift = cv2.solvePnPRefineLM(points, seen, np.eye(3), None, rotation, shift)
    turn = cv2.Rodrigues(rotation)[0]
    own = points @ turn.T + shift.ravel()
    assert camera.focal_px is not None
    off = (own[:, :2] / own[:, 2:] - seen) * camera.focal_px
    return BoardSurface(turn, shift.ravel(), bend, last, float(np.sqrt((off**2).sum(axis=1).mean())))


def inside_board(corners: np.ndarray, board: tuple[int, int], shape: tuple[int, int]) -> np.ndarray:
    """Return which pixels lie within squares of the board whose four corners are seen, [rows, cols] bool."""
    grid = corners.reshape(board[1], board[0], 2) - 0.5
    squares = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2).reshape(-1, 4, 2)
    filled = np.zeros(shape, np.uint8)
    for square in squares[np.isfinite(squares).all(axis=(1, 2))]:
        cv2.fillConvexPoly(filled, np.rint(square).astype(np.int32), (1,))
    return filled.astype(bool)


def fit_light_plane(poses: list[np.ndarray], names: Sequence[str] = ()) -> LightPlane:
    """Fit a plane to the points of a stripe on several boards, [n, 3] metres on each. `names`: of the boards, for a message.
    Raises CalibrationError if there are too few points, or they lie along one line or in no plane."""
    count = sum(map(len, poses))
    if len(poses) < 2 or count < LEAST_POINTS:
        raise CalibrationError(f"its stripe is seen on {len(poses)} boards, at {count} places: two boards and {LEAST_POINTS} places are "
                               "needed")
    middle, normal, residual, breadth = _plane(poses)
    near = CAUCHY * MAD_TO_SIGMA * float(np.median(np.abs((np.concatenate(poses) - middle) @ normal))) + 1e-9
    agree = sum(float(np.median(np.abs((own - middle) @ normal))) < near for own in poses)
    if agree < min(LEAST_OTHERS, len(poses)):  # two agree on some plane whichever they are: what all miss theirs by counts
        residual = _plane(poses, rounds=1)[2]
    straight = float(np.median([_scatter(own) for own in poses]))
    # a stripe on a board is straight: what it scatters is its noise, also where all points lie in the plane of one board
    noise = max(residual, straight)
    # a board whose pose is off moves all its points: the boards are the independent measurements
    sigma = math.degrees(math.atan2(max(noise, 1e-9), max(breadth, 1e-12))) / math.sqrt(max(len(poses) - 1, 1))
    if sigma > LARGEST_SIGMA_DEGREES:
        if residual > APART * straight:
            raise CalibrationError(f"its stripes miss any common plane by {1000 * residual:.2g} mm, and each is straight to "
                                   f"{1000 * straight:.2g} mm{_to_blame(poses, names)}: check the order of the frames of each "
                                   "pose, and that board and laser stood still while they were taken")
        raise CalibrationError(f"its stripes lie so close to one line that the tilt of its plane is known to {sigma:.1f}° alone: move the "
                               "board towards the camera and away from it")
    return LightPlane(middle, normal, residual, max(noise, 1e-9) / math.sqrt(len(poses)), sigma, count)


def _plane(poses: Sequence[np.ndarray], rounds: int = ROUNDS) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return a point, the normal, the root mean square distance of the points, and that along their second direction, by robust weights;
    by none in a single round."""
    points = np.concatenate(poses)
    # every board counts alike, however much of the stripe it shows
    share = np.concatenate([np.full(len(own), 1 / len(own)) for own in poses])
    weight = share.copy()
    for _ in range(rounds):
        middle = weight @ points / weight.sum()
        values, vectors = np.linalg.eigh((points - middle).T @ ((points - middle) * weight[:, None]) / weight.sum())
        normal = vectors[:, 0]
        off = (points - middle) @ normal
        spread = MAD_TO_SIGMA * float(np.median(np.abs(off))) + 1e-9
        weight = share / (1 + (off / (CAUCHY * spread)) ** 2)
    return middle, normal, math.sqrt(max(float(values[0]), 0.0)), math.sqrt(max(float(values[1]), 0.0))


def _to_blame(poses: Sequence[np.ndarray], names: Sequence[str]) -> str:
    """Return words that name the board without which the stripes of the others lie in one plane; nothing where there is none."""
    if len(poses) <= LEAST_OTHERS or len(names) != len(poses):
        return ""
    left = [_plane([*poses[:one], *poses[one + 1 :]], rounds=1)[2] for one in range(len(poses))]
    first, second = np.argsort(left)[:2]
    return f"; without that of {names[first]} the others lie in one plane" if APART * left[first] < left[second] else ""


def _scatter(points: np.ndarray) -> float:
    """Return the robust standard deviation of points about their line, metres, or about the parabola that it is on a board that is bent."""
    off = points - np.median(points, axis=0)
    along = off @ np.linalg.svd(off, full_matrices=False)[2][0]
    way = np.vander(along / max(float(np.abs(along).max()), 1e-12), 3)
    weight = np.ones((len(points), 1))
    for _ in range(ROUNDS):
        across = off - way @ np.linalg.lstsq(weight * way, weight * off)[0]
        far = np.linalg.norm(across, axis=1, keepdims=True)
        weight = 1 / np.hypot(1, far / (CAUCHY * MAD_TO_SIGMA * np.median(far) + 1e-9))
    widest = np.linalg.svd(weight * across, full_matrices=False)[2][0]
    return MAD_TO_SIGMA * float(np.median(np.abs(across @ widest)))
