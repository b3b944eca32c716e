"""Colours of charts, CIELAB, and calibrations applied to captures."""

import numpy as np
import pytest

from service.calibrate.solvers.apply import as_direction, as_position, check_same_setup, lit_frames, with_brightness, with_lights
from service.calibrate.solvers.chart_reference import built_in, read_reference
from service.calibrate.solvers.cielab import WHITES, adaptation, delta_e_2000, lab_from_xyz, xyz_from_lab, xyz_from_linear
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.errors import ManifestError
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture
from tests.scenes.chart import D65_FROM_D50, reflectances, table

SPACE = "lin_rec709_scene"
SHARMA = """
50 2.6772 -79.7751 50 0 -82.7485 2.0425
50 3.1571 -77.2803 50 0 -82.7485 2.8615
50 -1.3802 -84.2814 50 0 -82.7485 1.0000
50 0 0 50 -1 2 2.3669
50 2.4900 -0.0010 50 -2.4900 0.0009 7.1792
50 2.4900 -0.0010 50 -2.4900 0.0011 7.2195
50 -0.0010 2.4900 50 0.0009 -2.4900 4.8045
50 -0.0010 2.4900 50 0.0011 -2.4900 4.7461
50 2.5 0 50 0 -2.5 4.3065
50 2.5 0 73 25 -18 27.1492
50 2.5 0 56 -27 -3 31.9030
60.2574 -34.0099 36.2677 60.4626 -34.1751 39.4387 1.2644
22.7233 20.0904 -46.6940 23.0331 14.9730 -42.5619 2.0373
36.4612 47.8580 18.3852 36.2715 50.5065 21.2231 1.4146
90.8027 -2.0831 1.4410 91.1528 -1.6435 0.0447 1.4441
6.7747 -0.2908 -2.4247 5.8714 -0.0985 -2.2286 0.6377
2.0776 0.0795 -1.1350 0.9033 -0.0636 -0.5514 0.9082
"""
"""Pairs in CIELAB and their difference, to four digits: Sharma, Wu and Dalal 2005, table 1."""
FAR = DistantLight(type="distant", direction=(0, 0, 1), irradiance=(1, 2, 3))
NEAR = PointLight(type="point", position_m=(0, 0, 2), intensity=(1, 2, 3), axis=(0, 0, -1), anisotropy=1.5)


def cgats(names, columns, values, head=""):
    rows = "\n".join("\t".join(["0", f'"{name}"', *map(str, row)]) for name, row in zip(names, values, strict=True))
    return (f"CGATS.17\n{head}\nNUMBER_OF_FIELDS {2 + len(columns)}\n"
            f"BEGIN_DATA_FORMAT\nIndex SAMPLE_NAME {' '.join(columns)}\nEND_DATA_FORMAT\n"
            f"NUMBER_OF_SETS {len(values)}\nBEGIN_DATA\n{rows}\nEND_DATA\n")


def test_the_greys_of_both_charts_are_grey_and_the_classic_patches_lie_in_the_large_chart():
    classic, large = built_in(24), built_in(140)
    assert classic.grid == (6, 4) and large.grid == (14, 10)
    assert (np.abs(classic.lab[18:, 1:]) < 3).all() and (np.diff(classic.lab[18:, 0]) < -10).all()
    # E2 to J5 of the large chart are the 24 patches, of another batch: the black is blacker
    rows = dict(zip(large.names, large.lab, strict=True))
    same = np.array([rows[f"{column}{row}"] for row in range(2, 6) for column in "EFGHIJ"])
    assert delta_e_2000(same, classic.lab).max() < 10 and np.median(delta_e_2000(same, classic.lab)) < 3


