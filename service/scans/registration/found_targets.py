"""Targets that are found in a photograph by the camera of a scan: coded markers and the corners of a chessboard, placed by the depth.

A target lies where the line of sight through its image point meets the plane of the measured points around it: printed targets are flat,
and their black parts often have no depth.

Source: Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion", Pattern Recognition
    47(6), 2014 (markers, as OpenCV finds them).
"""

from typing import NamedTuple

import cv2
import numpy as np

from service.calibrate.solvers.charuco import marker_detector
from service.calibrate.solvers.procam import eight_bits, find_corners
from service.scans.points.scan import Scan, Target
from stage.spread import MAD_TO_SIGMA

SADDLE_PX, CORNER_PX = 0.1, 0.2
"""Standard deviations of the image points of chessboard corners, and of the corners of markers, which are no saddle points."""
MOST_AVERAGED = 25.0
"""Depths that count as independent at the most: neighbouring ones often have errors in common."""
LEAST_DEPTHS = 12
"""The fewest depths that a plane is fitted to."""
OUTLIER = 4.0
"""Depths beyond this many standard deviations of the others do not belong to the plane."""
LEAST_FLAT = 0.5
"""The part of the depths that must lie in the plane."""


class ImagePoint(NamedTuple):
    """A target in an image, and the flat piece of surface that it is on."""

    name: str
    u: float
    v: float
    outline: np.ndarray  # [k, 2] image coordinates around the piece
    sigma_px: float


def markers_in(image: np.ndarray, dictionary: str) -> list[ImagePoint]:
    """Return the four corners of every coded marker in a linear image, named `marker 7 corner 2`; NaN counts as black.

    A marker that is there twice is left out: nothing says which is which.
    """
    found, numbers, _ = marker_detector(dictionary).detectMarkers(eight_bits(np.nan_to_num(image)))
    if numbers is None:
        return []
    every = [int(number) for number in np.ravel(numbers)]
    points = []
    for number, corners in zip(every, found, strict=True):
        if every.count(number) > 1:
            continue
        outline = np.asarray(corners, dtype=np.float64).reshape(4, 2) + 0.5
        points += [ImagePoint(f"marker {number} corner {k}", float(u), float(v), outline, CORNER_PX) for k, (u, v) in enumerate(outline)]
    return points


def board_in(image: np.ndarray, board: tuple[int, int]) -> list[ImagePoint]:
    """Return the inner corners of a chessboard in a linear image, named `board 3,1` by column and row; none where it is not whole.

    Of the counts of inner corners across and down one is odd and one even: so the colours of the squares say which end is which. The first
    corner has a dark square towards the second row and column. NaN counts as black.
    """
    corners = find_corners(np.nan_to_num(image), board)
    if corners is None:
        return []
    grid = corners.reshape(board[1], board[0], 2)
    across, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if across[0] * down[1] - across[1] * down[0] < 0:  # as seen in a mirror
        grid = grid[:, ::-1]
    if _mean_within(image, grid[:2, :2]) > _mean_within(image, grid[:2, 1:3]):
        grid = grid[::-1, ::-1]
    points = []
    for row in range(board[1]):
        for col in range(board[0]):
            near = grid[max(row - 1, 0):row + 2, max(col - 1, 0):col + 2]
            outline = np.array([near[0, 0], near[0, -1], near[-1, -1], near[-1, 0]])
            u, v = grid[row, col]
            points.append(ImagePoint(f"board {col},{row}", float(u), float(v), outline, SADDLE_PX))
    return points


def placed(points: list[ImagePoint], scan: Scan) -> tuple[Target, ...]:
    """Return the targets at points of an image by the camera of a range image; those without enough depths around them are left out.

    Convention:
        The depth of a target is the mean of at most MOST_AVERAGED independent depths.
    """
    camera = scan.camera
    assert camera is not None
    depth, sigma = scan.image(-scan.points[:, 2].astype(np.float64)), scan.image(scan.sigma.astype(np.float64))
    there = scan.image(np.ones(len(scan.points), dtype=bool))
    near = camera.projection == "perspective"
    found = []
    for point in points:
        inside = np.zeros(there.shape, dtype=np.uint8)
        cv2.fillConvexPoly(inside, np.rint(point.outline - 0.5).astype(np.int32), 1)
        rows, cols = np.nonzero((inside > 0) & there)
        if len(rows) < LEAST_DEPTHS:
            continue
        x, y = camera.plane_at(np.append(cols + 0.5, point.u), np.append(rows + 0.5, point.v))
        z = depth[rows, cols]
        direction = np.stack([x, y, np.full(len(x), -1.0)], axis=1) if near else np.tile([0.0, 0.0, -1.0], (len(x), 1))
        length = np.linalg.norm(direction, axis=1)
        noise = sigma[rows, cols] / length[:-1]  # of the z-depth
        value, spread = (1 / z, noise / z**2) if near else (z, noise)  # linear on a plane
        matrix = np.stack([x - x[-1], y - y[-1], np.ones(len(x))], axis=1)[:-1]
        plane = _plane(matrix / spread[:, None], value / spread)
        if plane is None:
            continue
        middle, error, ratio = plane
        error = max(error, float(np.median(spread)) * max(ratio, 1.0) / np.sqrt(MOST_AVERAGED))
        z_there, z_error = (1 / middle, error / middle**2) if near else (middle, error)
        pixel = z_there / min(camera.focal_px) if near and camera.focal_px is not None else float(camera.pixel_size_m or 1.0)
        along = direction[-1] / length[-1]
        place = np.array([x[-1] * z_there, y[-1] * z_there, -z_there]) if near else np.array([x[-1], y[-1], -z_there])
        across = (point.sigma_px * pixel) ** 2
        found.append(Target(point.name, place, across * np.eye(3) + (z_error * length[-1]) ** 2 * np.outer(along, along)))
    return tuple(found)


def _plane(matrix: np.ndarray, value: np.ndarray) -> tuple[float, float, float] | None:
    """Return the value of a plane at the target, its standard error, and what is left in standard deviations; None if it is no plane."""
    used = np.ones(len(value), dtype=bool)
    for _ in range(4):
        if used.sum() < LEAST_DEPTHS or np.linalg.matrix_rank(matrix[used]) < 3:
            return None
        solution = np.linalg.lstsq(matrix[used], value[used], rcond=None)[0]
        off = np.abs(value - matrix @ solution)
        scale = max(1.0, MAD_TO_SIGMA * float(np.median(off[used])))
        used = off < OUTLIER * scale
    if used.mean() < LEAST_FLAT or used.sum() < LEAST_DEPTHS:
        return None
    spread = np.linalg.pinv(matrix[used].T @ matrix[used])
    return float(solution[2]), scale * float(np.sqrt(spread[2, 2])), scale


def _mean_within(image: np.ndarray, corners: np.ndarray) -> float:
    """Return the mean of an image in the middle of a square with corners [2, 2, 2]."""
    middle = corners.reshape(4, 2).mean(axis=0)
    inside = np.zeros(image.shape, dtype=np.uint8)
    square = np.array([corners[0, 0], corners[0, 1], corners[1, 1], corners[1, 0]])
    cv2.fillConvexPoly(inside, np.rint(middle + 0.6 * (square - middle) - 0.5).astype(np.int32), 1)
    return float(np.nan_to_num(image)[inside > 0].mean())
