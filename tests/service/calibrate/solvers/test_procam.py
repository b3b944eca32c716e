"""Projector-camera calibration from exact corners, and corners from exact correspondences."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.calibrate import stereo
from service.calibrate.solvers.procam import BoardView, board_points, calibrate, find_corners, first_alike, outliers, projector_corners
from service.calibrate.stereo import BoardFrame
from stage.capture.camera import Camera
from stage.capture.projector import Projector
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
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("YX", rng.uniform(-0.5, 0.5, 2)).as_matrix()
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
    check(found, 1e-9, 1e-9, 1e-5)
    assert np.abs(np.array(found.camera.principal) - CAMERA.principal).max() < 1e-6
    assert np.abs(np.array(found.projector.principal) - PROJECTOR.principal).max() < 1e-6
    assert np.abs(np.array(found.camera.distortion.k) - CAMERA.k).max() < 1e-9
    assert np.abs(np.array(found.projector.distortion.p) - PROJECTOR.p).max() < 1e-9
    assert found.rms_px < 1e-9 and not outliers(found).any()


def test_noisy_corners_and_an_outlier_that_is_named():
    given = list(views(10, noise=0.15))
    check(calibrate(given, BOARD, SQUARE, (400, 300), (800, 600)), 0.01, 0.01, 1.0)
    given[3] = given[3]._replace(projector=given[3].projector + np.random.default_rng(0).normal(0, 4, (54, 2)))
    found = calibrate(given, BOARD, SQUARE, (400, 300), (800, 600))
    assert list(np.flatnonzero(outliers(found))) == [3]


def test_views_with_some_corners_only():
    given = [view._replace(camera=view.camera[:40], projector=view.projector[:40], kept=view.kept[:40]) for view in views(6)]
    check(calibrate(given, BOARD, SQUARE, (400, 300), (800, 600)), 1e-3, 1e-3, 0.1)


def test_copies_of_views_are_told():
    given = list(views(3, noise=0.1))
    seen = [(view.camera, view.projector) for view in given]
    assert first_alike(seen) == [0, 1, 2] and first_alike([*seen, seen[1], (seen[0][0], seen[1][1])]) == [0, 1, 2, 1, 4]
    assert first_alike([("hidden", seen[0][1]), (seen[0][0], "hidden"), ("hidden", seen[0][1])]) == [0, 1, 0]


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
    own = (rays * reference.plane_depth(rays, pose[:3, 3], pose[:3, 2])[..., None] - pose[:3, 3]) @ pose[:3, :3]
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
    points = rays * reference.plane_depth(rays, pose[:3, 3], pose[:3, 2])[..., None]
    uv = np.floor(reference.seen_by(PROJECTOR, POSE, points)) + 0.5  # a Gray code's stripe centres
    decoded = np.random.default_rng(0).random(uv.shape[:2]) < 0.6
    uv[np.random.default_rng(1).random(uv.shape[:2]) < 0.02] += 64  # wrong bits
    found = projector_corners(corners, uv[..., 0], uv[..., 1], decoded, BOARD)
    off = np.linalg.norm(found - reference.seen_by(PROJECTOR, POSE, corners_of(pose)), axis=1)
    assert np.median(off) < 0.05 and off.max() < 0.15
    assert np.isnan(projector_corners(corners, uv[..., 0], uv[..., 1], np.zeros_like(decoded), BOARD)).all()


CAMERAS = [("the camera", (400, 300)), ("right", (800, 600))]


def shared(count, noise=0.0):
    rng = np.random.default_rng(3)
    for number, pose in enumerate(poses(count)):
        points = corners_of(pose)
        seen = reference.project(CAMERA, points), reference.seen_by(PROJECTOR, POSE, points)
        yield BoardFrame(str(number), tuple(corners + rng.normal(0, noise, corners.shape) for corners in seen))


def test_exact_corners_give_both_cameras_back():
    frames = list(shared(8))
    frames[2] = BoardFrame("2", ("hidden", frames[2].corners[1]))  # counts for the other camera all the same
    lens, (other,) = stereo.calibrate(frames, CAMERAS, BOARD, SQUARE)
    for found, device in ((lens, CAMERA), (other.lens, PROJECTOR)):
        assert np.abs(np.array(found.focal) / device.focal - 1).max() < 1e-9
        assert np.abs(np.array(found.principal) - device.principal).max() < 1e-6
    assert np.abs(other.camera_from_other[:3, 3] - POSE[:3, 3]).max() < 1e-9
    turn = other.camera_from_other[:3, :3] @ POSE[:3, :3].T
    assert np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))) < 0.01
    assert other.rms_px < 1e-9 and len(other.views) == 7 and other.certainty.depth < 1e-5


def tilted(count, most, seed, aside=0.1):
    """[count] frames of two cameras with noise of a tenth of a pixel, the board tilted by `most` rad at most, its middle up to `aside`
    metres beside the axis of the first."""
    rng = np.random.default_rng(seed)
    for number in range(count):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("yx", rng.uniform(-most, most, 2)).as_matrix()
        pose[:3, 3] = rng.uniform((-aside, -0.8 * aside, -1.05), (aside, 0.8 * aside, -0.75))
        points = corners_of(pose)
        yield BoardFrame(str(number), tuple(seen + rng.normal(0, 0.1, seen.shape) for seen in (
            reference.project(CAMERA, points), reference.seen_by(PROJECTOR, POSE, points))))


def depth_error(camera, projector, place, reach=(0.15, 0.1)):
    """[points] by which part depths are off that are triangulated with a calibration, up to `reach` metres beside the axis."""
    points = np.stack(np.meshgrid(*(np.linspace(-side, side, count) for side, count in zip(reach, (5, 4), strict=True)),
                                  [-0.75, -0.9, -1.05]), axis=-1).reshape(-1, 3)
    view = Projector(resolution=(800, 600), focal_px=projector.focal, principal_px=projector.principal, distortion=projector.distortion,
                     camera_from_projector=place.tolist())
    seen, lit = reference.project(CAMERA, points), reference.seen_by(PROJECTOR, POSE, points)
    x, y = Camera(projection="perspective", resolution=(400, 300), focal_px=camera.focal, principal_px=camera.principal,
                  distortion=camera.distortion).plane_at(*seen.T)
    rays, inverse = np.stack([x, y, -np.ones_like(x)], axis=-1), np.full(len(points), 1.1)
    for _ in range(10):
        here, there = (view.project(rays / (inverse + step)[:, None])[0] for step in (0.0, 1e-5))
        way = (there - here) / 1e-5
        inverse += (way * (lit - here)).sum(axis=-1) / (way**2).sum(axis=-1)
    return 1 / inverse / -points[:, 2] - 1


@pytest.mark.long
def test_how_sure_depths_are_is_told():
    """Over 40 calibrations the errors are as large as σ says: their mean square has a spread of a quarter, as they share one error."""
    ratios = []
    for seed in range(40):
        frames = list(tilted(8, 0.4, seed))
        lens, (other,) = stereo.calibrate(frames, CAMERAS, BOARD, SQUARE)
        ratios.append(np.sqrt(np.mean(depth_error(lens, other.lens, other.camera_from_other)**2)) / other.certainty.depth_at_boards)
        assert other.certainty.depth_at_boards < 0.006 and other.certainty.contradiction is None
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.5 and max(ratios) < 4


@pytest.mark.parametrize(("aside", "seeds"), [(0.02, (0,)), pytest.param(0.05, range(12), marks=pytest.mark.long)])
def test_how_sure_depths_are_is_told_where_no_board_was(aside, seeds):
    """Boards in the middle alone leave the edges of the image open: by three times and more what is known where the boards were."""
    whole, middle = [], []
    for seed in seeds:
        lens, (other,) = stereo.calibrate(list(tilted(8, 0.4, seed, aside)), CAMERAS, BOARD, SQUARE)
        off = np.sqrt(np.mean(depth_error(lens, other.lens, other.camera_from_other, reach=(0.3, 0.22))**2))
        whole.append(off / other.certainty.depth)
        middle.append(off / other.certainty.depth_at_boards)
        warned = [said for said in other.certainty.warnings() if f"in {100 * other.certainty.covered:.0f} % of the image" in said]
        assert other.certainty.covered < 0.3 and len(warned) == (other.certainty.depth > 0.01)
    # the points reach beyond some corners of the image and not into others, and each case has one error for all depths
    assert np.sqrt(np.mean(np.square(middle))) > 3 and np.sqrt(np.mean(np.square(whole))) < 2


def test_boards_all_over_the_image_are_not_remarked_on():
    _, (other,) = stereo.calibrate(list(tilted(8, 0.4, 3, aside=0.2)), CAMERAS, BOARD, SQUARE)
    assert other.certainty.warnings() == [] and other.certainty.covered > 0.35
    assert other.certainty.depth < 1.5 * other.certainty.depth_at_boards


@pytest.mark.parametrize(("count", "most"), [
    (3, 0.05), *(pytest.param(*more, marks=pytest.mark.long) for more in ((8, 0.01), (20, 0.0)))])
def test_boards_that_lie_alike_are_refused(count, most):
    """They fit to a tenth of a pixel, with focal lengths that are wrong by up to five times."""
    frames = list(tilted(count, most, 1))
    with pytest.raises(CalibrationError, match=r"do not determine|comes out as"):
        stereo.calibrate(frames, CAMERAS, BOARD, SQUARE)
    views = [BoardView(frame.name, *frame.corners, np.arange(len(frame.corners[0]))) for frame in frames]
    with pytest.raises(CalibrationError, match=r"do not determine|comes out as"):
        calibrate(views, BOARD, SQUARE, (400, 300), (800, 600))


def test_boards_that_are_hardly_tilted_are_remarked_on():
    _, (other,) = stereo.calibrate(list(tilted(10, 0.1, 2)), CAMERAS, BOARD, SQUARE)
    assert 0.01 < other.certainty.depth < 0.03 and "tilt the board" in other.certainty.warnings()[0]


def test_corners_that_begin_at_the_other_end_are_turned():
    first, other = next(shared(1)).corners
    assert np.array_equal(stereo.alike_order(first, other[::-1]), other)
    assert np.array_equal(stereo.alike_order(first, other), other)


def test_too_few_views_of_a_pair_are_refused():
    frames = list(shared(6))
    hidden = [frame._replace(corners=(frame.corners[0], "none")) for frame in frames]
    with pytest.raises(CalibrationError, match="right: 2 of the views show the board"):
        stereo.calibrate([*frames[:2], *hidden[2:]], CAMERAS, BOARD, SQUARE)
    with pytest.raises(CalibrationError, match="right: 0 of the views show the board: none"):
        stereo.calibrate(hidden, CAMERAS, BOARD, SQUARE)
    apart = [frame._replace(corners=("none", frame.corners[1])) for frame in frames[3:]]
    with pytest.raises(CalibrationError, match="right: 1 of the views show the board to it and to the first"):
        stereo.calibrate([frames[0], *hidden[1:3], *apart], CAMERAS, BOARD, SQUARE)
