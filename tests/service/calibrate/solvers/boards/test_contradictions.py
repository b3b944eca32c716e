"""Devices that fit the boards alone and not together: what is named, and that the standard deviation of depths holds it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.calibrate import stereo
from service.calibrate.solvers.boards.alone import Sight, alone
from service.calibrate.solvers.boards.bundle import adjust
from service.calibrate.solvers.procam import BoardView, board_points, calibrate
from service.calibrate.stereo import BoardFrame
from stage.errors import CalibrationError
from tests.reference import projector as reference
from tests.service.calibrate.solvers.test_procam import BOARD, CAMERA, CAMERAS, POSE, PROJECTOR, SQUARE, depth_error, tilted

SIZES = (400, 300), (800, 600)


def paired(firsts, others):
    return [BoardFrame(first.name, (first.corners[0], other)) for first, other in zip(firsts, others, strict=True)]


def bumped(seed, shift, since=4):
    """Eight frames; from one on the second camera is turned by so many of its pixels."""
    frames = list(tilted(8, 0.4, seed))
    return paired(frames, [frame.corners[1] + (shift if number >= since else 0) for number, frame in enumerate(frames)])


def views_of(frames, change=lambda corners: corners):
    return [BoardView(frame.name, frame.corners[0], change(frame.corners[1]), np.arange(len(frame.corners[0]))) for frame in frames]


def test_a_camera_that_moved_half_way_is_named_with_its_views():
    lens, (other,) = stereo.calibrate(bumped(0, (2.0, 0.0), since=6), CAMERAS, BOARD, SQUARE)
    said, = other.certainty.warnings()
    assert "the camera and right contradict each other: alone they fit the boards to 0.14 and 0.13 px, together to" in said
    assert "without 6, 7 they do not" in said and "nothing moved" in said
    off = np.sqrt(np.mean(depth_error(lens, other.lens, other.camera_from_other)**2))
    assert off > 0.005 and off < 2.5 * other.certainty.depth_at_boards  # noise alone would leave 0.002
    # right pairs stay below by a factor of two: chance gives 1.6 at most
    _, (right,) = stereo.calibrate(bumped(0, (0.0, 0.0)), CAMERAS, BOARD, SQUARE)
    assert right.certainty.contradiction is None


@pytest.mark.long
def test_a_third_camera_that_few_views_show_is_named_too():
    """Without the views in which it stood elsewhere it would share one view with the first camera, so that no views are named."""
    random = np.random.default_rng(9)
    frames = [frame._replace(corners=(*frame.corners, frame.corners[1] + random.normal(0, 0.1, (54, 2)) + (3.0 if number < 2 else 0.0)
                                      if number < 3 else "hidden")) for number, frame in enumerate(tilted(8, 0.4, 0))]
    _, others = stereo.calibrate(frames, [*CAMERAS, ("third", SIZES[1])], BOARD, SQUARE)
    for other in others:
        said = str(other.certainty.contradiction)
        assert said.startswith("the camera, right and third contradict each other: alone they fit the boards to 0.14, 0.13 and 0.1")
        assert "without" not in said


@pytest.mark.long
@pytest.mark.parametrize("shift", [1.0, 2.0])
def test_errors_of_a_camera_that_moved_are_as_large_as_is_said(shift):
    """Sixteen calibrations, of which each has one error for all depths: their mean square has a spread of a third."""
    ratios = []
    for seed in range(16):
        lens, (other,) = stereo.calibrate(bumped(seed, (shift, 0.0)), CAMERAS, BOARD, SQUARE)
        ratios.append(np.sqrt(np.mean(depth_error(lens, other.lens, other.camera_from_other)**2)) / other.certainty.depth_at_boards)
        assert other.certainty.contradiction is not None
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5 and max(ratios) < 3


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_pairs_that_are_exchanged_are_named(seed):
    frames = list(tilted(8, 0.4, seed))
    others = [frame.corners[1] for frame in frames]
    others[2], others[5] = others[5], others[2]
    with pytest.raises(CalibrationError, match=r"contradict each other.*without 2, 5 they do not.*images of a view are of one moment"):
        stereo.calibrate(paired(frames, others), CAMERAS, BOARD, SQUARE)
    with pytest.raises(CalibrationError, match=r"the camera and the projector contradict each other.*without 2, 5 they do not"):
        calibrate(views_of(paired(frames, others)), BOARD, SQUARE, *SIZES)


@pytest.mark.long
@pytest.mark.parametrize(("change", "words"), [
    (lambda corners: corners * [-1, 1] + [800, 0], "the columns of the projector counted from the other side they fit to 0.1. px"),
    (lambda corners: corners * [1, -1] + [0, 600], "the rows of the projector counted from the other side they fit to 0.1. px"),
    (lambda corners: corners[:, ::-1], "columns and rows of the projector exchanged they fit to 0.1. px")])
def test_mirrored_images_are_named(change, words):
    """The poses of the board are good, and are not accused."""
    with pytest.raises(CalibrationError, match=f"contradict each other.*with {words}") as refused:
        calibrate(views_of(tilted(6, 0.4, 4), change), BOARD, SQUARE, *SIZES)
    assert "tilt the board" not in str(refused.value)


@pytest.mark.long
def test_a_mirrored_camera_whose_corners_are_found_from_the_other_end_is_named():
    frames = list(tilted(6, 0.4, 4))
    others = [(frame.corners[1] * [-1, 1] + [800, 0]).reshape(BOARD[1], BOARD[0], 2)[:, ::-1].reshape(-1, 2) for frame in frames]
    with pytest.raises(CalibrationError, match=r"with the columns of right counted from the other side they fit to 0.1. px"):
        stereo.calibrate(paired(frames, others), CAMERAS, BOARD, SQUARE)


@pytest.mark.long
@pytest.mark.parametrize(("aspect", "words"), [(1.01, "1 % taller than wide"), (0.985, "1.5 % wider than tall")])
def test_a_print_whose_squares_are_none_is_named(aspect, words):
    random, frames = np.random.default_rng(3), []
    for number in range(8):
        turn = Rotation.from_euler("zyx", random.uniform(-0.5, 0.5, 3) * [0.4, 1, 1]).as_matrix()
        own = board_points(BOARD, SQUARE) - [SQUARE * (BOARD[0] - 1) / 2, SQUARE * (BOARD[1] - 1) / 2, 0]
        points = own * (1, -aspect, 1) @ turn.T + random.uniform((-0.08, -0.06, -1.0), (0.08, 0.06, -0.8))
        seen = reference.project(CAMERA, points), reference.seen_by(PROJECTOR, POSE, points)
        frames.append(BoardFrame(str(number), tuple(corners + random.normal(0, 0.05, corners.shape) for corners in seen)))
    _, (other,) = stereo.calibrate(frames, CAMERAS, BOARD, SQUARE)
    said = str(other.certainty.contradiction)
    assert f"with squares that are {words} they fit to 0.0" in said and "measure the print along both sides" in said


@pytest.mark.long
def test_a_camera_that_stands_upside_down_is_named():
    """The corners of such a camera begin at the other end of the board."""
    frames = list(tilted(6, 0.4, 4))
    others = [stereo.alike_order(frame.corners[0], frame.corners[1] * -1 + [800, 600]) for frame in frames]
    with pytest.raises(CalibrationError, match=r"with the board seen from its other end by right they fit to 0.1. px, as where it stands "
                                               "upside down: turn its images by 180°"):
        stereo.calibrate(paired(frames, others), CAMERAS, BOARD, SQUARE)


def seen_boards(count, seed, form=lambda own: own, image=lambda corners: corners):
    """Views of a board of another form, or of another image of the projector, with noise of a tenth of a pixel."""
    random = np.random.default_rng(seed)
    own = form(board_points(BOARD, SQUARE) - [SQUARE * (BOARD[0] - 1) / 2, SQUARE * (BOARD[1] - 1) / 2, 0]) * (1, -1, 1)
    for number in range(count):
        turn = Rotation.from_euler("zyx", random.uniform(-0.5, 0.5, 3) * [0.4, 1, 1]).as_matrix()
        points = own @ turn.T + random.uniform((-0.1, -0.08, -1.0), (0.1, 0.08, -0.8))
        seen = reference.project(CAMERA, points), image(reference.seen_by(PROJECTOR, POSE, points))
        yield BoardView(str(number), *(corners + random.normal(0, 0.1, corners.shape) for corners in seen), np.arange(len(points)))


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in range(1, 8))])
def test_a_bent_board_is_fitted(seed):
    """Bent by 1.5 mm over 240 mm, depths were off by 1.5 to 3 %, at 2 to 4 σ; the same noise on a flat board gives errors as large."""
    def bent(own):
        return own + np.outer(0.0015 * (own[:, 0] / own[:, 0].max())**2, [0, 0, 1])

    found = [calibrate(list(seen_boards(8, seed, form)), BOARD, SQUARE, *SIZES) for form in (bent, lambda own: own)]
    off = [np.sqrt(np.mean(depth_error(each.camera, each.projector, each.camera_from_projector)**2)) for each in found]
    assert abs(off[0] - off[1]) < 0.001 and off[0] < 4 * found[0].certainty.depth_at_boards
    assert found[1].certainty.bend[0] == 0 and found[1].certainty.warnings() == []
    height, length = found[0].certainty.bend
    assert abs(height - 0.0015) < 0.0002 and abs(length - 0.24) < 1e-6
    (said,) = found[0].certainty.warnings()
    assert said.startswith("the board is bent by 1.") and "over 240 mm, which is fitted" in said


def keystoned(aside, up):
    """An image of the projector that is drawn together towards one side and towards one end."""
    return lambda corners: (corners - [400, 300]) / (1 + (corners - [400, 300]) @ [aside / 800, up / 600])[:, None] + [400, 300]


def test_keystone_correction_is_named():
    """Depths were off by 2 to 27 %, at 2 to 10 σ, or other causes were named; upright keystones are lenses with a shift."""
    with pytest.raises(CalibrationError, match=r"the image of the projector sheared by \d.* fits alone to 0.1.* keystone correction"):
        calibrate(list(seen_boards(8, 0, image=keystoned(0.2, 0.2))), BOARD, SQUARE, *SIZES)
    found = calibrate(list(seen_boards(8, 0, image=keystoned(0.0, 0.0))), BOARD, SQUARE, *SIZES)
    assert found.certainty.warnings() == []


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.long) for seed in (0, 5, 6, 7))])
def test_a_principal_point_outside_the_image_is_found(seed):
    """As of a lens that is shifted far: begun from the middle of the image, half of these fits ended at 1.4 to 1.7 px."""
    found = calibrate(list(seen_boards(8, seed, image=lambda corners: keystoned(0, 0.3)(corners + [0, 250]))), BOARD, SQUARE, *SIZES)
    assert found.rms_px < 0.2 and found.certainty.contradiction is None  # noise leaves 0.14


def test_a_negative_focal_length_is_refused():
    every = board_points(BOARD, SQUARE)
    sights = [[Sight(device, number, every, frame.corners[device]) for number, frame in enumerate(tilted(4, 0.4, 0))] for device in (0, 1)]
    found = adjust([*sights[0], *sights[1]], [alone(own, size, "it") for own, size in zip(sights, SIZES, strict=True)])
    assert found.certainty(1, "right").depth_at_boards < 0.02
    wrong = found._replace(lenses=[found.lenses[0], found.lenses[1]._replace(matrix=found.lenses[1].matrix * [[-1], [1], [1]])])
    with pytest.raises(CalibrationError, match=r"do not determine right: a focal length comes out as -1.*px"):
        wrong.certainty(1, "right")
