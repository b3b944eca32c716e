"""relit import scans: PLY files as they come are registered with nothing written by hand; files do not say where the scanner stood."""

import json
from pathlib import Path

import numpy as np
import pye57
import pytest
from scipy.spatial.transform import Rotation

from service.scans.points.rigid import inverse
from service.scans.viewpoints import find_viewpoints
from stage.formats.las import write_las
from stage.formats.ply import PointCloud, read_ply, write_ply
from tests.scenes.turntable import DISTANCE_M, View, figure, turntable
from tests.service.scans.test_register import off

ANGLES = [0.0, 40.0, 80.0, 120.0, 160.0, 200.0, 240.0, 280.0, 320.0]
SHIFT = np.array([0.02, -0.05, DISTANCE_M])
"""From the camera's frame to one whose origin lies within the figure."""


@pytest.fixture(scope="module")
def views() -> list[View]:
    return turntable(figure, ANGLES, rows=120)


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


def test_poses_of_a_conf_file_and_what_is_wrong_with_it(relit, tmp_path, views):
    folder = write(tmp_path / "scans", [points_of(view) for view in views[:2]])
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
def test_a_missing_viewpoint_whose_origin_lies_among_the_points_is_told(relit, tmp_path, views):
    folder = write(tmp_path / "scans", [points_of(view) for view in views[:2]])
    (folder / "scan-set.json").write_text(json.dumps({"schema": "relit.scan-set/1", "name": "figure", "scans": [
        {"name": f"s{number}", "path": f"scan_{24 * number}.ply"} for number in range(2)]}))
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


def test_rotations_off_orthonormal_are_made_rotations_and_said(relit, tmp_path, views):
    """Scan sets, PTX files and .conf files are treated alike; stretches of a thousandth and more are no poses."""
    folder = write(tmp_path / "scans", [points_of(view) for view in views[:2]])
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


CORNER = np.array([[0.0, 0, 0], [1.25, 0, 0], [0, 2.5, 0], [0, 0, 0.125], [1, 2, 0.5]])
COLOURS = np.array([[255, 0, 10], [0, 20, 30], [1, 2, 3], [4, 5, 6], [7, 8, 9]], dtype=np.uint8)
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), [4.0, 5, 6]


def rows(*columns: np.ndarray) -> str:
    return "".join(" ".join(f"{value:.10g}" for value in row) + "\n" for row in np.column_stack(columns))


def ptx(points: np.ndarray, pose: np.ndarray) -> str:
    """Return a scan of three columns and two rows with one place without a point, as Leica's Cyclone writes it: rows of the matrix are the
    axes of the scanner in the world, then its place."""
    place = " ".join(map(repr, pose[:3, 3].tolist()))
    return (f"3\n2\n{place}\n" + rows(pose[:3, :3].T) + rows(pose.T)
            + rows(np.vstack([points, np.zeros(3)]), np.full(6, 0.5), np.vstack([COLOURS, [0] * 3])))


def pcd(points: np.ndarray, data: str, viewpoint: str) -> bytes:
    """Return a cloud as the Point Cloud Library writes it, colours packed as 0x00RRGGBB in a float."""
    packed = (COLOURS.astype(np.uint32) << [16, 8, 0]).sum(axis=1).astype("<u4")
    head = (f"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U U\nCOUNT 1 1 1 3 1\nWIDTH {len(points)}\n"
            f"HEIGHT 1\nVIEWPOINT {viewpoint} 1 0 0 0\nPOINTS {len(points)}\nDATA {data}\n").encode()
    if data == "ascii":
        return head + rows(points, np.zeros((len(points), 3)), packed).encode()
    values = np.zeros(len(points), dtype=[("p", "<f4", 3), ("_", "u1", 3), ("rgb", "<u4")])
    values["p"], values["rgb"] = points, packed
    return head + values.tobytes()


