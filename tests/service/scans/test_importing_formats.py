"""relit import scans: points as other programs and scanners write them become scans, and keep their places and colours."""

import json

import numpy as np
import pye57
import pytest
from scipy.spatial.transform import Rotation

from stage.formats.las import write_las
from stage.formats.ply import read_ply

CORNER = np.array([[0.0, 0, 0], [1.25, 0, 0], [0, 2.5, 0], [0, 0, 0.125], [1, 2, 0.5]])
COLOURS = np.array([[255, 0, 10], [0, 20, 30], [1, 2, 3], [4, 5, 6], [7, 8, 9]], dtype=np.uint8)
POSE = np.eye(4)
POSE[:3, :3], POSE[:3, 3] = Rotation.from_euler("xyz", [10, 20, 30], degrees=True).as_matrix(), [4.0, 5, 6]


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "points"
    folder.mkdir()
    return folder


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
def test_points_of_other_programs_become_scans(relit, tmp_path, folder, name, content, coloured):
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    relit.done("import", "scans", folder, tmp_path / "set", "--unit", "cm")
    cloud = read_ply(tmp_path / "set" / "a.ply")
    assert cloud.points == pytest.approx(CORNER / 100, rel=1e-6)  # float32
    assert not coloured or (cloud.colours == COLOURS).all()
    assert f"relit import scans {folder} SCAN_SET" in relit.done("import", "guess", folder).out
    assert "are converted" in relit.refused("import", "scans", folder)


def test_scanners_of_ptx_and_pcd_files_keep_their_places(relit, tmp_path, folder):
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


def test_scanners_of_e57_files_keep_their_places(relit, tmp_path, folder):
    write_e57(folder / "hall.e57", (CORNER, [1.0, 0, 0, 0], [0.0, 0, 0]), (CORNER + 1, [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [5.0, 6, 7]))
    assert f"relit import scans {folder} SCAN_SET" in relit.done("import", "guess", folder).out
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    assert "as the files say" in said and "2 from their files" in said
    first, second = json.loads((tmp_path / "set" / "scan-set.json").read_text())["scans"]
    assert first["viewpoint_m"] == second["viewpoint_m"] == [0, 0, 0]
    assert np.array(second["scan_to_world"]) == pytest.approx(  # a quarter about z
        np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]), abs=1e-12)
    cloud = read_ply(tmp_path / "set" / second["path"])
    assert cloud.points == pytest.approx(CORNER + 1) and (cloud.colours == COLOURS).all()
    assert "E57 files are in metres" in relit.refused("import", "scans", folder, tmp_path / "other", "--unit", "mm")


def test_spherical_coordinates_of_e57_files_are_those_of_the_standard(relit, tmp_path, folder, monkeypatch):
    """pye57 writes no spherical coordinates, so what it reads is put in their place: range, azimuth from x, elevation from the plane."""
    write_e57(folder / "a.e57", (CORNER + 1, [1.0, 0, 0, 0], [0.0, 0, 0]))
    x, y, z = (CORNER + 1).T
    values = {"sphericalRange": np.sqrt(x * x + y * y + z * z), "sphericalAzimuth": np.arctan2(y, x),
              "sphericalElevation": np.arctan2(z, np.hypot(x, y)),
              **{f"color{name}": COLOURS[:, number] for number, name in enumerate(("Red", "Green", "Blue"))}}
    monkeypatch.setattr(pye57.E57, "read_scan", lambda *_, **__: values)
    relit.done("import", "scans", folder, tmp_path / "set")
    assert read_ply(tmp_path / "set" / "a.ply").points == pytest.approx(CORNER + 1, rel=1e-6)


def test_without_pye57_the_extra_is_named(relit, tmp_path, folder, monkeypatch):
    (folder / "a.e57").write_bytes(b"ASTM-E57")
    assert "a.e57: is no E57 file" in relit.refused("import", "scans", folder, tmp_path / "set")
    monkeypatch.setattr("stage.formats.e57.find_spec", lambda name: None)
    assert "pip install 'relit[e57]'" in relit.refused("import", "scans", folder, tmp_path / "set")


def test_points_on_a_map_are_counted_from_among_them(relit, tmp_path, folder):
    """LAS has millimetres of places half a million metres away, which floats of 32 bits hold to 3 cm."""
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
def test_what_is_wrong_with_points_is_said(relit, tmp_path, folder, name, content, named):
    (folder / name).write_bytes(content)
    said = relit.refused("import", "scans", folder, tmp_path / "set")
    assert name in said and named in said
    assert not (tmp_path / "set" / "scan-set.json").exists()
