"""points.ply: the bytes of the contract, and back."""

import numpy as np
import pytest

from stage.errors import ResultError
from stage.formats.ply import PointCloud, read_ply, write_ply

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(5, 3)).astype(np.float32)
COLOURS = RNG.integers(0, 256, (5, 3)).astype(np.uint8)


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