@pytest.mark.parametrize("letters", ["columns", "rows", "shuffled"])
def test_cgats_in_every_order(tmp_path, letters):
    chart = built_in(24)
    places = [(index % 6, index // 6) for index in range(24)]
    names = [f"{chr(65 + (x if letters != 'rows' else y))}{1 + (y if letters != 'rows' else x):02d}" for x, y in places]
    order = np.random.default_rng(0).permutation(24) if letters == "shuffled" else range(24)
    path = tmp_path / "chart.txt"
    values = [[f"{value:.2f}".replace(".", ",") for value in chart.lab[index]] for index in order]  # decimal commas, as some makers write
    path.write_text(cgats([names[index] for index in order], ["LAB_L", "LAB_A", "LAB_B"], values))
    found = read_reference(path, 24, "D50", SPACE)
    np.testing.assert_allclose(found.lab, chart.lab, atol=1e-9)
    assert found.names == tuple(names) and found.source == "chart.txt, D50"


def test_xyz_under_another_light_and_reflectances(tmp_path):
    chart = built_in(24)
    names = [row["name"] for row in table()]
    d65 = 100 * chart.xyz @ D65_FROM_D50.T
    path = tmp_path / "chart.it8"
    path.write_text(cgats(names, ["XYZ_X", "XYZ_Y", "XYZ_Z"], d65, 'ILLUMINATION_NAME "D65"'))
    found = read_reference(path, 24, "D50", SPACE)
    assert delta_e_2000(found.lab, chart.lab).max() < 0.05  # the digits of the whites
    assert found.names == tuple(names)
    path = tmp_path / "chart.csv"
    path.write_text("name,x,y,z\n" + "\n".join(f"{name},{x},{y},{z}" for name, (x, y, z) in zip(names, d65, strict=True)))
    assert delta_e_2000(read_reference(path, 24, "D65", SPACE).lab, chart.lab).max() < 0.05
    path.write_text("name,r,g,b\n" + "\n".join(f"{name},{x},{y},{z}" for name, (x, y, z) in zip(names, reflectances(), strict=True)))
    assert delta_e_2000(read_reference(path, 24, "D50", SPACE).lab, chart.lab).max() < 0.05


@pytest.mark.parametrize(("text", "words"), [
    ("name,l,a,b\ngrey,50,0,0\n", "has 1 patches, the chart has 24"),
    ("name,l,a,b\ngrey,50,0\n", "grey: its colour 50 0  must be three numbers"),
    ("name,hue\ngrey,50\n", "has no colours"),
    ("grey,50,0,0\n", "has no column name"),
    ("BEGIN_DATA\n1 2\n", "is no CGATS file"),
    (cgats(["A1"], ["LAB_L", "LAB_A", "LAB_B"], [[50, 0, 0]], 'ILLUMINATION_NAME "D55"'), "has colours under D55"),
    (cgats(["A1"], ["LAB_L", "LAB_A"], [[50, 0]]), "has no colours"),
    (cgats(["A1"], ["LAB_L", "LAB_A", "LAB_B"], [[50, 0]]), "its data do not fit"),
    (cgats(["A1"] * 24, ["XYZ_X", "XYZ_Y", "XYZ_Z"], [[0.5, 0.5, 0.5]] * 24), "give XYZ of which white has Y = 100"),
])
def test_files_that_are_no_colours_of_a_chart(tmp_path, text, words):
    path = tmp_path / "chart.txt"
    path.write_text(text)
    with pytest.raises(ManifestError, match=r"chart\.txt") as refused:
        read_reference(path, 24, "D50", SPACE)
    assert words in str(refused.value)


@pytest.mark.parametrize("pair", [line for line in SHARMA.splitlines() if line])
def test_differences_are_those_of_the_published_pairs(pair):
    *pair, wanted = map(float, pair.split())
    first, second = np.array(pair[:3]), np.array(pair[3:])
    assert delta_e_2000(first, second) == pytest.approx(wanted, abs=5.1e-5)
    assert delta_e_2000(second, first) == pytest.approx(wanted, abs=5.1e-5)
    assert delta_e_2000(first, first) == 0


def test_colours_come_back_and_white_stays_white():
    lab = np.random.default_rng(2).uniform([0, -90, -90], [100, 90, 90], (200, 3))
    for white in WHITES.values():
        np.testing.assert_allclose(lab_from_xyz(xyz_from_lab(lab, white), white), lab, atol=1e-9)
        np.testing.assert_allclose(lab_from_xyz(white, white), [100, 0, 0], atol=1e-9)
    np.testing.assert_allclose(adaptation(WHITES["D65"], WHITES["D50"]) @ WHITES["D65"], WHITES["D50"], atol=1e-12)
    for space in ("lin_rec709_scene", "lin_ap1_scene", "lin_p3d65_scene"):  # whose whites differ: D65 and that of ACES
        # OpenColorIO's matrices are float32, and that from ACES adapts between the published digits of both whites
        np.testing.assert_allclose(xyz_from_linear(space) @ np.ones(3), WHITES["D50"], atol=1e-4)


def test_lights_change_place_and_keep_the_rest():
    far = as_direction(FAR, np.array([0.6, 0, 0.8]))
    assert far.direction == pytest.approx((0.6, 0, 0.8)) and far.irradiance == FAR.irradiance
    near = as_position(NEAR, np.array([1.0, 0, 1]), np.zeros(3))
    assert near == NEAR.model_copy(update={"position_m": (1.0, 0.0, 1.0)})


def test_a_light_that_changes_its_kind():
    """E = I/d²: a far light of irradiance E becomes a near one of intensity E·d² at the place it was seen from."""
    near = as_position(FAR, np.array([0.0, 0, 3]), np.array([0.0, 0, 1]))
    assert near.type == "point" and near.intensity == pytest.approx((4, 8, 12))
    far = as_direction(NEAR, np.array([0.0, 0, 1]))
    assert far.type == "distant" and far.irradiance == (1, 1, 1)  # its distance is not known
    assert with_brightness(NEAR, np.array([7, 8, 9])).intensity == (7, 8, 9)
    assert with_brightness(FAR, np.array([7, 8, 9])).irradiance == (7, 8, 9)


def test_frames_of_other_kinds_stay_and_failed_ones_go(tmp_path):
    capture_folder = write_capture(tmp_path, make_scene(4, 4))
    edit_frame(capture_folder, 1, light={"type": "off"})
    capture = Capture.open(capture_folder)
    assert [lit.number for lit in lit_frames(capture)] == [0, 2, 3]
    manifest = with_lights(capture, [FAR, None, NEAR])
    assert [frame.image for frame in manifest.frames] == ["000.exr", "001.exr", "003.exr"]
    assert [frame.light.type for frame in manifest.frames] == ["distant", "off", "point"]
    assert manifest.model_copy(update={"frames": ()}) == capture.manifest.model_copy(update={"frames": ()})


def test_captures_that_do_not_belong_together(tmp_path):
    one, other = (write_capture(tmp_path / name, make_scene(4, 3)) for name in ("one", "other"))
    check_same_setup(Capture.open(one), Capture.open(other))
    turned = np.eye(4)
    for x, folder in ((0.0, one), (0.1, other)):
        turned[0, 3] = x
        edit_manifest(folder, camera={"projection": "orthographic", "resolution": [4, 4], "world_from_camera": turned.tolist()})
    with pytest.raises(ManifestError, match=r"world_from_camera: differs"):
        check_same_setup(Capture.open(one), Capture.open(other))
    edit_manifest(other, camera={"projection": "perspective", "resolution": [4, 4], "focal_px": [9, 9]})
    with pytest.raises(ManifestError, match=r"camera\.projection: differs"):
        check_same_setup(Capture.open(one), Capture.open(other))
