"""Calibration of projector and camera, and of several cameras, from a chessboard."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from service.depth.stereo.rectification import rectify
from stage.capture.capture import Capture
from stage.formats import exr
from stage.formats.images import read_pixels
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest, write_image, write_images, write_manifest
from tests.scenes.depth import BLACK_WHITE, entries_of, entry_of, phase_patterns, shown
from tests.service.calibrate.solvers import test_charuco as charuco
from tests.service.calibrate.solvers import test_procam as boards

pytestmark = pytest.mark.long

CAMERA = boards.CAMERA
PROJECTOR = reference.Device(256, 192, 360.0, (-0.05, 0.01, 0.0), (-0.0005, 0.001))
BITS = 8
REAL = Path(os.environ.get("RELIT_TEST_DATA", "nowhere")) / "graycode_chessboard"
OTHER = reference.Device(420, 300, 520.0, (-0.08, 0.02, 0.0), (-0.0005, 0.001))
POSE = reference.look_at((0.14, 0.01, 0.005), (0.0, 0.0, -0.9))
UNKNOWN = {"name": "right", "resolution": [OTHER.width, OTHER.height]}
BOARD = "--board", "9x6", "--square-m", 0.03
WORDS = *BOARD, "--projector", "256x192"
PLAIN_CAMERA = {"projection": "orthographic", "resolution": [CAMERA.width, CAMERA.height]}

PATTERNS = [*(wave for axis in ("column", "row") for period in (24, 25) for wave in phase_patterns(axis, period, 3)), *BLACK_WHITE]


def write_view(folder, pose, radiance=None, **manifest):
    """One pose of the board under phases of both axes: with Gray codes it would be 34 images."""
    radiance = boards.board_image(pose) if radiance is None else radiance
    rays = reference.pixel_rays(CAMERA)
    points = rays * reference.plane_depth(rays, pose[:3, 3], pose[:3, 2])[..., None]
    uv = reference.seen_by(PROJECTOR, boards.POSE, points)
    reached = ((uv >= 0) & (uv < (PROJECTOR.width, PROJECTOR.height))).all(axis=-1)
    images = [radiance * (0.02 + 0.9 * np.where(reached, shown(pattern, uv), 0)) for pattern in PATTERNS]
    frames = write_images(folder, images, entries_of(PATTERNS), "{}.png")
    write_manifest(folder, {"schema": "relit.capture/1", "name": folder.name, "frames": frames, **manifest, "camera": PLAIN_CAMERA})
    return points


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Five poses of the board, and the true points of the first."""
    folder = tmp_path_factory.mktemp("board")
    points = [write_view(folder / f"pose{number}", pose) for number, pose in enumerate(boards.poses(5))]
    return [folder / f"pose{number}" for number in range(5)], points[0]


@pytest.fixture
def copies(rig, tmp_path):
    """The captures of the rig once more, to be changed."""
    return [shutil.copytree(folder, tmp_path / folder.name) for folder in rig[0]]


def calibrated(relit, folders, *words):
    """The manifest of the first capture after a calibration, and what is reported."""
    relit.done("calibrate", "procam", *folders, *words)
    return Capture.open(folders[0]).manifest, json.loads((folders[0] / "calibration.json").read_text())["procam"]


def focal_off(device, truth):
    """The largest part by which a focal length is off."""
    return np.abs(np.array(device.focal_px) / truth.focal - 1).max()


def test_a_rig_calibrates_itself_and_measures(relit, rig, tmp_path):
    folders, points = rig
    outcome = relit.done("calibrate", "procam", *folders, *WORDS)
    assert "pose4" in outcome.out and "px RMS" in outcome.out
    manifest = Capture.open(folders[2]).manifest
    assert focal_off(manifest.camera, CAMERA) < 0.01 and focal_off(manifest.projector, PROJECTOR) < 0.01
    place = np.array(manifest.projector.camera_from_projector)[:3, 3]
    assert np.linalg.norm(place - boards.POSE[:3, 3]) < 0.005
    report = json.loads((folders[0] / "calibration.json").read_text())["procam"]
    assert manifest.projector.depth_sigma == report["sigma"]["depth"] > 0
    assert len(report["views"]) == 5 and report["rms_px"] < 0.3 and report["left_out"] == []
    maps, *_ = relit.depth(folders[0], "--read-noise", 0.0003)
    corners = np.s_[100:200, 140:260]  # the board is in the middle
    assert maps.mask[corners].mean() > 0.9
    off = np.abs(maps.depth + points[..., 2])[corners][maps.mask[corners]]
    assert np.median(off) < 0.01  # of 0.9 m: five views of corners that are good to 0.1 px


