"""The colours of charts, built in and of files in every form."""

import numpy as np
import pytest

from service.calibrate.solvers.chart_reference import built_in, read_reference
from service.calibrate.solvers.cielab import delta_e_2000
from stage.errors import ManifestError
from tests.scenes.chart import D65_FROM_D50, reflectances, table

SPACE = "lin_rec709_scene"


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
