"""Laser planes from their stripes on a chessboard: planes within their σ, and a scan that is right with them."""

import json
from itertools import islice

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stage.capture.capture import Capture
from stage.errors import CalibrationError
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest, write_images, write_manifest
from tests.scenes.depth import entry_of
from tests.scenes.in_front import unit
from tests.service.calibrate.solvers.test_procam import BOARD, CAMERA, SQUARE, board_image, poses

PLANES = [(np.array((0.25, 0.0, 0.0)), np.array((np.cos(angle), 0.05, np.sin(angle)))) for angle in np.radians((-13, -15.5, -18))]
WIDTH = 0.0025
PLACEHOLDER = {"type": "plane", "point_m": [0, 0, 0], "normal": [1, 0, 0]}
POSES = list(islice(poses(8), 4))


def photograph(folder, points, albedo, planes=PLANES, noise=0.002):
    """Frames of each plane on a surface, and one under the light of the room."""
    random = np.random.default_rng(5)
    images = []
    for plane in [*planes, None]:
        glow = 0.0 if plane is None else 0.6 * np.exp(-(((points - plane[0]) @ unit(plane[1])) ** 2) / (2 * WIDTH**2))
        image = albedo * (0.2 + glow)
        images.append(np.maximum(image + random.normal(0, noise, image.shape), 0))
    return written(folder, images)


def written(folder, images):
    """A capture whose last image is under the light of the room, and the others under lasers that are still to be calibrated."""
    frames = write_images(folder, images, [*[{"laser": PLACEHOLDER}] * (len(images) - 1), {"light": {"type": "off"}}], "{}.exr")
    write_manifest(folder, {"schema": "relit.capture/1", "name": "board", "camera": {"projection": "perspective", **entry_of(CAMERA)},
                            "frames": frames})
    return folder


def boards(folder, chosen=POSES, planes=PLANES):
    rays = reference.pixel_rays(CAMERA)
    found = []
    for number, pose in enumerate(chosen):
        points = rays * reference.plane_depth(rays, pose[:3, 3], pose[:3, 2])[..., None]
        found.append(photograph(folder / f"pose{number}", points, board_image(pose), planes))
    return found


def calibrated(relit, folders, *options):
    return relit("calibrate", "laser-planes", *folders, "--board", f"{BOARD[0]}x{BOARD[1]}", "--square-m", SQUARE, "--device", "cpu",
                 *options)


@pytest.mark.long
def test_planes_are_found_and_measure_an_object(relit, tmp_path):
    """Corners are off by 0.1 px, the board by a part of a millimetre: planes by tenths of a degree, depths by millimetres."""
    folders = boards(tmp_path)
    rays = reference.pixel_rays(CAMERA)
    truth = reference.plane_depth(rays, (0.0, 0.0, -0.95), (0.1, 0.05, 1.0))
    scan = photograph(tmp_path / "scan", rays * truth[..., None], np.full(truth.shape, 0.5))
    outcome = calibrated(relit, folders, "--apply-to", scan)
    assert (outcome.code, outcome.err) == (0, ""), outcome.err
    report = json.loads((folders[0] / "calibration.json").read_text())["laser-planes"]
    found = [frame.laser for frame in Capture.open(scan).manifest.frames if frame.laser is not None]
    for laser, entry, (point, normal) in zip(found, report["planes"], PLANES, strict=True):
        off = np.degrees(np.arccos(min(1.0, abs(np.array(laser.normal) @ unit(normal)))))
        assert off < 0.5 and off < 5 * entry["sigma_degrees"] + 0.1, (off, entry)
        assert abs((np.array(laser.point_m) - point) @ unit(normal)) < 0.002
    maps, measured, _ = relit.depth(scan, "--device", "cpu")
    error = np.abs(maps.depth - truth)[maps.mask]
    assert maps.mask.sum() > 300 and np.median(error) < 0.004 and np.quantile(error, 0.95) < 0.01
    # σ holds how far the planes are known: |e| / σ is 0.67 in the median if it is right, and at most 3 where errors are normal
    assert np.median(error / maps.sigma[maps.mask]) < 1 and np.quantile(error / maps.sigma[maps.mask], 0.99) < 3
    assert not any("whether its planes are right" in words for words in measured.get("warnings", ()))