def test_copies_of_a_pose_count_once(relit, copies, tmp_path):
    """Noise that is counted again and again is not averaged: σ was 1.8 times too small with four copies of each pose."""
    again = [shutil.copytree(folder, tmp_path / f"again {folder.name}") for folder in copies[:3]]
    reports = [calibrated(relit, [*copies, *more], *WORDS)[1] for more in ([], again)]
    assert reports[0]["sigma"] == reports[1]["sigma"]
    assert [left["remark"] for left in reports[1]["left_out"]] == [f"left out: a copy of {folder}" for folder in copies[:3]]


def test_views_whose_frames_contradict_their_patterns_are_left_out(relit, copies):
    """Black and white are exchanged in one view, whose light is uneven: readings that are all at full scale say nothing."""
    pose = list(boards.poses(5))[1]
    write_view(copies[1], pose, boards.board_image(pose) * np.linspace(0.6, 1, CAMERA.width))
    frames = json.loads((copies[1] / "capture.json").read_text())["frames"]
    black, white = (frame["image"] for frame in frames[-2:])
    edit_manifest(copies[1], frames=[*frames[:-2], {**frames[-2], "image": white}, {**frames[-1], "image": black}])
    _, report = calibrated(relit, copies, *WORDS)
    (left,) = report["left_out"]
    assert left["view"] == str(copies[1]) and left["remark"].startswith("frames: black is brighter") and len(report["views"]) == 4


def test_a_rig_is_calibrated_with_a_charuco_board_seen_in_part(relit, tmp_path):
    """Each pose has another strip of the board cut off by the image or hidden."""
    sheet = charuco.print_of("aruco4", boards.BOARD, side=0.75)
    folders = []
    for number, pose in enumerate(boards.poses(6)):
        radiance = charuco.drawn((pose[:3, :3], pose[:3, 3]), CAMERA, sheet, boards.BOARD, boards.SQUARE)
        radiance[:, :130] = 0.1 if number % 2 else radiance[:, :130]
        write_view(tmp_path / f"pose{number}", pose, radiance)
        folders.append(tmp_path / f"pose{number}")
    words = *WORDS, "--markers", "aruco4", "--marker-m"
    assert "of a square wide" in relit.refused("calibrate", "procam", *folders, *words, 0.015)
    manifest, report = calibrated(relit, folders, *words, 0.0225)
    assert len(report["views"]) == 6 and min(view["corners"] for view in report["views"]) < 54
    # squares of 17 pixels with markers 2 pixels from each corner: corners are good to 0.25 px, and two thirds of a chessboard's are seen
    assert focal_off(manifest.camera, CAMERA) < 0.025 and focal_off(manifest.projector, PROJECTOR) < 0.025
    assert np.linalg.norm(np.array(manifest.projector.camera_from_projector)[:3, 3] - boards.POSE[:3, 3]) < 0.005


def test_what_is_wrong_is_said(relit, rig, tmp_path):
    folders, _ = rig

    def refused(*arguments):
        return relit.refused("calibrate", "procam", *arguments)

    given = "--square-m", 0.03, "--board"
    assert "2 of the views can be used" in refused(*folders[:2], *given, "9x6", "--projector", "256x192")
    assert "is not found (and so with every view)" in refused(folders[0], *given, "12x9", "--projector", "256x192")
    assert "10x7 inner corners is not found, but one of 9x6 is: --board counts inner corners" in refused(
        folders[0], *given, "10x7", "--projector", "256x192")
    assert "--board 9: give two whole numbers" in refused(folders[0], *given, "9")
    said = refused(folders[0], "--square-m", 75, "--board", "9x6")
    assert said.startswith("relit: --square-m 75: is 75 m, ") and "0.075 for 75 mm" in said and said.count("\n") == 1
    write_view(tmp_path / "one", next(boards.poses(1)))
    assert "--projector WIDTHxHEIGHT" in refused(tmp_path / "one", *given, "9x6")
    edit_manifest(tmp_path / "one", frames=lambda frames: [frame for frame in frames if frame["pattern"].get("axis") != "row"])
    assert "no row code" in refused(tmp_path / "one", *given, "9x6", "--projector", "256x192")


