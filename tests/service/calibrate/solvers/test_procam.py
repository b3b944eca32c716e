"""Projector-camera calibration from exact corners, and corners from exact correspondences."""

from functools import cache

import numpy as np
import pytest

from service.calibrate.solvers.procam import BoardView, board_points, calibrate, find_corners, outliers, projector_corners
from service.calibrate.stereo import SharedView, alike_order, calibrate_lens, calibrate_pose
from stage.errors import CalibrationError
from tests.reference import projector as reference

CAMERA = reference.Device(400, 300, 500.0, (-0.15, 0.05, 0.0), (0.001, -0.0015))
PROJECTOR = reference.Device(800, 600, 1100.0, (-0.08, 0.02, 0.0), (-0.0005, 0.001))
POSE = reference.look_at((0.25, 0.06, 0.03), (0.0, 0.0, -0.9))
BOARD, SQUARE = (9, 6), 0.03


def poses(count):
    """[count] of [4, 4] camera_from_board: turned about both axes, before the camera."""
    rng = np.random.default_rng(11)
    for _ in range(count):
        a, b = rng.uniform(-0.5, 0.5, 2)
        turn_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
        turn_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
        matrix = np.eye(4)
        matrix[:3, :3] = turn_y @ turn_x
        matrix[:3, 3] = [rng.uniform(-0.05, 0.05), rng.uniform(-0.04, 0.04), rng.uniform(-1.0, -0.8)]
        yield matrix


def corners_of(pose):
    """[corners, 3] of the board in the camera frame; its rows go down."""
    own = board_points(BOARD, SQUARE).astype(float) - [SQUARE * (BOARD[0] - 1) / 2, SQUARE * (BOARD[1] - 1) / 2, 0]
    return own * (1, -1, 1) @ pose[:3, :3].T + pose[:3, 3]


def views(count, noise=0.0):
    rng = np.random.default_rng(5)
    for number, pose in enumerate(poses(count)):
        points = corners_of(pose)
        camera = reference.project(CAMERA, points) + rng.normal(0, noise, (len(points), 2))
        lit = reference.seen_by(PROJECTOR, POSE, points) + rng.normal(0, noise, (len(points), 2))
        yield BoardView(f"view {number}", camera, lit, np.arange(len(points)))


def check(found, focal, place, angle):
    assert np.abs(np.array(found.camera.focal) / CAMERA.focal - 1).max() < focal
    assert np.abs(np.array(found.projector.focal) / PROJECTOR.focal - 1).max() < focal
    assert np.abs(found.camera_from_projector[:3, 3] - POSE[:3, 3]).max() < place
    turn = found.camera_from_projector[:3, :3] @ POSE[:3, :3].T
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < angle


def test_exact_corners_give_both_devices_back():
    found = calibrate(list(views(8)), BOARD, SQUARE, (400, 300), (800, 600))
    check(found, 2e-4, 2e-4, 0.02)  # OpenCV takes corners in float32
    assert np.abs(np.array(found.camera.principal) - CAMERA.principal).max() < 0.1
    assert np.abs(np.array(found.projector.principal) - PROJECTOR.principal).max() < 0.2
    assert np.abs(np.array(found.camera.distortion.k) - CAMERA.k).max() < 3e-3
    assert np.abs(np.array(found.projector.distortion.p) - PROJECTOR.p).max() < 1e-3
    assert found.rms_px < 1e-3 and not outliers(found).any()


def test_noisy_corners_and_an_outlier_that_is_named():
    given = list(views(10, noise=0.15))
    check(calibrate(given, BOARD, SQUARE, (400, 300), (800, 600)), 0.01, 0.01, 1.0)
    given[3] = given[3]._replace(projector=given[3].projector + np.random.default_rng(0).normal(0, 4, (54, 2)))
    found = calibrate(given, BOARD, SQUARE, (400, 300), (800, 600))
    assert list(np.flatnonzero(outliers(found))) == [3]


def test_views_with_some_corners_only():
    given = [view._replace(camera=view.camera[:40], projector=view.projector[:40], kept=view.kept[:40]) for view in views(6)]
    check(calibrate(given, BOARD, SQUARE, (400, 300), (800, 600)), 1e-3, 1e-3, 0.1)


def test_too_few_views_are_refused():
    with pytest.raises(CalibrationError, match="2 of the views can be used"):
        calibrate(list(views(2)), BOARD, SQUARE, (400, 300), (800, 600))


@cache
def fine_rays(device, oversample):
    """Rays of the parts of each pixel: the same for every pose, and a second's work where the lens is distorted."""
    return reference.rays(device, np.stack(np.meshgrid((np.arange(device.width * oversample) + 0.5) / oversample,
                                                       (np.arange(device.height * oversample) + 0.5) / oversample), axis=-1))


