"""Openings of paste layers against the areas that geometry says, names of pads, and files that are no layers."""

from pathlib import Path

import numpy as np
import pytest

from stage.errors import ManifestError
from stage.formats.centroids import names_of, read_components
from stage.formats.gerber import read_marks, read_pads
from tests.scenes.paste_layer import HEAD, place, write_drill

ROUNDED = """%AMRoundRect*
4,1,4,$2,$3,$4,$5,$6,$7,$8,$9,$2,$3,0*
1,1,$1+$1,$2,$3*
1,1,$1+$1,$4,$5*
1,1,$1+$1,$6,$7*
1,1,$1+$1,$8,$9*
20,1,$1+$1,$2,$3,$4,$5,0*
20,1,$1+$1,$4,$5,$6,$7,0*
20,1,$1+$1,$6,$7,$8,$9,0*
20,1,$1+$1,$8,$9,$2,$3,0*%
%ADD10RoundRect,0.1X-0.2X-0.3X0.2X-0.3X0.2X0.3X-0.2X0.3*%
"""
"""A rectangle with rounded corners as KiCad writes it: .6 x .8 mm, corners of .1 mm."""
FLASH = "D10*\nX7000000Y-3000000D03*\n"
ARC = "%ADD10C,0.1*%\nD10*\nG75*\nX5000000Y0D02*\nG03*\nX6000000Y0I500000J0D01*\n"
REGION = "G36*\nX0Y0D02*\nG01*\nX1000000Y0D01*\nX1000000Y500000D01*\nG75*\nG03*\nX0Y500000I-500000J0D01*\nG01*\nX0Y0D01*\nG37*\n"


@pytest.mark.parametrize(("layer", "area", "centre"), [
    ("%ADD10R,0.4X0.2*%\n" + FLASH, 0.08, (7, -3)),
    ("%ADD10C,0.5*%\n" + FLASH, np.pi * 0.25**2, (7, -3)),
    ("%ADD10C,0.5X0.2*%\n" + FLASH, np.pi * (0.25**2 - 0.1**2), (7, -3)),
    ("%ADD10O,0.5X0.2*%\n" + FLASH, 0.06 + np.pi * 0.1**2, (7, -3)),
    ("%ADD10O,0.3X0.3*%\n" + FLASH, np.pi * 0.15**2, (7, -3)),
    ("%ADD10P,0.4X6X0*%\n" + FLASH, 6 * 0.5 * 0.2**2 * np.sin(np.pi / 3), (7, -3)),
    ("%AMOC8*5,1,8,0,0,1.08239X$1,22.5*%\n%ADD10OC8,0.4*%\n" + FLASH, 0.4**2 * 2 * np.tan(np.pi / 8), (7, -3)),
    ("%AMTURN*21,1,0.4,0.2,0.1,0,30*%\n%ADD10TURN*%\n" + FLASH, 0.08, (7 + 0.1 * np.cos(np.pi / 6), -3 + 0.05)),
    (ROUNDED + FLASH, 0.48 - (4 - np.pi) * 0.1**2, (7, -3)),
    ("%ADD10C,0.5*%\nD10*\nX5000000Y0D02*\nX6000000Y0D01*\n", 0.5 + np.pi * 0.25**2, (5.5, 0)),
    (ARC, np.pi / 2 * 0.1 + np.pi * 0.05**2, None),
    (REGION, 0.5 + np.pi / 8, None),
    ("%ADD10R,0.4X0.2*%\n%ADD11R,0.1X0.1*%\n" + FLASH + "%LPC*%\nD11*\nX7000000Y-3000000D03*\n", 0.07, (7, -3)),
    ("%ADD10R,0.4X0.2*%\nD10*\nX7000000Y-3000000D03*\nX7400000Y-3000000D03*\n", 0.16, (7.2, -3)),
], ids=["rectangle", "circle", "ring", "obround", "round obround", "hexagon", "polygon of a macro", "turned line of a macro",
        "rounded corners", "stroke", "arc", "region", "clear", "touching"])
def test_an_opening_has_the_area_of_its_geometry(tmp_path, layer, area, centre):
    """128 samples across find a curved outline to .5 %."""
    (tmp_path / "paste.gbr").write_text(HEAD + layer + "M02*\n")
    pad, = read_pads(tmp_path / "paste.gbr")
    assert 1e6 * pad.area_m2 == pytest.approx(area, rel=5e-3)
    if centre is not None:
        assert 1e3 * pad.centre_m == pytest.approx(np.array(centre), abs=1e-4)


