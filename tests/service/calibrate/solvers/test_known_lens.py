"""A calibrated camera and a board that is bent, by the corners of several poses: which of the two is to blame, and where sights meet it.
The projection is the float64 twin's, the bends are closed forms."""

import numpy as np
import pytest

from service.calibrate.solvers.known_lens import lens_by_boards
from service.calibrate.solvers.laser_plane import board_surface
from stage.capture.camera import Camera, Distortion
from tests.reference import projector as reference
from tests.service.calibrate.solvers.test_procam import BOARD, CAMERA, SQUARE, poses

HALF = np.array([BOARD[0] - 1, BOARD[1] - 1]) * SQUARE / 2
NOISE_PX = 0.08
FORMS = {"flat": lambda x, y: 0 * x, "across": lambda x, y: x * x, "down": lambda x, y: y * y, "twisted": lambda x, y: x * y / 2,
         "bowl": lambda x, y: (x * x + y * y) / 2}


def camera(focal=1.0):
    return Camera(projection="perspective", resolution=(CAMERA.width, CAMERA.height), focal_px=(focal * CAMERA.focal,) * 2,
                  principal_px=tuple(CAMERA.principal), distortion=Distortion(model="brown_conrady", k=CAMERA.k, p=CAMERA.p))


def on_board(pose, places, form, height):
    """[n, 3] points in the camera frame of places [n, 2] on a board, from -1 to 1 between its outermost corners, y down."""
    own = np.column_stack([places * HALF * (1, -1), height * FORMS[form](*places.T)])
    return own @ pose[:3, :3].T + pose[:3, 3]


def seen(form, height, count=6, seed=3, noise=NOISE_PX):
    """[corners, 2] of each pose."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*(np.linspace(-1, 1, number) for number in BOARD)), axis=-1).reshape(-1, 2)
    return [reference.project(CAMERA, on_board(pose, grid, form, height)) + random.normal(0, noise, (len(grid), 2))
            for pose in poses(count)]


@pytest.mark.parametrize("height", [0.001, 0.003])
@pytest.mark.parametrize("form", list(FORMS)[1:])
def test_a_bent_board_accuses_no_camera(form, height):
    """Bends of 1 to 3 mm were told as a focal length that is 2 to 7 % wrong, and a k1 that is missing."""
    found = lens_by_boards(seen(form, height), BOARD, SQUARE, camera())
    assert abs(found.focal - 1) < 4 * found.focal_sigma < 0.03 and abs(found.k1) < 4 * found.k1_sigma
    # noise of .08 px is .15 mm along the line of sight of a tilted board; 54 corners in six poses leave a tenth of it
    assert abs(found.bend_m(BOARD) - height) < 2e-4


@pytest.mark.long
def test_flat_boards_have_no_bend():
    for seed in range(12):
        found = lens_by_boards(seen("flat", 0.0, seed=seed), BOARD, SQUARE, camera())
        assert found.bend_m(BOARD) == 0 and abs(found.focal - 1) < 4 * found.focal_sigma


def test_a_wrong_focal_length_is_no_bend():
    found = lens_by_boards(seen("flat", 0.0), BOARD, SQUARE, camera(1.05))
    assert found.focal == pytest.approx(1 / 1.05, abs=4 * found.focal_sigma) and found.bend_m(BOARD) < 3e-4
    assert lens_by_boards(seen("flat", 0.0, count=2), BOARD, SQUARE, camera()) is None


@pytest.mark.parametrize("form", ["across", "twisted"])
def test_lines_of_sight_meet_the_bent_board(form):
    """Exact corners: what is left is rounding."""
    corners = seen(form, 0.003, noise=0.0)
    bend = lens_by_boards(corners, BOARD, SQUARE, camera()).bend
    places = np.random.default_rng(1).uniform(-1, 1, (40, 2))
    for pose, own in zip(poses(6), corners, strict=True):
        points = on_board(pose, places, form, 0.003)
        surface = board_surface(own, BOARD, SQUARE, camera(), bend)
        assert surface.rms_px < 1e-4
        assert np.abs(surface.meet(camera(), *reference.project(CAMERA, points).T) - points).max() < 1e-6