@pytest.mark.parametrize(("name", "content", "coloured"), [
    ("a.xyz", "# a comment\n" + rows(CORNER), False), ("a.asc", rows(CORNER, COLOURS).replace(" ", ","), True),
    ("a.xyz", "#x, y, z\n" + rows(CORNER).replace(".", ","), False),
    ("a.asc", rows(CORNER, COLOURS).replace(".", ",").replace(" ", "; "), True),
    ("a.xyz", rows(CORNER).replace(" ", ", "), False),
    ("a.xyz", "x y z\n" + rows(CORNER), False), ("a.xyz", "\ufeff" + rows(CORNER), False),
    ("a.xyz", '"X[m]","Y[m]","Z[m]","Intensity","R","G","B"\n' + rows(CORNER, np.full(5, 7), COLOURS).replace(" ", ","), True),
    ("a.asc", "//X Y Z R G B Label Nx Ny Nz\n" + rows(CORNER, COLOURS, np.full(5, 7), np.eye(3)[[0, 1, 2, 0, 1]]), True),
    ("a.xyz", "# number X Y Z\nid x y z\n" + rows(np.arange(5), CORNER), False),
    ("a.xyz", rows(CORNER, COLOURS, np.full(5, 255)), True), ("a.xyz", rows(CORNER, np.full(5, 300), COLOURS / 255), True),
    ("a.xyz", rows(CORNER, np.full(5, 7), COLOURS), True), ("a.pts", "5\n" + rows(CORNER, np.full(5, -900), COLOURS), True),
    ("a.pcd", pcd(CORNER, "ascii", "0 0 0"), True), ("a.pcd", pcd(CORNER, "binary", "0 0 0"), True)])
def test_points_of_other_programs_become_scans(relit, tmp_path, name, content, coloured):
    folder = tmp_path / "points"
    folder.mkdir()
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    relit.done("import", "scans", folder, tmp_path / "set", "--unit", "cm")
    cloud = read_ply(tmp_path / "set" / "a.ply")
    assert cloud.points == pytest.approx(CORNER / 100, rel=1e-6)  # float32
    assert not coloured or (cloud.colours == COLOURS).all()
    assert f"relit import scans {folder}" in relit.done("import", "guess", folder).out
    assert "are converted" in relit.refused("import", "scans", folder)


def test_scanners_of_ptx_and_pcd_files_keep_their_places(relit, tmp_path):
    folder = tmp_path / "points"
    folder.mkdir()
    (folder / "tower.ptx").write_text(ptx(CORNER + 1, np.eye(4)) + ptx(CORNER + 1, POSE))
    (folder / "tower.pcd").write_bytes(pcd(CORNER + 1, "binary", "1 2 3"))
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    assert "as the files say" in said and "2 from their files" in said
    scans = {scan["name"]: scan for scan in json.loads((tmp_path / "set" / "scan-set.json").read_text())["scans"]}
    assert scans["tower"]["viewpoint_m"] == [1, 2, 3] and "scan_to_world" not in scans["tower"]
    assert scans["tower-2"]["viewpoint_m"] == [0, 0, 0]
    assert np.array(scans["tower-2"]["scan_to_world"]) == pytest.approx(POSE, abs=1e-9)  # ten digits in the file
    assert read_ply(tmp_path / "set" / "tower-2.ply").points == pytest.approx(CORNER + 1)


def write_e57(path, *scans):
    """Scans of points, with a quaternion (w first) and a translation each, and colours."""
    with pye57.E57(str(path), mode="w") as file:
        for points, quaternion, translation in scans:
            values = {f"cartesian{axis}": np.ascontiguousarray(points[:, number]) for number, axis in enumerate("XYZ")}
            values |= {f"color{name}": np.ascontiguousarray(COLOURS[:, number]) for number, name in enumerate(("Red", "Green", "Blue"))}
            file.write_scan_raw(values, rotation=np.array(quaternion), translation=np.array(translation))


def test_scanners_of_e57_files_keep_their_places(relit, tmp_path):
    folder = tmp_path / "points"
    folder.mkdir()
    write_e57(folder / "hall.e57", (CORNER, [1.0, 0, 0, 0], [0.0, 0, 0]), (CORNER + 1, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [5.0, 6, 7]))
    assert f"relit import scans {folder}" in relit.done("import", "guess", folder).out
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    assert "as the files say" in said and "2 from their files" in said
    first, second = json.loads((tmp_path / "set" / "scan-set.json").read_text())["scans"]
    assert first["viewpoint_m"] == second["viewpoint_m"] == [0, 0, 0]
    assert np.array(second["scan_to_world"]) == pytest.approx(  # a quarter about z
        np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]), abs=1e-12)
    cloud = read_ply(tmp_path / "set" / second["path"])
    assert cloud.points == pytest.approx(CORNER + 1) and (cloud.colours == COLOURS).all()
    assert "E57 files are in metres" in relit.refused("import", "scans", folder, tmp_path / "other", "--unit", "mm")


