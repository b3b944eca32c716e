"""Boards under a laser that are not as they should be: one that moves between the frames of a pose, and one that shows a second stripe."""

import json

import numpy as np
import pytest

from stage.capture.capture import Capture
from tests.reference import projector as reference
from tests.scenes.in_front import unit
from tests.service.calibrate.solvers.test_procam import CAMERA, board_image
from tests.service.calibrate.test_laser_planes import PLANES, POSES, WIDTH, calibrated, written

pytestmark = pytest.mark.long


def board(pose):
    """Points [rows, cols, 3] of a board, and what it reflects."""
    rays = reference.pixel_rays(CAMERA)
    return rays * reference.plane_depth(rays, pose[:3, 3], pose[:3, 2])[..., None], board_image(pose)


def photograph(folder, pose, step_m=(0.0, 0.0, 0.0), second=0.0, aside_m=0.03):
    """A pose whose board lies `step_m` farther in each frame, under planes that have another `aside_m` beside them, `second` as bright."""
    random = np.random.default_rng(5)
    images = []
    for number, plane in enumerate([*PLANES, None]):
        moved = pose.copy()
        moved[:3, 3] += np.array(step_m) * (0 if plane is None else number + 1)
        points, albedo = board(moved)
        glow = 0.0
        for part, beside in ((1.0, 0.0), (second, aside_m)) if plane is not None else ():
            glow = glow + part * 0.6 * np.exp(-(((points - plane[0]) @ unit(plane[1]) - beside) ** 2) / (2 * WIDTH**2))
        images.append(np.maximum(albedo * (0.2 + glow) + random.normal(0, 0.002, albedo.shape), 0))
    return written(folder, images)


def check(folder, sigmas=3.0):
    """Planes are as far from the true ones as they say."""
    found = [frame.laser for frame in Capture.open(folder).manifest.frames if frame.laser is not None]
    for laser, (point, normal) in zip(found, PLANES, strict=True):
        assert np.degrees(np.arccos(min(1.0, abs(np.array(laser.normal) @ unit(normal))))) < sigmas * laser.accuracy_deg + 0.1
        assert abs((np.array(laser.point_m) - point) @ unit(normal)) < sigmas * laser.accuracy_m + 1e-4


@pytest.mark.parametrize("step_m", [(0.0, 0.0, -0.003), (0.0015, 0.001, 0.0)], ids=["away", "aside"])
def test_a_board_that_moves_counts_where_it_is(relit, tmp_path, step_m):
    """A board held by hand. Taken where the frame without the laser has it, moves of a millimetre a frame left planes 1 to 3 mm off, at
    up to 17 σ."""
    folders = [photograph(tmp_path / f"pose{number}", pose, step_m) for number, pose in enumerate(POSES)]
    outcome = calibrated(relit, folders)
    assert outcome.code == 0 and outcome.out.count("the board moves by") == len(folders), outcome
    entries = json.loads((folders[0] / "calibration.json").read_text())["laser-planes"]["boards"]
    assert all(entry["moved_px"] > 0.5 for entry in entries)
    check(folders[0])


def test_a_weak_second_stripe_leaves_the_plane(relit, tmp_path):
    """Where its squares are dark the laser is dimmer than a reflection of half of it on bright ones; the plane was refused for it, as if
    its stripes lay on one line."""
    folders = [photograph(tmp_path / f"pose{number}", pose, second=0.5) for number, pose in enumerate(POSES)]
    outcome = calibrated(relit, folders)
    assert outcome.code == 0, outcome
    check(folders[0])


def test_a_second_stripe_that_is_as_bright_is_named(relit, tmp_path):
    folders = [photograph(tmp_path / f"pose{number}", pose, second=0.9) for number, pose in enumerate(POSES)]
    assert "two stripes are about as bright" in calibrated(relit, folders).refused("two stripes")
