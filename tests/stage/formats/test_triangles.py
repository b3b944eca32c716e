"""Meshes of triangles in the files of programs for design."""

import numpy as np
import pytest

from stage.errors import ResultError
from stage.formats.triangles import read_triangles
from tests.scenes.machined_part import machined_part, write_stl

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