def test_spherical_coordinates_of_e57_files_are_those_of_the_standard(relit, tmp_path, monkeypatch):
    """pye57 writes no spherical coordinates, so what it reads is put in their place: range, azimuth from x, elevation from the plane."""
    folder = tmp_path / "points"
    folder.mkdir()
    write_e57(folder / "a.e57", (CORNER + 1, [1.0, 0, 0, 0], [0.0, 0, 0]))
    x, y, z = (CORNER + 1).T
    values = {"sphericalRange": np.sqrt(x * x + y * y + z * z), "sphericalAzimuth": np.arctan2(y, x),
              "sphericalElevation": np.arctan2(z, np.hypot(x, y)),
              **{f"color{name}": COLOURS[:, number] for number, name in enumerate(("Red", "Green", "Blue"))}}
    monkeypatch.setattr(pye57.E57, "read_scan", lambda *_, **__: values)
    relit.done("import", "scans", folder, tmp_path / "set")
    assert read_ply(tmp_path / "set" / "a.ply").points == pytest.approx(CORNER + 1, rel=1e-6)


def test_without_pye57_the_extra_is_named(relit, tmp_path, monkeypatch):
    folder = tmp_path / "points"
    folder.mkdir()
    (folder / "a.e57").write_bytes(b"ASTM-E57")
    assert "a.e57: is no E57 file" in relit.refused("import", "scans", folder, tmp_path / "set")
    monkeypatch.setattr("stage.formats.e57.find_spec", lambda name: None)
    assert "pip install 'relit[e57]'" in relit.refused("import", "scans", folder, tmp_path / "set")


def test_points_on_a_map_are_counted_from_among_them(relit, tmp_path):
    """LAS has millimetres of places half a million metres away, which floats of 32 bits hold to 3 cm."""
    folder = tmp_path / "points"
    folder.mkdir()
    far, flat = np.array([512345.0, 5412345.0, 431.0]), np.zeros(5)
    for number in range(2):
        write_las(CORNER + far + number, flat, flat, np.arange(5), flat, folder / f"s{number}.las")
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    moved = np.array([float(value) for value in said.split("is moved to ")[1].split()[0].split(",")])
    for number in range(2):
        cloud = read_ply(tmp_path / "set" / f"s{number}.ply")
        assert cloud.points + (moved - far) == pytest.approx(CORNER + number, abs=2e-4)  # units of a LAS file are .1 mm


@pytest.mark.parametrize(("name", "content", "named"), [
    ("a.xyz", b"1 2\n3 4\n", "x, y and z"), ("a.xyz", b"1 2 3\n4 5\n", "as many numbers each where it has '4 5'"),
    ("a.xyz", b"east north up\n1 2 3\n", "'east north up'"), ("a.xyz", b"id x y z\n1 2 3\n", "4 columns in its heading (id x y z) and 3"),
    ("a.xyz", b"", "without points"),
    ("a.pts", b"3\n1 2 3\n", "1 of 3"), ("a.pts", b"x y\n1 2 3\n", "whole number"), ("a.ptx", b"1\n1\n0 0 0\n", "header"),
    ("a.ptx", ptx(CORNER, np.diag([2.0, 2, 2, 1])).encode(), "no rotation"),
    ("a.ptx", ptx(CORNER, POSE).rsplit("\n", 2)[0].encode(), "truncated"),
    ("a.pcd", b"DATA binary\n", "header"), ("a.pcd", pcd(CORNER, "binary_compressed", "0 0 0"), "ascii or binary"),
    ("a.pcd", pcd(CORNER, "binary", "0 0 0")[:-4], "truncated"), ("a.las", b"LAS?", "LAS")])
def test_what_is_wrong_with_points_is_said(relit, tmp_path, name, content, named):
    folder = tmp_path / "points"
    folder.mkdir()
    (folder / name).write_bytes(content)
    said = relit.refused("import", "scans", folder, tmp_path / "set")
    assert name in said and named in said
    assert not (tmp_path / "set" / "scan-set.json").exists()
