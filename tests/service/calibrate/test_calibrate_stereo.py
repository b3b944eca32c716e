"""relit calibrate stereo: from images of a board to a manifest whose cameras measure depth."""

import json

import numpy as np
import pytest

from service.depth.stereo.rectification import rectify
from stage.capture.capture import Capture
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest, write_image, write_manifest
from tests.scenes.depth import entry_of
from tests.service.calibrate.solvers import test_procam as boards

CAMERA = boards.CAMERA
OTHER = reference.Device(420, 300, 520.0, (-0.08, 0.02, 0.0), (-0.0005, 0.001))
POSE = reference.look_at((0.14, 0.01, 0.005), (0.0, 0.0, -0.9))
UNKNOWN = {"name": "right", "resolution": [OTHER.width, OTHER.height]}


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    return write_board(tmp_path_factory.mktemp("board"), 7)


def write_board(folder, poses):
    """A capture with some poses of the board, of cameras that nobody has calibrated."""
    frames = []
    for number, pose in enumerate(boards.poses(poses)):
        images = boards.board_image(pose), boards.board_image(np.linalg.inv(POSE) @ pose, OTHER)
        for name, image in zip(("left", "right"), images, strict=True):
            write_image(folder / f"{name}_{number}.png", np.rint(65535 * image).astype(np.uint16))
        frames.append({"image": f"left_{number}.png", "stereo": {"images": [f"right_{number}.png"]}})
    write_manifest(folder, {"schema": "relit.capture/1", "name": "board", "frames": frames, "other_cameras": [UNKNOWN],
                            "camera": {"projection": "orthographic", "resolution": [CAMERA.width, CAMERA.height]}})
    return folder


def scene(folder, **changes):
    blank = np.full((CAMERA.height, CAMERA.width), 900, np.uint16)
    write_image(folder / "left.png", blank)
    write_image(folder / "right.png", np.full((OTHER.height, OTHER.width), 900, np.uint16))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "scene", "camera": {"projection": "perspective", **entry_of(CAMERA)},
                            "other_cameras": [UNKNOWN], "frames": [{"image": "left.png", "stereo": {"images": ["right.png"]}}], **changes})
    return folder


@pytest.mark.long
def test_a_board_calibrates_both_cameras(relit, board, tmp_path):
    further = scene(tmp_path)
    outcome = relit("depth", further, "--out", tmp_path / "out")
    assert outcome.code == 2 and "right has no focal_px and no camera_from_other" in outcome.err and "calibrate stereo" in outcome.err
    outcome = relit.done("calibrate", "stereo", board, "--board", "9x6", "--square-m", 0.03, "--apply-to", further)
    assert "px RMS, baseline 0.14" in outcome.out
    for folder in (board, further):
        manifest = Capture.open(folder).manifest
        other, = manifest.other_cameras
        assert np.abs(np.array(manifest.camera.focal_px) / CAMERA.focal - 1).max() < 0.01
        assert np.abs(np.array(other.focal_px) / OTHER.focal - 1).max() < 0.01
        assert np.linalg.norm(np.array(other.camera_from_other)[:3, 3] - POSE[:3, 3]) < 0.004
        # what counts for matching: rows of the rectified images agree for true points in the middle of the field
        geometry = rectify(manifest.camera, other, where="")
        points = np.concatenate([boards.corners_of(pose) for pose in boards.poses(7)])
        rows = []
        for device, pose, camera, turn, top in ((CAMERA, np.eye(4), manifest.camera, geometry.rectified_from_reference, geometry.left.top),
                                                (OTHER, POSE, other.camera, geometry.rectified_from_other, geometry.right.top)):
            x, y = camera.plane_at(*np.moveaxis(reference.seen_by(device, pose, points), -1, 0))
            towards = np.stack([x, y, -np.ones_like(x)], axis=-1) @ turn.T
            rows.append(towards[:, 1] / towards[:, 2] * geometry.focal_px - top)
        assert np.abs(rows[0] - rows[1]).max() < 0.5 and np.median(np.abs(rows[0] - rows[1])) < 0.12  # corners are good to 0.1 px
    report = json.loads((board / "calibration.json").read_text())["stereo"]
    assert len(report["other_cameras"][0]["views"]) == 7 and report["other_cameras"][0]["rms_px"] < 0.4


def test_what_is_wrong_is_said(relit, tmp_path):
    board = write_board(tmp_path / "board", 2)
    given = "--board", "9x6", "--square-m", 0.03
    far = scene(tmp_path / "far")
    edit_manifest(far, other_cameras=[{**UNKNOWN, "name": "top"}])
    before = (board / "capture.json").read_text()
    for folder, arguments, says in (
            (board, (*given, "--apply-to", far), "other_cameras: differ in name or resolution"),
            (board, ("--board", "12x9", "--square-m", 0.03), "the camera: 0 of the views show the board"),
            (scene(tmp_path / "bare", other_cameras=None, frames=[{"image": "left.png", "light": {"type": "full"}}]), given,
             "frames: none has stereo images")):
        if folder.name == "bare":
            data = json.loads((folder / "capture.json").read_text())
            write_manifest(folder, {key: value for key, value in data.items() if value is not None})
        assert says in relit.refused("calibrate", "stereo", folder, *arguments)
    assert (board / "capture.json").read_text() == before
    half = scene(tmp_path / "half", other_cameras=[{**UNKNOWN, "focal_px": [500, 500]}])
    assert "camera_from_other is missing beside focal_px" in relit.refused("depth", half, "--out", tmp_path / "out")