@pytest.mark.long
def test_a_camera_that_was_refocused_is_said_and_held(relit, tmp_path):
    """Focal lengths of the manifest 5 % too long: planes were 10 to 14 mm off, where 0.1 mm was stated, without a word."""
    folders = boards(tmp_path)
    for factor in (1.0, 1.05):
        for folder in folders:
            edit_manifest(folder, camera={"projection": "perspective", **entry_of(CAMERA), "focal_px": [factor * CAMERA.focal] * 2})
        outcome = calibrated(relit, folders)
        assert outcome.code == 0 and ("camera.focal_px: the corners of the boards fit best with 0.9" in outcome.out) == (factor > 1)
        found = [frame.laser for frame in Capture.open(folders[0]).manifest.frames if frame.laser is not None]
        for laser, (point, normal) in zip(found, PLANES, strict=True):
            off = np.degrees(np.arccos(min(1.0, abs(np.array(laser.normal) @ unit(normal)))))
            assert off < 3 * laser.accuracy_deg + 0.1
            assert abs((np.array(laser.point_m) - point) @ unit(normal)) < 3 * laser.accuracy_m


@pytest.mark.long
@pytest.mark.parametrize("given", [None, [0.0, 0.0, 0.0]], ids=["missing", "zero"])
def test_a_distortion_that_the_camera_lacks_is_said_and_held(relit, tmp_path, given):
    """A lens with k1 = -0.15, which moves corners by 0.7 pixels: planes were 0.55 mm off, where 0.08 mm was stated, without a word."""
    folders = boards(tmp_path)
    entry = {name: value for name, value in entry_of(CAMERA).items() if name != "distortion"}
    lens = {} if given is None else {"distortion": {"model": "brown_conrady", "k": given}}
    for folder in folders:
        edit_manifest(folder, camera={"projection": "perspective", **entry, **lens})
    outcome = calibrated(relit, folders)
    assert outcome.code == 0 and "camera.distortion: " in outcome.out and ("is missing" in outcome.out) == (given is None)
    assert "camera.focal_px" not in outcome.out
    found = [frame.laser for frame in Capture.open(folders[0]).manifest.frames if frame.laser is not None]
    for laser, (point, normal) in zip(found, PLANES, strict=True):
        off = abs((np.array(laser.point_m) - point) @ unit(normal))
        assert off < 1.5 * laser.accuracy_m < 3e-3


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 8])
def test_stripes_that_leave_the_board_do_not_turn_their_plane(relit, tmp_path, seed):
    """Six boards, beside some of which half of a stripe falls: taken for whole, it turned a plane by 1.4°, or had all refused."""
    rng = np.random.default_rng(600 + seed)
    views = []
    for _ in range(6):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("YX", rng.uniform(-0.5, 0.5, 2)).as_matrix()
        pose[:3, 3] = rng.uniform((-0.05, -0.04, -1.0), (0.05, 0.04, -0.8))
        views.append(pose)
    planes = [(PLANES[0][0], np.array((np.cos(angle), 0.05, np.sin(angle)))) for angle in np.radians((-13, -21, -21.7, -22.4))]
    outcome = calibrated(relit, boards(tmp_path, views, planes))
    assert (outcome.code, outcome.err) == (0, ""), outcome.err
    report = json.loads((tmp_path / "pose0" / "calibration.json").read_text())["laser-planes"]
    for entry, (_, normal) in zip(report["planes"], planes, strict=True):
        off = np.degrees(np.arccos(min(1.0, abs(np.array(entry["normal"]) @ unit(normal)))))
        assert off < 2 * entry["sigma_degrees"], (off, entry)


