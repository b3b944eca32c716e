"""Calibration of two cameras from exact corners."""

import numpy as np
import pytest

from service.calibrate.solvers.stereo import SharedView, alike_order, calibrate_lens, calibrate_pose
from stage.errors import CalibrationError
from tests.reference import projector as reference
from tests.service.calibrate.solvers.test_procam import BOARD, CAMERA, POSE, PROJECTOR, SQUARE, corners_of, poses


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


def test_too_few_views_are_refused():
    views = list(shared(4))
    with pytest.raises(CalibrationError, match="right: 2 of the views show the board"):
        calibrate_lens([view.other for view in views[:2]], BOARD, SQUARE, (800, 600), "right")
    lens = calibrate_lens([view.first for view in views], BOARD, SQUARE, (400, 300), "the camera")
    with pytest.raises(CalibrationError, match="right: 1 of the views show the board to it and to the first"):
        calibrate_pose(views[:1], BOARD, SQUARE, lens, lens, (400, 300), "right")
