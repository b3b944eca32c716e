"""ChArUco boards drawn by rays through distorted lenses: corners, cameras, and boards that are declared otherwise."""

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from service.calibrate.solvers.charuco import DICTIONARIES, Charuco, charuco_of, find_board, holds_a_pose
from service.calibrate.solvers.procam import board_points
from service.calibrate.stereo import BoardFrame, calibrate
from service.requests.calibrate import BoardOptions
from stage.capture.capture import Capture
from tests.reference import projector as reference
from tests.scenes.captures import write_image, write_manifest
from tests.service.calibrate.solvers.test_procam import fine_rays

pytestmark = pytest.mark.long  # the fixture takes ten seconds

BOARD, SQUARE, SIDE = (7, 5), 0.04, 0.7
CAMERA = reference.Device(480, 360, 520.0, (-0.12, 0.04, 0.0), (0.0008, -0.001))
OTHER = reference.Device(480, 360, 560.0, (-0.07, 0.02, 0.0), (-0.0006, 0.0005))
PLACE = reference.look_at((0.12, 0.02, 0.01), (0.0, 0.0, -0.55))
PRINTED = Charuco("aruco5", SIDE)
SADDLE_PX = 0.35
"""What corners are good to, as of chessboards (test_procam.py): edges of the drawing are sampled at thirds of a pixel."""


def poses(count):
    rng = np.random.default_rng(3)
    for _ in range(count):
        turn, _ = cv2.Rodrigues(np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(-1.5, 1.5)]))
        yield turn, np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(-0.58, -0.5)])  # the board hangs out of the image


def print_of(dictionary, board=BOARD, side=SIDE, size=200):
    """The printed board, [rows, cols]: black squares where column and row sum up to an even number, markers numbered row by row."""
    across, down = board[0] + 1, board[1] + 1
    sheet = np.ones((down * size, across * size))
    markers = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    edge, number = round(side * size), 0
    for row in range(down):
        for col in range(across):
            top, left = row * size, col * size
            if (row + col) % 2 == 0:
                sheet[top:top + size, left:left + size] = 0
                continue
            gap = (size - edge) // 2
            sheet[top + gap:top + gap + edge, left + gap:left + gap + edge] = cv2.aruco.generateImageMarker(markers, number, edge) / 255
            number += 1
    return sheet


SHEET = print_of("aruco5")


def drawn(pose, device, sheet, board, square, fine=3):
    """Linear image of a printed board; what lies around it is grey."""
    turn, place = pose
    rays = fine_rays(device, fine)
    own = (rays * (place @ turn[:, 2] / (rays @ turn[:, 2]))[..., None] - place) @ turn
    size = sheet.shape[1] / (board[0] + 1)
    col, row = ((sign * own[..., axis] / square + (board[axis] + 1) / 2) * size for axis, sign in ((0, 1), (1, -1)))
    inside = (col >= 0) & (col < sheet.shape[1]) & (row >= 0) & (row < sheet.shape[0])
    shade = sheet[np.clip(row, 0, sheet.shape[0] - 1).astype(int), np.clip(col, 0, sheet.shape[1] - 1).astype(int)]
    radiance = np.where(inside, 0.06 + 0.7 * shade, 0.5)
    return radiance.reshape(device.height, fine, device.width, fine).mean(axis=(1, 3)).astype(np.float32)


def seen(pose, device=CAMERA):
    return drawn(pose, device, SHEET, BOARD, SQUARE)


def truth(pose, device=CAMERA):
    turn, place = pose
    own = board_points(BOARD, SQUARE).astype(float) - [SQUARE * (BOARD[0] - 1) / 2, SQUARE * (BOARD[1] - 1) / 2, 0]
    return reference.project(device, own * (1, -1, 1) @ turn.T + place)


def from_other(pose):
    inverse = np.linalg.inv(PLACE)
    return inverse[:3, :3] @ pose[0], inverse[:3, :3] @ pose[1] + inverse[:3, 3]


@pytest.fixture(scope="module")
def views():
    """Six poses as two cameras see them: pose, and the corners of each."""
    return [(pose, find_board(seen(pose), BOARD, PRINTED), find_board(seen(from_other(pose), OTHER), BOARD, PRINTED)) for pose in poses(6)]


def test_corners_that_are_seen_are_right_and_the_others_left_out(views):
    whole = 0
    for pose, first, other in views:
        for corners, true in ((first, truth(pose)), (other, truth(from_other(pose), OTHER))):
            found = np.isfinite(corners).all(axis=-1)
            assert np.linalg.norm(corners[found] - true[found], axis=1).max() < SADDLE_PX
            inside = ((true > 0) & (true < (CAMERA.width, CAMERA.height))).all(axis=-1)
            assert not found[~inside].any()
            whole += int(inside.all())
    assert whole < 9  # of 12: the others hang out of the image