@pytest.mark.long
def test_a_plane_that_misses_the_boards_is_left_out_on_request(relit, tmp_path):
    beside = (PLANES[0][0], np.array((1.0, 0.05, 0.05)))
    folders = boards(tmp_path, POSES, [*PLANES, beside])
    before = (folders[0] / "capture.json").read_bytes()
    outcome = calibrated(relit, folders)
    assert outcome.code == 2 and "3.exr" in outcome.err and "--drop-failed leaves such frames out" in outcome.err
    assert (folders[0] / "capture.json").read_bytes() == before
    outcome = calibrated(relit, folders, "--drop-failed")
    assert (outcome.code, outcome.err) == (0, "") and "frames of 3.exr" in outcome.out
    frames = Capture.open(folders[0]).manifest.frames
    assert [frame.image for frame in frames if frame.laser is not None] == ["0.exr", "1.exr", "2.exr"]
    entries = json.loads((folders[0] / "calibration.json").read_text())["laser-planes"]["planes"]
    assert ["dropped" in entry for entry in entries] == [False, False, False, True]
    assert "--drop-failed is for boards" in relit.refused("calibrate", "laser-planes", *folders, "--step-m", 0.05, "--drop-failed")


@pytest.mark.long
def test_what_does_not_determine_planes_is_refused(relit, tmp_path):
    folders = boards(tmp_path)
    before = [(folder / "capture.json").read_bytes() for folder in folders]
    same = boards(tmp_path / "same", [POSES[0], POSES[0]])
    calibrated(relit, same).refused("its stripes lie so close to one line")
    frames = json.loads(before[1])["frames"]
    edit_manifest(folders[1], frames=frames[1:])
    calibrated(relit, folders).refused("pose1/capture.json: frames: 2 have a laser plane, those of")
    edit_manifest(folders[1], frames=frames[:3])
    calibrated(relit, folders).refused("frames: none shows the board without the laser")
    (folders[1] / "capture.json").write_bytes(before[1])
    calibrated(relit, folders[:2], "--board", "5x5").refused("the board of 5x5 inner corners is not found")
    outcome = calibrated(relit, folders[:1])
    assert outcome.code == 2
    assert [(folder / "capture.json").read_bytes() for folder in folders] == before
    assert not any((folder / "calibration.json").exists() for folder in folders)


@pytest.mark.parametrize("wrong", [0, 3])
def test_a_board_that_shows_another_stripe_is_named(wrong):
    """Stripes straight to 0.1 mm in a plane, and one that lies 30 mm beside it: the reason was that all lay close to one line."""
    from service.calibrate.solvers.laser_plane import fit_light_plane

    random = np.random.default_rng(2)
    stripes = [np.stack([random.normal(0, 1e-4, 200), random.uniform(-0.1, 0.1, 200), np.full(200, -distance)], axis=1)
               for distance in (0.9, 0.95, 1.0, 1.05)]
    stripes[wrong] = stripes[wrong] + (0.03, 0, 0)
    with pytest.raises(CalibrationError, match=rf"miss any common plane by .* mm; without that of pose{wrong} the others lie in one plane"):
        fit_light_plane(stripes, [f"pose{number}" for number in range(4)])
    with pytest.raises(CalibrationError, match=r"miss any common plane by .* mm: check the order of the frames"):
        fit_light_plane(stripes[:2] + stripes[3:] if wrong == 3 else stripes[:3], ["a", "b", "c"])


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_a_plane_from_points(tilt):
    """Boards whose poses are off by half a millimetre, and a tenth of the points of another light."""
    from service.calibrate.solvers.laser_plane import fit_light_plane

    random = np.random.default_rng(2)
    normal = unit(np.array((1.0, tilt, 0.4)))
    along, across = unit(np.cross(normal, (0, 0, 1.0))), None
    across = np.cross(normal, along)
    stripes = []
    for distance in (0.8, 0.95, 1.1, 1.25):
        points = distance * across + along * random.uniform(-0.1, 0.1, 200)[:, None]
        points += random.normal(0, 1e-4, points.shape) + random.normal(0, 5e-4, 3)
        points[:20] += random.uniform(-0.1, 0.1, (20, 3))
        stripes.append(points)
    found = fit_light_plane(stripes)
    off = np.degrees(np.arccos(min(1.0, abs(found.normal @ normal))))
    assert off < 0.1 and off < 3 * found.sigma_degrees < 3  # the other light widens σ
