"""Laser planes from their stripes on a step of known height: planes within their σ, a scan that is right with them, and what is refused."""

import json

import numpy as np
import pytest

from stage.capture.capture import Capture
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest
from tests.scenes.step import CAMERA, HEIGHT, LASER, Step, laser_planes, photograph

pytestmark = pytest.mark.long
PLANES = laser_planes(5)


def calibrated(relit, *words):
    return relit("calibrate", "laser-planes", *words, "--step-m", HEIGHT, "--device", "cpu")


def errors(folder):
    """Errors of each plane: of its tilt in degrees, of depths as a part, and both in their standard errors."""
    found = [frame.laser for frame in Capture.open(folder).manifest.frames if frame.laser is not None]
    entries = json.loads((folder / "calibration.json").read_text())["laser-planes"]["planes"]
    rows = []
    for laser, normal, entry in zip(found, PLANES, entries, strict=True):
        tilt = np.degrees(np.arccos(min(1.0, abs(np.dot(laser.normal, normal)))))
        depth = abs((LASER @ normal) / (np.array(laser.point_m) @ normal) - 1)
        rows.append((tilt, depth, tilt / entry["sigma_degrees"], depth / entry["sigma_depth"]))
    return np.array(rows).T


@pytest.mark.parametrize(("pose", "even"), [({}, True), ({"elevation": 30.0}, False), ({"elevation": 52.0, "turn": -10.0}, True),
                                            ({"turn": 20.0, "distance": 0.7}, False)])
def test_planes_are_found_within_their_sigma(relit, tmp_path, pose, even):
    """Noise of 0.4 % and texture of 15 % move stripes by hundredths of a pixel; the block is right-angled, which is not known to 0.25°."""
    folder = photograph(tmp_path / "step", Step(**pose), PLANES, even=even)
    outcome = calibrated(relit, folder)
    assert (outcome.code, outcome.err) == (0, ""), outcome.err
    assert "% of depth" in outcome.out
    tilt, depth, tilts, depths = errors(folder)
    assert tilt.max() < 0.3 and depth.max() < 0.01
    assert tilts.max() < 3 and depths.max() < 3


def test_a_block_that_leans_is_within_what_is_said(relit, tmp_path):
    """Two standard deviations of the angle: depths are off by about one in a hundred."""
    folder = photograph(tmp_path / "step", Step(lean=0.5), PLANES)
    assert calibrated(relit, folder).code == 0
    _, depth, tilts, depths = errors(folder)
    assert 0.004 < depth.max() < 0.015 and tilts.max() < 3 and depths.max() < 3


def test_several_poses_and_a_scan(relit, tmp_path):
    """What three poses tell together measures a scene of another one."""
    poses = [{}, {"elevation": 50.0, "turn": -12.0}, {"elevation": 34.0, "turn": 18.0, "distance": 0.65}]
    folders = [photograph(tmp_path / f"pose{number}", Step(**pose), PLANES, seed=number) for number, pose in enumerate(poses)]
    step = Step(elevation=45.0, distance=0.6)
    scan = photograph(tmp_path / "scan", step, PLANES, seed=9)
    assert calibrated(relit, *folders, "--apply-to", scan).code == 0
    tilt, depth, tilts, depths = errors(folders[0])
    assert tilt.max() < 0.15 and depth.max() < 0.004 and max(tilts.max(), depths.max()) < 3
    report = json.loads((folders[0] / "calibration.json").read_text())["laser-planes"]
    assert len(report["steps"]) == 3 and all(one["poses"] == 3 for one in report["planes"])
    maps, *_ = relit.depth(scan, "--device", "cpu")
    truth = -step.seen(reference.pixel_rays(CAMERA))[..., 2]
    error = np.abs(maps.depth - truth)[maps.mask]
    assert maps.mask.sum() > 1000 and np.median(error) < 0.002


def test_poses_tell_a_camera_that_was_refocused(relit, tmp_path):
    """Focal lengths of the manifest 4 % too long: planes were 4 % of the depth off, at 60 standard errors, without a word."""
    poses = [{}, {"elevation": 50.0, "turn": -12.0}, {"elevation": 34.0, "turn": 18.0, "distance": 0.65}]
    folders = [photograph(tmp_path / f"pose{number}", Step(**pose), PLANES, seed=number) for number, pose in enumerate(poses)]
    outcome = calibrated(relit, *folders)
    assert outcome.code == 0 and "focal_px" not in outcome.out
    for folder in folders:
        edit_manifest(folder, camera=lambda camera: {**camera, "focal_px": [1.04 * value for value in camera["focal_px"]]})
    outcome = calibrated(relit, *folders)
    report = json.loads((folders[0] / "calibration.json").read_text())["laser-planes"]
    assert outcome.code == 0 and "camera: the stripes of all poses fit best with 0.9" in outcome.out
    assert report["focal_by_steps"][0] == pytest.approx(1 / 1.04, abs=4 * report["focal_by_steps"][1])
    assert all(entry["sigma_degrees"] > 0.2 for entry in report["planes"])  # what the two cameras' planes differ by


def test_what_does_not_determine_planes_is_refused(relit, tmp_path):
    folder = photograph(tmp_path / "step", Step(), PLANES)
    before = (folder / "capture.json").read_bytes()

    def refused(*words, step=("--step-m", HEIGHT)):
        return relit.refused("calibrate", "laser-planes", *words, *step, "--device", "cpu")

    assert "50: is 50 m, more than a step has: give metres, such as 0.05" in refused(folder, step=("--step-m", 50))
    assert "give --board and --square-m for a chessboard, or --step-m" in refused(folder, step=())
    assert "give --board and --square-m for a chessboard, or --step-m" in refused(folder, "--board", "9x6", "--square-m", 0.03)
    assert "--board and --square-m belong together" in refused(folder, "--board", "9x6", step=())
    assert "is one pose of the board" in refused(folder, "--board", "9x6", "--square-m", 0.03, step=())
    above = photograph(tmp_path / "above", Step(elevation=84.0), PLANES)
    assert "let the camera and the laser see one upright face" in refused(above)
    beside = photograph(tmp_path / "beside", Step(width=-1.0), PLANES)  # no block
    assert "its stripe is not seen to cross base, block and base" in refused(beside)
    one = json.loads(before)["frames"]
    edit_manifest(folder, frames=[one[0], one[-1]])
    assert "1 of its 1 stripes show base, riser and top" in refused(folder)
    assert not (folder / "calibration.json").exists()
