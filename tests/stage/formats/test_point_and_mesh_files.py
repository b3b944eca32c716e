"""Point clouds and meshes in LAS, PLY, STL and OBJ files."""

import json

import laspy
import numpy as np
import pytest

from stage.errors import ResultError, StorageError
from stage.formats.las import write_las
from stage.formats.ply import PointCloud, read_ply, write_ply
from stage.formats.triangles import read_triangles
from tests.scenes.machined_part import machined_part, write_stl

N = 500
RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(5, 3)).astype(np.float32)
COLOURS = RNG.integers(0, 256, (5, 3)).astype(np.uint8)
TETRAHEDRON = """v 0 0 0
v 1 0 0 0.5 0.5 0.5
v 0 1 0
v 0 0 1
vn 0 0 1
# a quadrilateral that is a triangle and a face without an area
f 1/1/1 3/2/1 2//1
f 1 2 4
f -4 -1 -2
f 2 3 4 4
"""


def cloud(seed=0, size=(40.0, 6.0, 25.0), centre=(0.0, 0.0, 0.0)):
    random = np.random.default_rng(seed)
    return np.array(centre) + (random.random((N, 3)) - 0.5) * size


def write(path, points, intensity=None, time_s=None, shot=None, range_m=None, **more):
    count = len(points)
    intensity = np.ones(count) if intensity is None else intensity
    time_s = np.arange(count, dtype=float) if time_s is None else time_s
    shot = np.arange(count) if shot is None else shot
    return write_las(points, intensity, time_s, shot, np.ones(count) if range_m is None else range_m, path, **more), laspy.read(path)


@pytest.mark.parametrize(("points", "scale_m"), [
    (cloud(), 1e-4),
    (cloud(centre=(5.1e5, 120.0, 5.4e6)), 1e-4),  # map coordinates, of which float32 would leave half a metre
    (cloud(size=(1e6, 10, 10)), 1e-3),  # 32 bits of tenths of a millimetre reach 215 km to each side
])
def test_places_are_kept_to_the_scale(points, scale_m, tmp_path):
    scales, las = write(tmp_path / "a.las", points)
    assert scales.scale_m == pytest.approx(scale_m)
    assert las.header.version == laspy.header.Version(1, 4) and las.header.point_count == N
    np.testing.assert_allclose(las.header.scales, scales.scale_m)
    np.testing.assert_allclose(las.header.offsets, scales.offset_m)
    np.testing.assert_allclose(las.xyz, points, atol=0.5 * scales.scale_m + 1e-9 * np.abs(points).max())  # half a step, and float64
    np.testing.assert_allclose(las.header.mins, points.min(axis=0), atol=scales.scale_m)


def test_whole_intensities_are_kept_and_others_scaled(tmp_path):
    whole = np.arange(N) * 100.0
    scales, las = write(tmp_path / "a.las", cloud(), intensity=whole)
    assert scales.intensity_scale == 1
    np.testing.assert_array_equal(las.intensity, whole)
    parts = np.linspace(-0.1, 0.9, N)
    scales, las = write(tmp_path / "b.las", cloud(), intensity=parts, provenance={"relit:capture": "yard"})
    np.testing.assert_allclose(las.intensity * scales.intensity_scale, np.maximum(parts, 0), atol=0.5 * scales.intensity_scale * 1.001)
    notes = json.loads(las.vlrs.get_by_id("relit", (1,))[0].record_data)
    assert notes == {"intensity_scale": scales.intensity_scale, "relit:capture": "yard"}


def test_times_and_returns_are_those_of_the_shots(tmp_path):
    shot = np.array([0, 1, 1, 2, 1])
    range_m = np.array([5.0, 7.0, 3.0, 2.0, 4.0])
    time_s = 0.25 * shot + 1e5
    _, las = write(tmp_path / "a.las", cloud()[:5], shot=shot, range_m=range_m, time_s=time_s)
    np.testing.assert_array_equal(las.gps_time, time_s)
    assert list(las.return_number) == [1, 3, 1, 1, 2]
    assert list(las.number_of_returns) == [1, 3, 3, 1, 3]


def test_a_shot_of_many_returns_counts_to_fifteen(tmp_path):
    _, las = write(tmp_path / "a.las", cloud()[:20], shot=np.zeros(20, dtype=int), range_m=np.arange(20.0))
    assert las.return_number.max() == 15 and set(las.number_of_returns) == {15}


