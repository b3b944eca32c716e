"""Tracks and scans: poses between poses, shots to points, and files that are refused."""

import json

import numpy as np
import pytest

from stage.errors import ImageError, ManifestError
from stage.tof.scan import Pose, directions, poses_at, read_scan, world_points
from tests.reference.tof import LIGHT

STILL = np.eye(4)


def turned(degrees, place=(0, 0, 0)):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    matrix = np.eye(4)
    matrix[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    matrix[:3, 3] = place
    return matrix


def pose(time_s, matrix):
    return Pose(time_s=time_s, world_from_platform=tuple(map(tuple, matrix.tolist())))


def folder_of(path, values, **more):
    np.save(path / "shots.npy", values)
    (path / "scan.json").write_text(json.dumps({"schema": "relit.scan/1", "name": "yard", "shots": "shots.npy", **more}))
    return path


@pytest.mark.parametrize("end", [40.0, 179.0, -170.0])
def test_a_constant_turn_is_constant_between_poses(end):
    rotation, place, covered = poses_at((pose(1.0, turned(0)), pose(3.0, turned(end, (2, 0, 0)))), np.array([1.0, 1.5, 2.0, 3.0, 3.5]))
    for k, part in enumerate((0, 0.25, 0.5, 1, 1)):
        np.testing.assert_allclose(rotation[k], turned(end * part)[:3, :3], atol=1e-9)
        np.testing.assert_allclose(place[k], (2 * part, 0, 0))
    assert list(covered) == [True, True, True, True, False]


def test_one_pose_covers_all_times_and_half_turns_are_found():
    rotation, _, covered = poses_at((pose(0.0, turned(180)),), np.array([-5.0, 5.0]))
    np.testing.assert_allclose(rotation[1], turned(180)[:3, :3], atol=1e-9)
    assert covered.all()
    rotation, _, _ = poses_at((pose(0.0, turned(180)), pose(1.0, turned(180))), np.array([0.3]))
    np.testing.assert_allclose(rotation[0], turned(180)[:3, :3], atol=1e-9)


def test_directions_are_a_cameras():
    np.testing.assert_allclose(directions(np.array([0, np.pi / 2, 0]), np.array([0, 0, np.pi / 2])),
                               [[0, 0, -1], [1, 0, 0], [0, 1, 0]], atol=1e-12)


def test_a_moving_scanner_sees_the_room_where_it_is(tmp_path):
    """A box of 8 x 6 x 10 m around a platform that drives and turns, every range by intersecting its walls."""
    rng = np.random.default_rng(0)
    n = 4000
    time_s = np.sort(rng.uniform(0, 10, n))
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rng.uniform(-1.2, 1.2, n)
    start, end = turned(0, (-1, 0, 1)), turned(120, (1, 0.5, -1))
    mount = turned(30, (0.1, 0.4, 0))
    part = time_s / 10
    origin, ray = np.empty((n, 3)), np.empty((n, 3))
    for k in range(n):
        world = turned(120 * part[k], np.array([-1, 0, 1]) * (1 - part[k]) + np.array([1, 0.5, -1]) * part[k]) @ mount
        local = np.array([np.sin(azimuth[k]) * np.cos(elevation[k]), np.sin(elevation[k]), -np.cos(azimuth[k]) * np.cos(elevation[k])])
        origin[k], ray[k] = world[:3, 3], world[:3, :3] @ local
    half = np.array([4.0, 3.0, 5.0])
    with np.errstate(divide="ignore"):
        distance = np.where(ray > 0, (half - origin) / ray, (-half - origin) / ray).min(axis=1)
    shots = np.stack([time_s, azimuth, elevation, distance, np.full(n, 7.0)], axis=1)
    track = [{"time_s": 0, "world_from_platform": start.tolist()}, {"time_s": 10, "world_from_platform": end.tolist()}]
    read = read_scan(folder_of(tmp_path, shots, track=track, platform_from_scanner=mount.tolist()))
    points, covered = world_points(read, np.arange(n), read.range_m)
    assert covered.all()
    np.testing.assert_allclose(np.abs(points / half).max(axis=1), 1, atol=1e-9)
    np.testing.assert_allclose(points, origin + ray * distance[:, None], atol=1e-9)


@pytest.mark.parametrize(("shots", "more", "error", "message"), [
    (np.ones((3, 4)), {}, ImageError, "expected (shots, 5)"),
    (np.full((3, 5), np.nan), {}, ImageError, "not finite"),
    (np.ones((3, 5)), {"track": []}, ManifestError, "track"),
    (np.ones((3, 5)), {"track": [{"time_s": 1, "world_from_platform": STILL.tolist()}] * 2}, ManifestError, "out of order: pose 1"),
    (np.ones((3, 5)), {"shots": "../shots.npy"}, ManifestError, "leads out"),
    (np.ones((3, 3)), {"waveforms": {"file": "w.npy", "bin_s": 0}}, ManifestError, "bin_s"),
    (np.ones((3, 3)), {"waveforms": {"file": "w.npy", "bin_s": 1e-9, "first_photon_only": True}}, ManifestError, "pulses is missing"),
    (np.ones((3, 3)), {"waveforms": {"file": "w.npy", "bin_s": 1e-9}}, ImageError, "expected (3, bins)"),
])
def test_bad_scans_are_refused(shots, more, error, message, tmp_path):
    np.save(tmp_path / "w.npy", np.ones((2, 9)))
    folder_of(tmp_path, shots, **more)
    with pytest.raises(error) as caught:
        read_scan(tmp_path)
    assert message in str(caught.value)


def test_a_folder_without_a_scan_is_refused(tmp_path):
    with pytest.raises(ManifestError, match=r"holds no scan\.json"):
        read_scan(tmp_path)


def test_light_is_as_fast_as_in_the_reference():
    from stage.tof import light_time

    assert light_time.SPEED_OF_LIGHT == LIGHT
