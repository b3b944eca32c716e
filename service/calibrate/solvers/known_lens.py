"""What boards say of a camera that is calibrated: another focal length, a radial distortion beside its own, and that the board is bent.

All three look alike in one pose; in several the lens stays with the camera and the bend with the board.

Source: as boards/bundle.py, whose board has the same form.

Convention: as boards/bundle.py; corners are those of a camera without distortion whose focal length is UNIT_PX.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from service.calibrate.solvers.boards.bundle import BEND, BENT, MOST_STEPS, POSE, UP, second_order
from service.calibrate.solvers.procam import board_points
from stage.capture.camera import Camera

UNIT_PX = 1000.0
"""Focal length of the camera without distortion in whose image corners are compared; any will do."""
LEAST_BOARDS = 3
"""Boards from which a focal length follows."""
LENS = 2
"""Parameters of the lens: its focal length as a part of UNIT_PX, and k1."""


class BoardLens(NamedTuple):
    """The lens by which boards fit best."""

    focal: float
    """Focal length over that of the camera."""
    focal_sigma: float
    bent_focal: float
    """The same where k1 is free too."""
    bent_focal_sigma: float
    k1: float
    """Radial distortion beside that of the camera."""
    k1_sigma: float
    k1_px: float
    """What k1 moves the outermost corner by, pixels."""
    bend: np.ndarray  # [BEND] metres, heights of x², xy and y² at the outermost corners; 0 where the board is flat to what noise leaves

    def bend_m(self, board: tuple[int, int]) -> float:
        """Return the height of the highest corner of a board above its lowest, metres."""
        every = board_points(board, 1.0)[:, :2].astype(float)
        return float(np.ptp(second_order(every, np.zeros(2), every[-1]) @ self.bend))


class _View(NamedTuple):
    board: np.ndarray  # [corners, 3] metres
    form: np.ndarray  # [corners, BEND] height on a board of a bend of 1
    seen: np.ndarray  # [corners, 2]


def lens_by_boards(corners: Sequence[np.ndarray], board: tuple[int, int], square_m: float, camera: Camera) -> BoardLens | None:
    """Return the lens of a camera by which boards fit best; what is not measured stays. None from fewer than three boards, or where they do
    not tell. `corners`, `board`: as of `board_surface`, of each board."""
    if len(corners) < LEAST_BOARDS:
        return None
    every = board_points(board, square_m).astype(float)
    form = second_order(every[:, :2], np.zeros(2), every[-1, :2])
    views = []
    for own in corners:
        known = np.isfinite(own).all(axis=-1)
        x, y = camera.plane_at(*own[known].T)
        views.append(_View(every[known], form[known], UNIT_PX * np.stack([x, -y], axis=1)))
    whole = _fit(views, [True] * (LENS + BEND))
    if whole is None:
        return None
    bent = bool((np.abs(whole[0][LENS:]) > BENT * whole[1][LENS:]).any())
    focal, both = (_fit(views, [True, free, *[bent] * BEND]) for free in (False, True))
    if focal is None or both is None or min(focal[0][0], both[0][0]) <= 0:
        return None
    farthest = max(float(np.hypot(*view.seen.T).max()) for view in views) / UNIT_PX
    assert camera.focal_px is not None
    return BoardLens(focal[0][0], focal[1][0], both[0][0], both[1][0], both[0][1], both[1][1],
                     abs(both[0][1]) * farthest**3 * max(camera.focal_px), both[0][LENS:])


def _fit(views: Sequence[_View], free: Sequence[bool]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return lens and bend, [LENS + BEND], and their standard errors by what the corners miss; None where they are open. `free`: which of
    them are fitted."""
    shared = np.r_[1.0, np.zeros(1 + BEND)]
    chosen = np.r_[np.flatnonzero(free), np.arange(len(shared), len(shared) + POSE * len(views))]

    def shown(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much all corners are off, and the slopes by what is fitted."""
        whole = np.concatenate([shared, np.zeros(POSE * len(views))])
        whole[chosen] = values
        matrix, distortion = np.diag([UNIT_PX * whole[0], UNIT_PX * whole[0], 1.0]), np.array([whole[1], 0.0, 0.0, 0.0])
        offs, rows = [], []
        for number, view in enumerate(views):
            own = slice(len(shared) + POSE * number, len(shared) + POSE * (number + 1))
            pose = whole[own]
            seen, by = cv2.projectPoints(view.board + np.outer(view.form @ whole[LENS:len(shared)], UP), pose[:3], pose[3:], matrix,
                                         distortion)
            row = np.zeros((2 * len(view.board), len(whole)))
            row[:, 0] = UNIT_PX * by[:, POSE:POSE + 2].sum(axis=1)
            row[:, 1] = by[:, POSE + 4]
            row[:, LENS:len(shared)] = (by[:, 3:POSE] @ cv2.Rodrigues(pose[:3])[0] @ UP)[:, None] * np.repeat(view.form, 2, axis=0)
            row[:, own] = by[:, :POSE]
            offs.append((seen.reshape(-1, 2) - view.seen).ravel())
            rows.append(row[:, chosen])
        return np.concatenate(offs), np.concatenate(rows)

    poses = [np.concatenate(cv2.solvePnP(view.board, view.seen / UNIT_PX, np.eye(3), None)[1:]).ravel() for view in views]
    start = np.concatenate([shared[np.flatnonzero(free)], *poses])
    found = least_squares(lambda values: shown(values)[0], start, jac=lambda values: shown(values)[1], x_scale="jac", method="lm",
                          max_nfev=MOST_STEPS).x
    off, slopes = shown(found)
    unit = 1 / np.maximum(np.linalg.norm(slopes, axis=0), 1e-300)
    try:
        inverse = np.linalg.inv((slopes * unit).T @ (slopes * unit))
    except np.linalg.LinAlgError:
        return None
    count = len(chosen) - POSE * len(views)
    variance = float(off @ off) / max(len(off) - len(found), 1)
    sigma = np.sqrt(np.maximum(np.diag(inverse), 0) * variance) * unit
    if not (np.isfinite(found).all() and np.isfinite(sigma).all()):
        return None
    values, errors = shared.copy(), np.zeros(len(shared))
    values[chosen[:count]], errors[chosen[:count]] = found[:count], sigma[:count]
    return values, errors
