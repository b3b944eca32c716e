"""PLY files of other programs: ASCII and binary of both orders, with properties in any order, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from service.scans.points.ply_points import read_ply_points
from stage.errors import ResultError

XYZ = np.array([[0.0, 1, 2], [3, 4, 5], [np.nan, 0, 0], [6, 7, 8]])


def write(path: Path, order: str, *, colour: str = "uchar") -> Path:
    kinds = [("red", colour), ("x", "double"), ("y", "float"), ("z", "float"), ("green", colour), ("blue", colour), ("quality", "short"),
             ("sigma", "float")]
    full = 255 if colour == "uchar" else 1
    values = {"x": XYZ[:, 0], "y": XYZ[:, 1], "z": XYZ[:, 2], "red": np.full(4, full), "green": np.zeros(4), "blue": np.full(4, full),
              "quality": np.arange(4), "sigma": np.full(4, 0.5)}
    header = ["ply", f"format {order} 1.0", "comment made by another program", "element sensor 2", "property float t",
              "element vertex 4",
              *(f"property {kind} {name}" for name, kind in kinds),
              "element face 1", "property list uchar int vertex_indices", "end_header"]
    text = ("\n".join(header) + "\n").encode()
    if order == "ascii":
        rows = np.stack([values[name] for name, _ in kinds], axis=1)
        body = "0.5\n1.5\n" + "\n".join(" ".join(f"{value:g}" for value in row) for row in rows) + "\n3 0 1 3\n"
        path.write_bytes(text + body.encode())
        return path
    mark = "<" if order.endswith("little_endian") else ">"
    names = {"double": "f8", "float": "f4", "uchar": "u1", "short": "i2"}
    table = np.zeros(4, dtype=[(name, mark + names[kind]) for name, kind in kinds])
    for name in table.dtype.names or ():
        table[name] = values[name]
    path.write_bytes(text + np.zeros(2, dtype=mark + "f4").tobytes() + table.tobytes() + bytes(13))
    return path


@pytest.mark.parametrize("colour", ["uchar", "float"])
@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_files_of_other_programs_are_read(tmp_path, order, colour):
    read = read_ply_points(write(tmp_path / "a.ply", order, colour=colour))
    np.testing.assert_array_equal(read.points, XYZ[[0, 1, 3]])
    assert read.colours is not None and read.sigma is not None and read.normals is None
    np.testing.assert_array_equal(read.colours, np.tile([255, 0, 255], (3, 1)))
    np.testing.assert_array_equal(read.sigma, 0.5)


@pytest.mark.parametrize(("kind", "full"), [
    ("uchar", 255), ("ushort", 255), ("ushort", 65535), ("short", 255), ("int", 255), ("int", 65535), ("uint", 255), ("uint", 2**32 - 1),
    ("float", 1), ("float", 255), ("float", 65535), ("double", 1), ("double", 255)])
def test_the_scale_of_colours_is_told_by_their_type_and_the_largest(tmp_path, kind, full):
    part = np.array([[1.0, 0.5, 0.2], [0.8, 0.4, 0], [0.1, 0.6, 0.9]])
    rows = [" ".join(f"{value:.17g}" for value in (*row, *colour)) for row, colour in
            zip(np.eye(3), part * full if kind in ("float", "double") else np.rint(part * full), strict=True)]
    path = tmp_path / "a.ply"
    path.write_text("\n".join(["ply", "format ascii 1.0", "element vertex 3", *(f"property float {name}" for name in "xyz"),
                               *(f"property {kind} {name}" for name in ("red", "green", "blue")), "end_header", *rows, ""]))
    read = read_ply_points(path)
    assert read.colours is not None
    np.testing.assert_allclose(read.colours, 255 * part, atol=0.51)  # rounding to 8 bits, and of floats before it


def test_colours_a_little_above_one_are_those_from_0_to_1(tmp_path):
    path = write(tmp_path / "a.ply", "binary_little_endian", colour="float")
    path.write_bytes(path.read_bytes().replace(np.float32(1).tobytes(), np.float32(1.02).tobytes()))
    read = read_ply_points(path)
    assert read.colours is not None
    np.testing.assert_array_equal(read.colours, np.tile([255, 0, 255], (3, 1)))


@pytest.mark.parametrize(("change", "sentence"), [
    (lambda raw: raw[:-40], "is truncated"),
    (lambda raw: raw.replace(b"ply\n", b"plx\n", 1), "is not a PLY file"),
    (lambda raw: raw.replace(b"property double x", b"property double w"), "have no property x"),
    (lambda raw: raw.replace(b"element vertex 4", b"element vertex 0"), "has no vertices"),
    (lambda raw: raw.replace(b"property float t", b"property list uchar int t"), "lists before the end of its vertices"),
    (lambda raw: raw.replace(b"binary_little_endian", b"binary_pdp_endian"), "its format is binary_pdp_endian"),
    (lambda raw: raw.replace(b"property float sigma", b"property float x"), "have the property x twice"),
    (lambda raw: raw.replace(b"property short quality", b"property quaternion quality"), "is not understood"),
])
def test_damaged_files_are_refused_with_a_sentence(tmp_path, change, sentence):
    path = write(tmp_path / "a.ply", "binary_little_endian")
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(ResultError, match=sentence):
        read_ply_points(path)