def test_equal_scans_make_equal_files_and_a_failed_one_leaves_nothing(tmp_path):
    for name in ("a.las", "b.las"):
        write(tmp_path / name, cloud())
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()
    (tmp_path / "full").touch()
    with pytest.raises(StorageError):
        write(tmp_path / "full" / "c.las", cloud())
    with pytest.raises(ResultError, match="no point"):
        write(tmp_path / "d.las", np.empty((0, 3)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.las", "b.las", "full"]


def test_the_layout_is_that_of_the_contract(tmp_path):
    write_ply(PointCloud(POINTS, COLOURS), tmp_path / "p.ply", comments=("made\nby a test",))
    header, body = (tmp_path / "p.ply").read_bytes().split(b"end_header\n", 1)
    assert header.decode().splitlines() == [
        "ply", "format binary_little_endian 1.0", "comment made by a test", "element vertex 5", "property float x", "property float y",
        "property float z", "property uchar red", "property uchar green", "property uchar blue"]
    assert body == b"".join(p.astype("<f4").tobytes() + c.tobytes() for p, c in zip(POINTS, COLOURS, strict=True))


@pytest.mark.parametrize("normals", [None, POINTS[::-1]])
def test_what_is_written_is_read(tmp_path, normals):
    write_ply(PointCloud(POINTS, COLOURS, normals), tmp_path / "p.ply")
    found = read_ply(tmp_path / "p.ply")
    assert (found.points == POINTS).all() and (found.colours == COLOURS).all()
    assert found.normals is None if normals is None else (found.normals == normals).all()


def test_no_point_is_a_file_too(tmp_path):
    write_ply(PointCloud(POINTS[:0], COLOURS[:0]), tmp_path / "p.ply")
    assert len(read_ply(tmp_path / "p.ply").points) == 0


def test_damage_is_named(tmp_path):
    path = tmp_path / "p.ply"
    write_ply(PointCloud(POINTS, COLOURS), path)
    whole = path.read_bytes()
    path.write_bytes(whole[:-1])
    with pytest.raises(ResultError, match="is truncated: it holds 4 of 5 points"):
        read_ply(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nend_header\n")
    with pytest.raises(ResultError, match="not a point cloud as relit writes it"):
        read_ply(path)


def ascii_stl(corners: np.ndarray) -> str:
    facets = "".join("facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in each.tolist())
                     + "endloop\nendfacet\n" for each in corners)
    return f"solid part\n{facets}endsolid part\n"


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = np.moveaxis(points[faces], 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


def test_stl_in_both_forms_is_one_mesh(tmp_path):
    part = machined_part(21, 11)
    binary = read_triangles(write_stl(tmp_path / "a.stl", part))
    text = tmp_path / "b.STL"
    text.write_text(ascii_stl(part.points[part.faces].astype(np.float32).astype(np.float64)))
    read = read_triangles(text)
    assert (read.points == binary.points).all() and (read.faces == binary.faces).all()
    assert len(read.points) == len(part.points) and len(read.faces) == len(part.faces)
    assert volume(*read) == pytest.approx(volume(*part), rel=1e-6)  # float32


def test_obj_with_polygons_and_numbers_from_the_end(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(TETRAHEDRON)
    read = read_triangles(path)
    assert len(read.faces) == 4 and volume(*read) == pytest.approx(1 / 6)


@pytest.mark.parametrize(("name", "content", "words"), [
    ("a.step", b"ISO-10303-21;", "STEP"), ("a.stl", bytes(80) + b"\x05\0\0\0", "truncated"), ("a.stl", b"hello", "truncated"),
    ("a.stl", b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n", "truncated"),
    ("a.stl", b"solid a\nvertex 0 0 x\nendsolid", "three numbers"), ("a.stl", b"solid a\nendsolid", "no face"),
    ("a.obj", b"v 0 0 0\nf 1 2 3\n", "not there"), ("a.obj", b"v 0 0\nf 1 1 1\n", "not understood"), ("a.obj", b"", "no face"),
    ("a.obj", b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not a number"), ("a.obj", b"v 0 0 0\nf 1 1 1\n", "no face")])
def test_damaged_files_are_named(tmp_path, name, content, words):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ResultError, match=rf"{name}.*{words}"):
        read_triangles(path)