def test_the_size_of_the_projector_may_stand_in_the_manifests(relit, copies, tmp_path):
    """As relit import opencv-gray writes it; with a response of its light, which stays."""
    for folder in copies:
        edit_manifest(folder, projector={"resolution": [256, 192], "response": [0, 0.5, 1]}, camera=PLAIN_CAMERA)
    assert "projector    256x192, not calibrated: see relit calibrate" in relit("info", copies[0]).out
    outcome = relit("depth", copies[0], "--out", tmp_path / "out")
    assert outcome.code == 0 and "without depth" in outcome.out  # tests/service/depth/patterns/test_decoded_only.py
    projector = calibrated(relit, copies, *BOARD)[0].projector
    assert projector.resolution == (256, 192) and projector.response == (0, 0.5, 1) and focal_off(projector, PROJECTOR) < 0.01


def test_poses_with_phases_alone_calibrate(relit, copies):
    """The mean of a wave over its shifts is the image under even light, in which the corners are found: no white frame is needed."""
    for folder in copies:
        edit_manifest(folder, frames=lambda frames: [frame for frame in frames if frame["pattern"]["code"] == "phase"])
    manifest, report = calibrated(relit, copies, *WORDS)
    assert len(report["views"]) == 5 and report["rms_px"] < 0.3 and focal_off(manifest.projector, PROJECTOR) < 0.01  # as with white


def test_poses_at_several_exposures_calibrate(relit, rig, tmp_path):
    """Taken again at a fifth of the time and at three times it, where white clips: joined, the board is seen as at one good exposure."""
    folders, _ = rig
    copies = []
    for folder in folders:
        frames = []
        for frame in json.loads((folder / "capture.json").read_text())["frames"]:
            image = read_pixels(folder / frame["image"])
            for time in (0.02, 0.3):
                name = f"{time:g}_{frame['image']}"
                write_image(tmp_path / folder.name / name, np.rint(65535 * np.minimum(image * (time / 0.1), 1)).astype(np.uint16))
                frames.append({"image": name, "pattern": frame["pattern"], "exposure_s": time})
        copies.append(tmp_path / folder.name)
        write_manifest(copies[-1], {"schema": "relit.capture/1", "name": "board", "frames": frames, "saturation": 0.999,
                                    "camera": PLAIN_CAMERA})
    manifest, report = calibrated(relit, copies, *WORDS)
    assert len(report["views"]) == 5 and report["rms_px"] < 0.3  # as at one exposure
    assert focal_off(manifest.projector, PROJECTOR) < 0.01
    edit_manifest(copies[1], frames=json.loads((copies[1] / "capture.json").read_text())["frames"][1:])
    assert "every pattern needs all exposures" in relit.refused("calibrate", "procam", *copies, *WORDS)


def test_response_is_written_into_the_projector(relit, tmp_path):
    levels = np.linspace(0, 1, 6)
    rng = np.random.default_rng(0)
    scale = rng.uniform(0.2, 0.8, (12, 16))
    names = []
    for number, level in enumerate(levels):
        names.append(write_image(tmp_path / f"level{number}.png", np.rint(65535 * (0.02 + scale * level**2.2)).astype(np.uint16)))
    write_manifest(tmp_path, {
        "schema": "relit.capture/1", "name": "r", "camera": {"projection": "perspective", "resolution": [16, 12], "focal_px": [20, 20]},
        "projector": {"resolution": [64, 48], "focal_px": [60, 60],
                      "camera_from_projector": reference.look_at((0.1, 0, 0), (0, 0, -1)).tolist()},
        "frames": [{"image": "level5.png", "pattern": {"code": "white"}}]})
    outcome = relit("calibrate", "response", tmp_path, *names)
    assert (outcome.code, outcome.err) == (0, "") and "level^2.20" in outcome.out
    response = Capture.open(tmp_path).manifest.projector.response
    assert np.abs(np.array(response) - np.linspace(0, 1, 256) ** 2.2).max() < 2e-3
    assert "--levels: has 2 values, there are 6 images" in relit.refused("calibrate", "response", tmp_path, *names, "--levels", "0,1")
    assert "give numbers from 0 to 1" in relit.refused("calibrate", "response", tmp_path, *names, "--levels", "a,1")


