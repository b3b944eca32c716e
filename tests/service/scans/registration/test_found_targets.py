"""Coded markers and chessboards in images of range images: where they are, how sure, and a wall that only they place."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from service.calibrate.solvers.charuco import DICTIONARIES
from service.scans.points.rigid import applied, inverse, step_between
from service.scans.points.scan import Scan, Target
from service.scans.registration.found_targets import board_in, markers_in, placed
from service.scans.registration.target_pairs import pose_by_targets
from stage.capture.camera import Camera
from tests.scenes.register import scan_with
from tests.scenes.statue import place

SIGMA = 2e-4
SIZE_M, TEXELS = 0.8, 2000
"""Side of a wall with marks, and texels across it."""
BOARD = 7, 6
CAMERA = Camera(projection="perspective", resolution=(640, 480), focal_px=(640.0, 640.0))
POSES = [place(angle, height, 1.2) for angle, height in ((0.0, 0.1), (0.5, 0.3), (-0.6, -0.2))]


def wall(kind: str) -> np.ndarray:
    """A white wall: markers of 10 cm, or a chessboard of 6 cm squares; [TEXELS, TEXELS], the first row on top."""
    texture = np.full((TEXELS, TEXELS), 0.9)
    step = int(0.06 / SIZE_M * TEXELS)
    if kind == "board":
        for row in range(BOARD[1] + 1):
            for col in range(BOARD[0] + 1):
                if (row + col) % 2 == 0:
                    texture[300 + row * step:300 + (row + 1) * step, 300 + col * step:300 + (col + 1) * step] = 0.05
        return texture
    side = int(0.1 / SIZE_M * TEXELS)
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[kind])
    for number, (row, col) in enumerate([(250, 300), (300, 1300), (900, 800), (1400, 350), (1350, 1400)]):
        texture[row:row + side, col:col + side] = np.where(cv2.aruco.generateImageMarker(dictionary, number, side) > 0, 0.9, 0.05)
    return texture


def marks(kind: str) -> dict[str, np.ndarray]:
    """World places of the marks, which are on the plane z = 0."""
    def world(col: float, row: float) -> np.ndarray:
        return np.array([(col / TEXELS - 0.5) * SIZE_M, (0.5 - row / TEXELS) * SIZE_M, 0.0])

    step, side = int(0.06 / SIZE_M * TEXELS), int(0.1 / SIZE_M * TEXELS)
    if kind == "board":
        return {f"board {col},{row}": world(300 + (col + 1) * step, 300 + (row + 1) * step)
                for row in range(BOARD[1]) for col in range(BOARD[0])}
    return {f"marker {number} corner {k}": world(col + side * across, row + side * down)
            for number, (row, col) in enumerate([(250, 300), (300, 1300), (900, 800), (1400, 350), (1350, 1400)])
            for k, (across, down) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)])}


def look(kind: str, pose: np.ndarray, *, seed: int, upside_down: bool = False) -> tuple[np.ndarray, Scan]:
    """The image of the wall, averaged over 3 x 3 rays a pixel, and its range image, without depths where it is dark."""
    if upside_down:  # the camera is turned about its axis
        pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0])
    rng, texture = np.random.default_rng(seed), wall(kind)
    cols, rows = CAMERA.resolution
    total = np.zeros((rows, cols))
    for du in (1 / 6, 1 / 2, 5 / 6):
        for dv in (1 / 6, 1 / 2, 5 / 6):
            u, v = np.meshgrid(np.arange(cols) + du, np.arange(rows) + dv)
            point, _ = met(pose, u, v)
            col, row = (point[..., 0] / SIZE_M + 0.5) * TEXELS, (0.5 - point[..., 1] / SIZE_M) * TEXELS
            inside = (col >= 0) & (row >= 0) & (col < TEXELS) & (row < TEXELS)
            total += np.where(inside, texture[np.where(inside, row, 0).astype(int), np.where(inside, col, 0).astype(int)], 0) / 9
    image = np.maximum(total + 0.005 * rng.standard_normal(total.shape), 0)
    u, v = np.meshgrid(np.arange(cols) + 0.5, np.arange(rows) + 0.5)
    depth = met(pose, u, v)[1] + SIGMA * rng.standard_normal((rows, cols))
    pixels = np.flatnonzero(total > 0.3)
    points = CAMERA.points(-depth).reshape(-1, 3)[pixels]
    stretch = np.linalg.norm(points, axis=1) / -points[:, 2]
    return image.astype(np.float32), scan_with(points, SIGMA * stretch, camera=CAMERA, pixels=pixels)


def met(pose: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where lines of sight meet the wall, world, and the z-depth there."""
    x, y = CAMERA.plane_at(u, v)
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1) @ pose[:3, :3].T
    z = -pose[2, 3] / ray[..., 2]
    return pose[:3, 3] + z[..., None] * ray, z


def found_in(kind: str, image: np.ndarray, scan: Scan) -> tuple[Target, ...]:
    return placed(board_in(image, BOARD) if kind == "board" else markers_in(image, kind), scan)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["board", "aruco4", "apriltag36h11"])
def test_marks_place_scans_of_a_flat_wall(kind):
    """The wall has no shape: its marks alone give the poses, as wrong as they say."""
    truth, shown = marks(kind), []
    for seed, pose in enumerate(POSES):
        targets = found_in(kind, *look(kind, pose, seed=seed, upside_down=seed == 2))
        pose = pose @ np.diag([-1.0, -1.0, 1.0, 1.0]) if seed == 2 else pose
        assert {target.name for target in targets} == set(truth)
        squares = []
        for target in targets:
            off = target.position - applied(inverse(pose), truth[target.name][None])[0]
            assert np.linalg.norm(off) < 2e-3  # half a pixel is 1 mm across
            squares.append(off @ np.linalg.solve(target.covariance, off))
        assert np.mean(squares) < 9  # three numbers a mark; corners of markers keep a bias of the image's sampling
        shown.append((pose, targets))
    (one, first), (other, second) = shown[0], shown[2]
    found = pose_by_targets(first, second, first_row=(0, 0))
    assert found.fit is not None
    step = step_between(found.fit.pose @ inverse(inverse(one) @ other), found.fit.pivot)
    assert np.linalg.norm(step[3:]) < 3e-4 and np.degrees(np.linalg.norm(step[:3])) < 0.1
    assert step @ found.fit.information @ step < 30  # of χ² with six degrees of freedom, one in 25 000 is larger


def test_marks_without_depths_and_markers_that_are_there_twice_are_left_out():
    image, scan = look("aruco4", POSES[0], seed=1)
    assert len(markers_in(image, "aruco4")) == 20
    assert not markers_in(np.concatenate([image, image], axis=1), "aruco4")
    far = scan.points[:, 0] > 0.05
    part = replace(scan, points=scan.points[far], sigma=scan.sigma[far], pixels=scan.pixels[far])
    assert 0 < len(placed(markers_in(image, "aruco4"), part)) < 20
