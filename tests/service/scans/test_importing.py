"""relit import scans: PLY files as they come are registered with nothing written by hand; files do not say where the scanner stood."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.scans.points.rigid import inverse
from service.scans.viewpoints import find_viewpoints
from stage.formats.ply import PointCloud, write_ply
from tests.scenes.statue import write_set
from tests.scenes.turntable import DISTANCE_M, View, figure, turntable
from tests.service.scans.test_importing_formats import CORNER, POSE, ptx
from tests.service.scans.test_register import off

ANGLES = [0.0, 40.0, 80.0, 120.0, 160.0, 200.0, 240.0, 280.0, 320.0]
SHIFT = np.array([0.02, -0.05, DISTANCE_M])
"""From the camera's frame to one whose origin lies within the figure."""


@pytest.fixture(scope="module")
def views() -> list[View]:
    return turntable(figure, ANGLES, rows=120)


@pytest.fixture(scope="module")
def two() -> list[View]:
    """The first of them."""
    return turntable(figure, ANGLES[:2], rows=120)


def points_of(view: View) -> np.ndarray:
    """[n, 3] of a scan in a frame of the device, whose origin lies within the figure."""
    return view.camera.points(-view.depth)[view.mask].astype(float) + SHIFT


def write(folder: Path, clouds: list[np.ndarray], normals: list[np.ndarray] | None = None) -> Path:
    folder.mkdir()
    for number, points in enumerate(clouds):
        write_ply(PointCloud(points.astype(np.float32), np.zeros((len(points), 3), dtype=np.uint8),
                             None if normals is None else normals[number].astype(np.float32)), folder / f"scan_{24 * number}.ply")
    return folder


def degrees_off(place: np.ndarray, scans: list[np.ndarray], truth: np.ndarray) -> np.ndarray:
    direction = place - [points.mean(axis=0) for points in scans]
    return np.degrees(np.arccos(np.clip((direction * truth).sum(axis=-1) / np.linalg.norm(direction, axis=-1), -1, 1)))