@pytest.mark.skipif(not REAL.is_dir(), reason="real captures are not part of the project")
def test_a_real_scan_is_imported_and_decoded(relit, tmp_path):
    """Corners of the real chessboard in the projector lie on one homography of the board: it is flat."""
    import cv2

    from service.calibrate import procam as calibrate_procam
    from service.requests.calibrate import ProcamRequest

    relit.done("import", "opencv-gray", REAL, tmp_path, "--projector", "1024x768")
    capture = Capture.open(tmp_path)
    request = ProcamRequest(captures=(tmp_path,), board=(9, 7), square_m=0.02)
    view = calibrate_procam.view_of(capture, (1024, 768), request, "cpu")
    assert len(view.kept) == 63
    board = np.stack(np.meshgrid(np.arange(9), np.arange(7)), axis=-1).reshape(-1, 2).astype(float)
    for corners, limit in ((view.camera, 0.5), (view.projector, 0.5)):
        matrix, _ = cv2.findHomography(board, corners)
        there = np.column_stack([board, np.ones(63)]) @ matrix.T
        off = np.linalg.norm(there[:, :2] / there[:, 2:] - corners, axis=1)
        assert np.sqrt((off**2).mean()) < limit
    outcome = relit("depth", tmp_path, "--out", tmp_path / "out")
    assert (outcome.code, outcome.err) == (0, "") and "projector: has no focal_px" in outcome.out and "calibrate procam" in outcome.out
    channels, _ = exr.read(tmp_path / "out" / "depth.exr")
    assert channels["mask.Y"][97:388, 118:482].mean() > 0.96  # the board, its black squares too


def test_import_options_are_for_their_format(relit, tmp_path):
    assert "no such option: --projector" in relit.refused("import", "lp", tmp_path, tmp_path, "--projector", "16x6")
    assert "missing option '--projector'" in relit.refused("import", "opencv-gray", tmp_path, tmp_path)


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
                            "camera": PLAIN_CAMERA})
    return folder


def scene(folder, **changes):
    blank = np.full((CAMERA.height, CAMERA.width), 900, np.uint16)
    write_image(folder / "left.png", blank)
    write_image(folder / "right.png", np.full((OTHER.height, OTHER.width), 900, np.uint16))
    write_manifest(folder, {"schema": "relit.capture/1", "name": "scene", "camera": {"projection": "perspective", **entry_of(CAMERA)},
                            "other_cameras": [UNKNOWN], "frames": [{"image": "left.png", "stereo": {"images": ["right.png"]}}], **changes})
    return folder


def test_a_board_calibrates_both_cameras(relit, board, tmp_path):
    further = scene(tmp_path)
    outcome = relit("depth", further, "--out", tmp_path / "out")
    assert outcome.code == 2 and "right has no focal_px and no camera_from_other" in outcome.err and "calibrate stereo" in outcome.err
    outcome = relit.done("calibrate", "stereo", board, *BOARD, "--apply-to", further)
    assert "px RMS, baseline 0.14" in outcome.out
    for folder in (board, further):
        manifest = Capture.open(folder).manifest
        other, = manifest.other_cameras
        assert focal_off(manifest.camera, CAMERA) < 0.01 and focal_off(other, OTHER) < 0.01
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


def test_copies_of_a_frame_count_once(relit, board, tmp_path):
    folder = shutil.copytree(board, tmp_path / "board")
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    for side in ("left", "right"):
        shutil.copy(folder / f"{side}_2.png", folder / f"{side}_9.png")
    edit_manifest(folder, frames=[*frames, {"image": "left_9.png", "stereo": {"images": ["right_9.png"]}}])
    outcome = relit.done("calibrate", "stereo", folder, *BOARD)
    assert "left_9.png: left out: a copy of left_2.png" in outcome.out
    other, = json.loads((folder / "calibration.json").read_text())["stereo"]["other_cameras"]
    assert len(other["views"]) == len(frames)


def test_what_is_wrong_with_several_cameras_is_said(relit, tmp_path):
    board = write_board(tmp_path / "board", 2)
    far = scene(tmp_path / "far")
    edit_manifest(far, other_cameras=[{**UNKNOWN, "name": "top"}])
    before = (board / "capture.json").read_text()
    for folder, arguments, says in (
            (board, (*BOARD, "--apply-to", far), "other_cameras: differ in name or resolution"),
            (board, ("--board", "12x9", "--square-m", 0.03), "the camera: 0 of the views show the board"),
            (scene(tmp_path / "bare", other_cameras=None, frames=[{"image": "left.png", "light": {"type": "full"}}]), BOARD,
             "frames: none has stereo images")):
        if folder.name == "bare":
            edit_manifest(folder)
        assert says in relit.refused("calibrate", "stereo", folder, *arguments)
    assert (board / "capture.json").read_text() == before
    half = scene(tmp_path / "half", other_cameras=[{**UNKNOWN, "focal_px": [500, 500]}])
    assert "camera_from_other is missing beside focal_px" in relit.refused("depth", half, "--out", tmp_path / "out")