def test_drilled_holes_and_round_flashes_are_marks(tmp_path):
    holes = [(0.001, 0.002), (-0.0035, 0.004)]
    assert read_marks(write_drill(tmp_path / "holes.drl", holes, 8e-4)) == pytest.approx(np.array([(*hole, 8e-4) for hole in holes]))
    (tmp_path / "top.gbr").write_text(HEAD + "%ADD10C,1*%\n%ADD11R,1X1*%\n" + FLASH + "D11*\nX0Y0D03*\nM02*\n")
    assert read_marks(tmp_path / "top.gbr") == pytest.approx(np.array([(7e-3, -3e-3, 1e-3)]), rel=1e-3)


def layer(path: Path, pads: list[tuple[float, float]]) -> Path:
    path.write_text(HEAD + "%ADD10R,0.3X0.2*%\nD10*\n" + "".join(f"{place(x * 1e-3, y * 1e-3)}D03*\n" for x, y in pads) + "M02*\n")
    return path


@pytest.mark.parametrize("table", [
    "Ref,Val,Package,PosX,PosY,Rot,Side\nU1,x,QFP,0,0,0,top\nC1,1u,0402,4.1,0,0,top\n",
    "# made by hand\n\"Designator\";\"Mid X\";\"Mid Y\";\"Layer\"\nU1;0mm;0mm;TopLayer\nC1;161.417mil;0mil;TopLayer\n",
    "Designator\tCenter-X(mil)\tCenter-Y(mil)\tRotation\nU1\t0\t0\t0\nC1\t161.417\t0\t0\n",
])
def test_a_centroid_file_names_pads_by_what_they_are_mirrored_about(tmp_path, table):
    """The right pads of U1 are nearer to C1, but only about U1 do they mirror others."""
    pads = read_pads(layer(tmp_path / "paste.gbr", [(-3, 1), (-3, -1), (3, 1), (3, -1), (3.8, 0), (4.4, 0)]))
    (tmp_path / "place.csv").write_text(table)
    components = read_components(tmp_path / "place.csv")
    assert names_of(pads, components) == ["U1.1", "U1.3", "U1.2", "U1.4", "C1.1", "C1.2"]
    assert components[1].place_m == pytest.approx([4.1e-3, 0], abs=1e-8)
    assert sorted(names_of(pads, [])) == [f"pad {number}" for number in range(1, 7)]


def test_names_of_the_layer_count_before_those_of_the_table(tmp_path):
    text = HEAD + "%ADD10R,0.3X0.2*%\nD10*\n%TO.P,R7,2*%\nX0Y0D03*\nX1000000Y0D03*\n%TD*%\n%TO.C,R8*%\nX2000000Y0D03*\n%TD*%\nM02*\n"
    (tmp_path / "paste.gbr").write_text(text)
    assert names_of(read_pads(tmp_path / "paste.gbr"), []) == ["R7.2", "R7.2 (2)", "R8.1"]


@pytest.mark.parametrize("end", ["M02*\n", "M02*", "M00*\n", "G54D10*M2*\n", "D02M02*\n", "%TD*%M02*\r\n", "M02*\nG04 seen*\n"])
def test_ends_that_programs_write_are_ends(tmp_path, end):
    (tmp_path / "paste.gbr").write_text(HEAD + "%ADD10R,0.4X0.2*%\n" + FLASH + end)
    assert len(read_pads(tmp_path / "paste.gbr")) == 1


@pytest.mark.parametrize(("text", "words"), [
    ("hello\n", "is a layer without an opening"),
    (HEAD + "M02*\n", "is a layer without an opening"),
    (HEAD + "D17*\nX0Y0D03*\nM02*\n", "is no Gerber file that can be read"),
    (HEAD + "%ADD10R,0.4X0.2*%\n" + FLASH, "paste.gbr: is truncated: it does not end with M02"),
    (HEAD + "%ADD10R,0.4X0.2*%\n" + FLASH + "G04 the end is M02*\n", "paste.gbr: is truncated"),
])
def test_what_is_no_layer_is_one_sentence(tmp_path, text, words):
    (tmp_path / "paste.gbr").write_text(text)
    with pytest.raises(ManifestError, match=words):
        read_pads(tmp_path / "paste.gbr")


@pytest.mark.parametrize(("table", "words"), [
    ("a,b\n1,2\n", "no line names the columns"),
    ("Ref,PosX,PosY\nU1,one,2\n", "line 2: must have the name of a component"),
    ("Ref,PosX,PosY\nU1,1\n", "line 2: must have the name of a component"),
])
def test_what_is_no_centroid_file_is_one_sentence(tmp_path, table, words):
    (tmp_path / "place.csv").write_text(table)
    with pytest.raises(ManifestError, match=words):
        read_components(tmp_path / "place.csv")