@pytest.mark.long
def test_a_turntable_whose_origin_lies_within_the_object(relit, tmp_path, views):
    """Millimetres, and no pose is known."""
    views = views[::2]
    folder = write(tmp_path / "scans", [1000 * points_of(view) for view in views])
    said = relit.done("import", "scans", folder, tmp_path / "set", "--unit", "mm")
    assert 0.8 < float(said.out.split("size")[1].split()[0]) < 1.2  # metres
    relit.done("register", tmp_path / "set", "--out", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert all(scan["joined"] for scan in report["scans"])
    shifted = [view._replace(world_from_scan=view.world_from_scan @ inverse(_moved(SHIFT))) for view in views]
    assert all(metres < 0.001 and degrees < 0.2 for metres, degrees in off(tmp_path / "out", shifted).values())  # as with given viewpoints


def _moved(shift: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = shift
    return pose


@pytest.mark.long
def test_the_direction_to_the_scanner(views):
    scans = [points_of(view) for view in views]
    towards = np.array([(SHIFT - points.mean(axis=0)) / np.linalg.norm(SHIFT - points.mean(axis=0)) for points in scans])
    nothing = [None] * len(scans)
    found = find_viewpoints(scans, nothing)
    assert degrees_off(found.place, scans, towards).max() < 15  # a scanner at 2.5 extents is taken to be far away

    # the same with the poses applied: each scan has a direction of its own
    poses = [view.world_from_scan @ inverse(_moved(SHIFT)) for view in views]
    world = [points @ pose[:3, :3].T + pose[:3, 3] for points, pose in zip(scans, poses, strict=True)]
    found = find_viewpoints(world, nothing)
    turned = np.einsum("nij,nj->ni", np.array(poses)[:, :3, :3], towards)
    assert degrees_off(found.place, world, turned).max() < 35

    # and in the frame of the camera, whose origin is the scanner
    found = find_viewpoints([points - SHIFT for points in scans], nothing)
    assert not found.place.any() and found.spread_degrees == 0


@pytest.mark.long
def test_a_flat_wall_has_two_sides_unless_its_normals_tell():
    random = np.random.default_rng(3)
    wall = np.column_stack([random.uniform(-1, 1, (3000, 2)), 0.002 * random.normal(size=3000)])
    found = find_viewpoints([wall, wall], [None, None])
    assert found.place is None and "side" in found.reason
    normals = np.tile([0.0, 0.0, -1.0], (3000, 1))
    found = find_viewpoints([wall, wall], [normals, normals])
    assert degrees_off(found.place, [wall, wall], np.array([0.0, 0.0, -1.0])).max() < 5


def test_a_body_seen_from_all_around_is_no_scan():
    random = np.random.default_rng(4)
    ball = random.normal(size=(4000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    found = find_viewpoints([ball], [None])
    assert found.place is None and "one place" in found.reason


def test_poses_of_a_conf_file_and_what_is_wrong_with_it(relit, tmp_path, two):
    folder = write(tmp_path / "scans", [points_of(view) for view in two])
    turn = Rotation.from_euler("y", 24, degrees=True)
    lines = ["camera 0 0 0 0 0 0 1", "bmesh scan_0.ply 0 0 0 0 0 0 1",
             f"bmesh scan_24.ply 0.1 0.2 0.3 {' '.join(map(str, turn.inv().as_quat()))}"]
    (folder / "scans.conf").write_text("\n".join(lines))
    relit.done("import", "scans", folder, tmp_path / "set", "--viewpoint", "0,0,9")
    scans = json.loads((tmp_path / "set" / "scan-set.json").read_text())["scans"]
    assert [scan["viewpoint_m"] for scan in scans] == [[0, 0, 9]] * 2
    pose = np.array(scans[1]["scan_to_world"])
    assert pose[:3, :3] == pytest.approx(turn.as_matrix()) and pose[:3, 3] == pytest.approx([0.1, 0.2, 0.3])

    for line, words in (("bmesh scan_0.ply 0 0 0 0 0 0", "line 1"), ("bmesh scan_0.ply 0 0 0 9 0 0 1", "line 1"),
                        ("camera 0", "names no scans")):
        (folder / "scans.conf").write_text(line)
        assert words in relit.refused("import", "scans", folder, tmp_path / "other")
    (tmp_path / "none").mkdir()
    assert "neither point files" in relit.refused("import", "scans", tmp_path / "none")
    (folder / "scans.conf").unlink()
    (folder / "scan_0.ply").write_bytes(b"not a cloud")
    assert "scan_0.ply" in relit.refused("import", "scans", folder, tmp_path / "other")
    assert not (tmp_path / "other").exists()


@pytest.mark.long
def test_a_missing_viewpoint_whose_origin_lies_among_the_points_is_told(relit, tmp_path, two):
    folder = write(tmp_path / "scans", [points_of(view) for view in two])
    write_set(folder, [{"name": f"s{number}", "path": f"scan_{24 * number}.ply"} for number in range(2)])
    relit("register", folder, "--out", tmp_path / "out")
    said = json.loads((tmp_path / "out" / "report.json").read_text())["warnings"] if (tmp_path / "out" / "report.json").exists() else []
    assert any("s0, s1: viewpoint_m is missing" in warning for warning in said)


def test_one_point_is_no_scan(relit, tmp_path):
    folder = write(tmp_path / "scans", [np.ones((1, 3))])
    assert "scan_0.ply: holds 1 different point:" in relit.refused("import", "scans", folder, tmp_path / "set")
    (folder / "scan_0.ply").unlink()
    (folder / "a.xyz").write_text("1 2 3\n" * 9)
    assert "a.xyz: holds 1 different point:" in relit.refused("import", "scans", folder, tmp_path / "set")


def test_a_scan_that_begins_with_empty_places_is_one(relit, tmp_path):
    """Organised clouds hold zeros where nothing was seen, whole rows of them at the border."""
    cloud = np.random.default_rng(1).normal(0, 0.1, (500, 3)) + [0, 0, 1]
    folder = write(tmp_path / "scans", [np.concatenate([np.zeros((2000, 3)), cloud])])
    relit("import", "scans", folder, tmp_path / "set")
    assert (tmp_path / "set" / "scan-set.json").is_file()
    assert find_viewpoints([np.ones((1, 3))], [None]).place is None


def test_sizes_that_ask_for_another_unit_are_asked_about(relit, tmp_path):
    """An object of 100 units, and two scans of one object of which one is a thousand times as large."""
    random = np.random.default_rng(5)
    slab = np.vstack([random.uniform(0, 1, (400, 3)) * [1, 0.7, 0.01], [[0.0, 0, 0], [1, 0, 0]]])
    said = relit.done("import", "scans", write(tmp_path / "large", [100 * slab]), tmp_path / "a").out
    assert "is its unit m? give --unit" in said and "mm (0." in said and "cm" in said
    assert "warning" not in relit.done("import", "scans", tmp_path / "large", tmp_path / "b", "--unit", "mm").out
    said = relit.done("import", "scans", write(tmp_path / "mixed", [slab, 1000 * slab]), tmp_path / "c").out
    assert "scan_24 is" in said and "scan_0 1 m: are they in one unit?" in said


@pytest.mark.parametrize(("of_first", "of_second", "asked"), [(1, 1 / 39.37, True), (1, 2 / 25.4, True), (1, 1 / 5, False)])
def test_a_scan_in_inches_among_others_is_asked_about(relit, tmp_path, of_first, of_second, asked):
    """Inches among metres; inches among millimetres, of which that scan saw twice as much; and a scan of a fifth of the object."""
    slab = np.vstack([np.random.default_rng(5).uniform(0, 1, (400, 3)) * [1, 0.7, 0.01], [[0.0, 0, 0], [1, 0, 0]]])
    said = relit.done("import", "scans", write(tmp_path / "mixed", [of_first * slab, of_second * slab]), tmp_path / "set").out
    assert ("are they in one unit?" in said) == asked


def test_rotations_off_orthonormal_are_made_rotations_and_said(relit, tmp_path, two):
    """Scan sets, PTX files and .conf files are treated alike; stretches of a thousandth and more are no poses."""
    folder = write(tmp_path / "scans", [points_of(view) for view in two])
    turn = Rotation.from_euler("xyz", [5, 24, -8], degrees=True)
    quaternion = (1 + 1.6e-4) * turn.inv().as_quat()
    (folder / "scans.conf").write_text(f"camera 0 0 0 0 0 0 1\nmesh scan_0.ply 0 0 0 0 0 0 1\n"
                                       f"bmesh scan_24.ply 0 0 1 {' '.join(map(str, quaternion))}\nbye\n")
    said = relit.done("import", "scans", folder, tmp_path / "set", "--viewpoint", "0,0,9").out
    assert "off orthonormal by up to 0.0006" in said
    data = json.loads((tmp_path / "set" / "scan-set.json").read_text())
    pose = np.array(data["scans"][1]["scan_to_world"])
    assert pose[:3, :3] == pytest.approx(turn.as_matrix(), abs=1e-12)

    pose[:3, :3] *= 1.00016
    data["scans"][1]["scan_to_world"] = pose.tolist()
    (tmp_path / "set" / "scan-set.json").write_text(json.dumps(data))
    outcome = relit("register", tmp_path / "set", "--out", tmp_path / "out")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "rotation of scan_to_world is off orthonormal by up to 0.0003" in report["warnings"][0]
    assert outcome.code == 0 or "Traceback" not in outcome.err
    pose[:3, :3] *= 1.001
    data["scans"][1]["scan_to_world"] = pose.tolist()
    (tmp_path / "set" / "scan-set.json").write_text(json.dumps(data))
    assert "scan_to_world: is not a rotation" in relit.refused("register", tmp_path / "set", "--out", tmp_path / "none")

    (tmp_path / "tower").mkdir()
    stretched = POSE @ np.diag([1.0002, 1, 1, 1])
    (tmp_path / "tower" / "a.ptx").write_text(ptx(CORNER + 1, stretched))
    assert "off orthonormal by up to 0.000" in relit.done("import", "scans", tmp_path / "tower", tmp_path / "ptx").out
    pose = np.array(json.loads((tmp_path / "ptx" / "scan-set.json").read_text())["scans"][0]["scan_to_world"])
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