def board_image(pose, device=CAMERA, oversample=3):
    """Radiance of the board, and the projector's coordinates at each pixel centre."""
    rays = fine_rays(device, oversample)
    normal = pose[:3, 2]
    own = (rays * (pose[:3, 3] @ normal / (rays @ normal))[..., None] - pose[:3, 3]) @ pose[:3, :3]
    across, down = own[..., 0] / SQUARE + (BOARD[0] + 1) / 2, -own[..., 1] / SQUARE + (BOARD[1] + 1) / 2
    inside = (across > -1) & (across < BOARD[0] + 2) & (down > -1) & (down < BOARD[1] + 2)
    squares = (across > 0) & (across < BOARD[0] + 1) & (down > 0) & (down < BOARD[1] + 1)
    black = squares & ((np.floor(across) + np.floor(down)) % 2 == 0)
    radiance = np.where(inside, np.where(black, 0.08, 0.8), 0.02)
    return radiance.reshape(device.height, oversample, device.width, oversample).mean(axis=(1, 3))


@pytest.mark.long
def test_corners_are_found_below_a_pixel():
    pose = next(poses(1))
    found = find_corners(board_image(pose).astype(np.float32), BOARD)
    truth = reference.project(CAMERA, corners_of(pose))
    order = [np.argmin(np.linalg.norm(truth - corner, axis=1)) for corner in found]
    assert sorted(order) == list(range(54))
    assert np.linalg.norm(found - truth[order], axis=1).max() < 0.35  # no blur: edges are sampled
    assert find_corners(np.full((100, 100), 0.5, np.float32), BOARD) is None


def test_projector_corners_from_quantised_coordinates():
    pose = next(poses(1))
    corners = reference.project(CAMERA, corners_of(pose))
    rays = reference.pixel_rays(CAMERA)
    normal = pose[:3, 2]
    points = rays * (pose[:3, 3] @ normal / (rays @ normal))[..., None]
    uv = np.floor(reference.seen_by(PROJECTOR, POSE, points)) + 0.5  # a Gray code's stripe centres
    decoded = np.random.default_rng(0).random(uv.shape[:2]) < 0.6
    uv[np.random.default_rng(1).random(uv.shape[:2]) < 0.02] += 64  # wrong bits
    found = projector_corners(corners, uv[..., 0], uv[..., 1], decoded, BOARD)
    off = np.linalg.norm(found - reference.seen_by(PROJECTOR, POSE, corners_of(pose)), axis=1)
    assert np.median(off) < 0.05 and off.max() < 0.15
    assert np.isnan(projector_corners(corners, uv[..., 0], uv[..., 1], np.zeros_like(decoded), BOARD)).all()


def shared(count, noise=0.0):
    rng = np.random.default_rng(3)
    for number, pose in enumerate(poses(count)):
        points = corners_of(pose)
        seen = reference.project(CAMERA, points), reference.seen_by(PROJECTOR, POSE, points)
        yield SharedView(str(number), *(corners + rng.normal(0, noise, corners.shape) for corners in seen))


def test_exact_corners_give_both_cameras_back():
    views = list(shared(8))
    first = calibrate_lens([view.first for view in views], BOARD, SQUARE, (400, 300), "the camera")
    other = calibrate_lens([view.other for view in views], BOARD, SQUARE, (800, 600), "right")
    for lens, device in ((first, CAMERA), (other, PROJECTOR)):
        assert np.abs(np.array(lens.focal) / device.focal - 1).max() < 2e-4  # OpenCV takes corners in float32
        assert np.abs(np.array(lens.principal) - device.principal).max() < 0.2
    found = calibrate_pose(views, BOARD, SQUARE, first, other, (400, 300), "right")
    assert np.abs(found.camera_from_other[:3, 3] - POSE[:3, 3]).max() < 5e-4
    turn = found.camera_from_other[:3, :3] @ POSE[:3, :3].T
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 0.05
    assert found.rms_px < 5e-3 and found.first_error_px.max() < 5e-3


def test_corners_that_begin_at_the_other_end_are_turned():
    view = next(shared(1))
    assert np.array_equal(alike_order(view.first, view.other[::-1]), view.other)
    assert np.array_equal(alike_order(view.first, view.other), view.other)


def test_too_few_views_of_a_pair_are_refused():
    views = list(shared(4))
    with pytest.raises(CalibrationError, match="right: 2 of the views show the board"):
        calibrate_lens([view.other for view in views[:2]], BOARD, SQUARE, (800, 600), "right")
    lens = calibrate_lens([view.first for view in views], BOARD, SQUARE, (400, 300), "the camera")
    with pytest.raises(CalibrationError, match="right: 1 of the views show the board to it and to the first"):
        calibrate_pose(views[:1], BOARD, SQUARE, lens, lens, (400, 300), "right")
