"""Points as other programs mark and colour them, and those that they write where nothing was measured."""

import laspy
import numpy as np
import pye57
import pytest
from pye57 import libe57

from service.scans.points.point_files import read_point_scans
from service.scans.read import read_scan
from stage.errors import ResultError
from stage.formats.ply import PointCloud, read_ply, write_ply
from stage.sets.scan_set import read_scan_set
from tests.marks import first_short

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


FOOT, SURVEY_FOOT = 0.3048, 1200 / 3937
GEOGRAPHIC = 'GEOGCS["WGS 84",DATUM["x",SPHEROID["y",6378137,298.25]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]'


def geo_keys(**values):
    record = laspy.vlrs.known.GeoKeyDirectoryVlr()
    record.geo_keys = [laspy.vlrs.known.GeoKeyEntryStruct(number, 0, 1, value) for number, value in
                       ((3072, 2263), *((int(name[1:]), value) for name, value in values.items()))]
    record.geo_keys_header.number_of_keys = len(record.geo_keys)
    return record


def wkt(text):
    return laspy.vlrs.known.WktCoordinateSystemVlr(text)


@first_short(("record", "units"), [
    (wkt(f'PROJCS["New York (ftUS)",{GEOGRAPHIC},PARAMETER["false_easting",984250],UNIT["US survey foot",0.3048006096012192],'
         'AXIS["X",EAST]]'), [SURVEY_FOOT] * 3),
    (wkt(f'COMPD_CS["a [both]",PROJCS["b",{GEOGRAPHIC},UNIT["foot",0.3048]],VERT_CS["c",VERT_DATUM["d",2005],UNIT["metre",1.0]]]'),
     [FOOT, FOOT, 1]),
    (wkt('PROJCRS["e",BASEGEOGCRS["f",DATUM["g",ELLIPSOID["h",6378137,298,LENGTHUNIT["metre",1]]]],CONVERSION["i",PARAMETER["j",0,'
         'LENGTHUNIT["metre",1]]],CS[Cartesian,2],AXIS["(E)",east,LENGTHUNIT["foot",0.3048]],AXIS["(N)",north,LENGTHUNIT["foot",0.3048]]]'),
     [FOOT] * 3),
    (wkt(f'PROJCS["UTM",{GEOGRAPHIC},UNIT["metre",1]]'), [1] * 3), (geo_keys(k3076=9003), [SURVEY_FOOT] * 3),
    (geo_keys(k3076=9002, k4099=9001), [FOOT, FOOT, 1]), (geo_keys(k3076=9001), [1] * 3), (geo_keys(), [1] * 3), (None, [1] * 3)])
def test_las_files_in_feet_become_metres(relit, tmp_path, record, units):
    """Coordinate systems in feet, of which some have heights in metres, beside those in metres and files that say nothing."""
    (tmp_path / "in").mkdir()
    path = las(tmp_path / "in" / "a.las", 7)
    cloud = laspy.read(path)
    if record is not None:
        cloud.header.vlrs.append(record)
        cloud.write(str(path))
    said = relit.done("import", "scans", tmp_path / "in", tmp_path / "out").out
    np.testing.assert_allclose(read_ply(tmp_path / "out" / "a.ply").points, POINTS * units, atol=1e-6)  # steps of the file, float32
    assert ("as the files say" in said) == (units != [1] * 3)
    said = relit.done("import", "scans", tmp_path / "in", tmp_path / "given", "--unit", "cm").out
    np.testing.assert_allclose(read_ply(tmp_path / "given" / "a.ply").points, POINTS * 0.01, atol=1e-8)  # the given unit holds


@pytest.mark.parametrize("ending", ["ply", "xyz", "e57"])
def test_where_nothing_came_back_is_no_surface(relit, tmp_path, ending):
    """Devices write 0 0 0 there; the scan is a plate before the scanner, which stands at the origin of the file."""
    across = np.stack(np.meshgrid(np.linspace(-0.2, 0.2, 40), np.linspace(-0.2, 0.2, 40), [-1.0]), axis=-1).reshape(-1, 3)
    points = np.concatenate([across, np.zeros((700, 3))]).astype(np.float32)
    folder = tmp_path / "points"
    folder.mkdir()
    if ending == "ply":
        write_ply(PointCloud(points, np.zeros(points.shape, np.uint8)), folder / "a.ply")
    elif ending == "xyz":
        np.savetxt(folder / "a.xyz", points)
    else:
        with pye57.E57(str(folder / "a.e57"), mode="w") as file:
            file.write_scan_raw({f"cartesian{axis}": points[:, number].astype(float) for number, axis in enumerate("XYZ")})
    said = relit.done("import", "scans", folder, tmp_path / "set").out
    assert "1600 to 1600 points" in said and "0.4 m is the widest" in said and "700 at 0 0 0 are left out" in said
    scan = read_scan(*read_scan_set(tmp_path / "set"), 0)
    assert scan.points == pytest.approx(across, abs=1e-6)  # float32