def test_both_cameras_are_known_from_boards_seen_in_part(views):
    size = CAMERA.width, CAMERA.height
    frames = [BoardFrame("", (first, other)) for _, first, other in views]
    lens, (other,) = calibrate(frames, [("camera", size), ("other", size)], BOARD, SQUARE)
    for found, device in zip((lens, other.lens), (CAMERA, OTHER), strict=True):
        assert np.abs(np.array(found.focal) / device.focal - 1).max() < 0.01  # as with rendered chessboards
    assert np.linalg.norm(other.camera_from_other[:3, 3] - PLACE[:3, 3]) < 0.003
    assert other.rms_px < SADDLE_PX


def test_an_occluder_costs_its_corners_alone():
    pose = np.eye(3), np.array([0.0, 0.0, -0.6])
    image, true = seen(pose), truth(pose)
    x, y = true[17]  # in the middle of the board
    image[int(y) - 35:int(y) + 35, int(x) - 35:int(x) + 35] = 0.3
    found = np.isfinite(find_board(image, BOARD, PRINTED)).all(axis=-1)
    assert not found[17] and found.sum() >= 24


def test_a_board_that_is_declared_otherwise_is_named():
    image = seen(next(poses(1)))
    assert "give --markers aruco5" in find_board(image, BOARD, Charuco("aruco4", SIDE))
    assert "give --markers aruco5" in find_board(image, BOARD, Charuco("apriltag36h11", SIDE))
    for wrong in ((5, 7), (8, 5), (6, 5), (9, 6)):
        assert "count the corners again" in find_board(image, wrong, PRINTED)
    for wrong in (0.5, 0.9):
        said = find_board(image, BOARD, Charuco("aruco5", wrong))
        assert "of a square wide" in said and abs(float(said.split(" of a square")[0].split()[-1]) / SIDE - 1) < 0.05
    assert "0 markers of aruco5, fewer" in find_board(np.full((90, 120), 0.4, np.float32), BOARD, PRINTED)


def test_one_row_of_markers_is_not_blamed_on_the_declaration():
    """All but one row of the board hangs out of the image; the declaration is right."""
    strip = 0.06 + 0.7 * print_of("aruco5", (11, 5), size=60)[55:125].astype(np.float32)
    for declared in ((11, 5), (9, 5)):
        assert "lie in one line" in find_board(strip, declared, PRINTED)


def test_markers_that_fit_no_board_are_refused():
    def refused(**given):
        with pytest.raises(ValidationError) as fault:
            BoardOptions(board=(7, 5), square_m=0.04, **given)
        return str(fault.value)

    assert "belong together" in refused(markers="aruco5")
    assert "not smaller than the squares" in refused(markers="aruco5", marker_m=0.05)
    assert "0.028 for 28 mm" in refused(markers="aruco5", marker_m=28)
    assert charuco_of(BoardOptions(board=(7, 5), square_m=0.04, markers="aruco5", marker_m=0.028)) == Charuco("aruco5", pytest.approx(0.7))
    assert charuco_of(BoardOptions(board=(7, 5), square_m=0.04)) is None


def test_the_command_calibrates_two_cameras_and_names_another_dictionary(relit, tmp_path):
    frames = []
    for number, pose in enumerate(poses(5)):
        for name, image in (("left", seen(pose)), ("right", seen(from_other(pose), OTHER))):
            write_image(tmp_path / f"{name}{number}.png", np.rint(65535 * image).astype(np.uint16))
        frames.append({"image": f"left{number}.png", "stereo": {"images": [f"right{number}.png"]}})
    size = [CAMERA.width, CAMERA.height]
    write_manifest(tmp_path, {"schema": "relit.capture/1", "name": "board", "frames": frames, "other_cameras": [
        {"name": "right", "resolution": size}], "camera": {"projection": "orthographic", "resolution": size}})
    words = "calibrate", "stereo", tmp_path, "--board", "7x5", "--square-m", 0.04, "--marker-m", 0.028, "--markers"
    assert "0 of the views show the board" in (said := relit.refused(*words, "aruco6")) and "give --markers aruco5" in said
    relit.done(*words, "aruco5")
    camera, (other,) = Capture.open(tmp_path).manifest.camera, Capture.open(tmp_path).manifest.other_cameras
    for lens, device in ((camera, CAMERA), (other, OTHER)):
        assert np.abs(np.array(lens.focal_px) / device.focal - 1).max() < 0.01
    assert np.linalg.norm(np.array(other.camera_from_other)[:3, 3] - PLACE[:3, 3]) < 0.004


@pytest.mark.parametrize(("seen", "held"), [([0, 1, 2, 3, 4, 5, 6, 7], False), ([0, 1, 2, 3, 7, 8, 9, 10], True), ([0, 1, 7, 8], False),
                                            ([0, 7, 14, 21, 28, 1, 9, 17], False)])
def test_a_line_of_corners_and_one_beside_it_hold_no_pose(seen, held):
    """A view of one row and one corner of a 7x5 board turned its plane by ten degrees at a residual of .13 pixels."""
    assert holds_a_pose(np.array(seen), (7, 5)) is held
