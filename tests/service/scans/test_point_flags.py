"""Points of LAS and E57 files as other programs mark and colour them."""

import laspy
import numpy as np
import pye57
import pytest
from pye57 import libe57

from service.scans.points.point_files import read_point_scans
from stage.errors import ResultError

POINTS = np.random.default_rng(0).random((20, 3))
COLOURS = np.arange(60, dtype=np.uint8).reshape(20, 3) * 4


def las(path, point_format, **marks):
    header = laspy.LasHeader(point_format=point_format)
    header.scales = np.full(3, 1e-6)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = POINTS.T
    for name, values in marks.items():
        cloud[name] = values
    cloud.write(str(path))
    return path


@pytest.mark.parametrize("point_format", [2, 7])
def test_points_of_las_files_that_are_withheld_or_noise_are_left_out(point_format, tmp_path):
    withheld, classes = np.arange(20) < 3, np.where(np.arange(20) == 5, 7, np.where(np.arange(20) == 6, 18, 2)).astype(np.uint8)
    scan, = read_point_scans(las(tmp_path / "a.las", point_format, withheld=withheld, classification=classes))
    np.testing.assert_allclose(scan.points, POINTS[~withheld & (classes == 2)], atol=1e-6)  # the unit of the file
    whole, = read_point_scans(las(tmp_path / "b.las", point_format))
    assert len(whole.points) == 20


def test_a_las_file_that_ends_behind_a_point_is_truncated(tmp_path):
    path = las(tmp_path / "a.las", 7)
    header = laspy.read(path).header
    path.write_bytes(path.read_bytes()[:header.offset_to_point_data + 12 * header.point_format.size])
    with pytest.raises(ResultError, match=r"a\.las: is truncated: it holds 12 of 20 points"):
        read_point_scans(path)


@pytest.mark.parametrize("most", [1.0, 255, 65535])
def test_colours_of_e57_files_have_the_scale_of_the_file(most, tmp_path):
    given = COLOURS / 255 * most if most == 1 else (COLOURS.astype(np.uint16) * (int(most) // 255))
    file = pye57.E57(str(tmp_path / "a.e57"), mode="w")
    image = file.image_file
    scan, point = libe57.StructureNode(image), libe57.StructureNode(image)
    scan.set("guid", libe57.StringNode(image, "{a}"))
    names = ("cartesianX", "cartesianY", "cartesianZ", "colorRed", "colorGreen", "colorBlue")
    columns = dict(zip(names, [*POINTS.T, *given.T], strict=True))
    for name in columns:
        whole = name.startswith("color") and most > 1
        point.set(name, libe57.IntegerNode(image, 0, 0, int(most)) if whole else libe57.FloatNode(image, 0.0, libe57.E57_DOUBLE, -9, 9))
    vector = libe57.CompressedVectorNode(image, point, libe57.VectorNode(image, True))
    scan.set("points", vector)
    file.data3d.append(scan)
    buffers, kept = libe57.VectorSourceDestBuffer(), {name: np.array(values) for name, values in columns.items()}
    for name, values in kept.items():
        buffers.append(libe57.SourceDestBuffer(image, name, values, len(values), True, True))
    writer = vector.writer(buffers)
    writer.write(len(POINTS))
    writer.close()
    file.close()
    found, = read_point_scans(tmp_path / "a.e57")
    assert found.colours.dtype == np.uint8 and np.array_equal(found.colours, COLOURS)
