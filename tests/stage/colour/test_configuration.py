"""Configurations of colours: a minimal one in closed form, the built-in studio configuration by the formulas of the makers, and errors."""

import numpy as np
import OpenImageIO as oiio
import PyOpenColorIO
import pytest
from pydantic import TypeAdapter

from stage.colour.colour import convert, linearise, rgb_matrix, through_view
from stage.colour.colour_spaces import LightSpaceName, Review, channels_apart, is_linear, linear_space
from stage.colour.configuration import current, used
from stage.colour.environment_maps import read_environment
from stage.colour.location import STUDIO, VARIABLE
from stage.errors import ColourError
from stage.formats import exr
from tests.reference.colour import ACES_TO_ACESCG, ACES_TO_REC709, AWG4_TO_ACES, logc4_to_linear, slog3_to_linear
from tests.scenes.captures import write_exr

TO_ACES = np.array([[0.7, 0.2, 0.1], [0.1, 0.8, 0.1], [0.05, 0.15, 0.8]])
MINIMAL = """ocio_profile_version: 2
roles: {interchange}
file_rules: [!<Rule> {{name: Default, colorspace: house aces}}]
displays:
  Wall:
    - !<View> {{name: Plain, colorspace: house gamma}}
    - !<View> {{name: Raw, colorspace: values}}
colorspaces:
  - !<ColorSpace> {{name: house aces}}
  - !<ColorSpace>
    name: house linear
    aliases: [hl]
    to_scene_reference: !<MatrixTransform> {{matrix: [{matrix}]}}
  - !<ColorSpace>
    name: house gamma
    aliases: [hg]
    to_scene_reference: !<GroupTransform>
      children:
        - !<ExponentTransform> {{value: [2.5, 2.5, 2.5, 1]}}
        - !<MatrixTransform> {{matrix: [{matrix}]}}
  - !<ColorSpace> {{name: values, isdata: true}}
looks:
  - !<Look> {{name: warm, process_space: house linear, transform: !<CDLTransform> {{slope: [1.5, 1, 0.5]}}}}
  - !<Look> {{name: cold, process_space: house linear, transform: !<CDLTransform> {{slope: [0.5, 0.5, 0.5]}}}}
"""
WARM = np.array([1.5, 1, 0.5])
PIXELS = np.random.default_rng(7).uniform(0.1, 0.9, (4, 9, 3)).astype(np.float32)


def minimal(path, *, joined=True, scene="house linear"):
    """Write a configuration of one camera with primaries and a gamma of its own."""
    path.parent.mkdir(exist_ok=True)
    given = {"aces_interchange": "house aces" if joined else None, "scene_linear": scene}
    roles = [f"{name}: {space}" for name, space in given.items() if space is not None]
    rows = np.eye(4)
    rows[:3, :3] = TO_ACES
    path.write_text(MINIMAL.format(interchange="{" + ", ".join(roles) + "}", matrix=", ".join(map(str, rows.ravel()))))
    return str(path)


def test_a_minimal_configuration_is_its_closed_form(tmp_path):
    with used(minimal(tmp_path / "house.ocio")):
        assert linear_space("HG") == "house linear" and channels_apart("hg") and is_linear("hl") and not is_linear("hg")
        # OpenColorIO's fast power is right to 2e-5
        assert np.allclose(linearise(PIXELS, "hg"), PIXELS.astype(float) ** 2.5, rtol=3e-5)
        codes = np.arange(256, dtype=np.uint8).reshape(16, 16, 1)
        assert np.allclose(linearise(codes, "hg"), (codes / 255.0) ** 2.5, rtol=3e-5, atol=1e-7)
        # it has no Rec.709: joined with the built-in configuration at ACES2065-1
        assert np.allclose(convert(PIXELS, "hl", "lin_rec709_scene"), PIXELS.astype(float) @ (ACES_TO_REC709 @ TO_ACES).T, atol=1e-5)
        to_rec709 = (PIXELS.astype(float) ** 2.5) @ (ACES_TO_REC709 @ TO_ACES).T
        assert np.allclose(convert(PIXELS, "hg", "lin_rec709_scene"), to_rec709, atol=3e-5)
        assert np.allclose(convert(to_rec709.astype(np.float32), "lin_rec709_scene", "hg"), PIXELS, atol=1e-4)  # steep near 0
        # both missing: as without a configuration
        inside = convert(PIXELS, "srgb_texture", "lin_rec709_scene")
        assert np.allclose(through_view(PIXELS, "hl", Review()), PIXELS.astype(float) ** 0.4, rtol=3e-5)
        assert np.allclose(through_view(PIXELS, "hl", Review("wall/plain")), through_view(PIXELS, "hl", Review()))
        for look, slope in {"warm": WARM, "-warm": 1 / WARM, "Warm, -warm": 1, "cold, +warm": WARM / 2}.items():
            shown = through_view(PIXELS, "hl", Review("Plain", look))
            assert np.allclose(shown, (PIXELS.astype(float) * slope) ** 0.4, rtol=3e-5), look
    assert np.array_equal(inside, convert(PIXELS, "srgb_texture", "lin_rec709_scene"))
    assert current().location == "ocio://default"


def test_camera_logs_of_the_studio_configuration_are_the_makers_formulas(monkeypatch):
    monkeypatch.setenv(VARIABLE, STUDIO)
    logged = np.linspace(0.05, 0.7, 300, dtype=np.float32).reshape(10, 10, 3)
    linear = logc4_to_linear(logged.astype(float))
    assert np.allclose(linearise(logged, "ARRI LogC4"), linear, rtol=2e-5, atol=1e-6)
    acescg = linear @ (ACES_TO_ACESCG @ AWG4_TO_ACES).T
    assert np.allclose(convert(logged, "arri_logc4", "ACEScg"), acescg, rtol=2e-5, atol=1e-5)
    assert np.allclose(linearise(logged, "slog3_sgamut3cine"), slog3_to_linear(logged.astype(float)), rtol=3e-5, atol=1e-6)
    # working in the linear space and converting after gives what OpenColorIO gives at once
    through = linearise(logged, "ARRI LogC4") @ rgb_matrix(linear_space("ARRI LogC4"), "lin_ap1_scene").T
    assert np.allclose(through, convert(logged, "ARRI LogC4", "lin_ap1_scene"), rtol=1e-5, atol=1e-5)


def test_a_log_has_the_linear_space_of_its_primaries(monkeypatch):
    monkeypatch.setenv(VARIABLE, STUDIO)
    found = {space: current().find(linear_space(space)) for space in ("ARRI LogC4", "S-Log3 S-Gamut3.Cine", "S-Log3 Venice S-Gamut3.Cine",
                                                                      "Log3G10 REDWideGamutRGB", "ACEScct", "Camera Rec.709")}
    assert list(found.values()) == ["Linear ARRI Wide Gamut 4", "Linear S-Gamut3.Cine", "Linear Venice S-Gamut3.Cine",
                                    "Linear REDWideGamutRGB", "ACEScg", "Linear Rec.709 (sRGB)"]
    assert linear_space("ACEScct") == "lin_ap1_scene"  # by the name that files declare


def test_a_light_has_one_name_for_a_space():
    """Captures, rigs and keys are compared by it."""
    names = TypeAdapter(LightSpaceName)
    assert {names.validate_python(name) for name in ("ACEScg", "lin_ap1", "scene_linear", "lin_ap1_scene")} == {"lin_ap1_scene"}


def test_a_space_that_mixes_its_channels_is_converted_whole(monkeypatch):
    """Densities of a film scan are no function of one channel each: integers cannot be looked up channel by channel."""
    monkeypatch.setenv(VARIABLE, STUDIO)
    codes = np.random.default_rng(3).integers(20000, 40000, (3, 5, 3), dtype=np.uint16)
    assert not channels_apart("ADX16") and linear_space("ADX16") == "lin_ap1_scene"
    assert np.allclose(linearise(codes, "ADX16"), convert((codes / 65535).astype(np.float32), "ADX16", "ACEScg"), rtol=1e-6)


def test_the_same_name_in_another_configuration_has_other_values(tmp_path):
    """Tables of integers are kept for each configuration."""
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16, 1)
    one = minimal(tmp_path / "one.ocio")
    (tmp_path / "two.ocio").write_text((tmp_path / "one.ocio").read_text().replace("2.5", "2.0"))
    with used(one):
        first = linearise(codes, "hg")
    with used(str(tmp_path / "two.ocio")):
        assert np.allclose(linearise(codes, "hg"), (codes / 255.0) ** 2, rtol=3e-5, atol=1e-7)
        assert not np.allclose(first, linearise(codes, "hg"))


def test_the_label_changes_with_the_content_and_its_tables(tmp_path):
    table = tmp_path / "luts" / "curve.spi1d"
    table.parent.mkdir()
    table.write_text("Version 1\nFrom 0 1\nLength 2\nComponents 1\n{\n0\n1\n}\n")
    text = (tmp_path / "a.ocio")
    minimal(text)
    labels = []
    for old, new in (("", ""), ("roles:", "search_path: luts\nroles:"), ("{name: house aces}", "{name: house aces, aliases: [x]}")):
        text.write_text(text.read_text().replace(old, new, 1) if old else text.read_text())
        with used(str(text)):
            labels.append(current().label)
    text.write_text(text.read_text().replace("!<ExponentTransform> {value: [2.5, 2.5, 2.5, 1]}", "!<FileTransform> {src: curve.spi1d}"))
    for curve in ("1\n}", "2\n}"):
        table.write_text(table.read_text().replace("1\n}", curve))
        labels.append(_label_of(text))
    assert len(set(labels)) == 5 and all(label.startswith("a.ocio sha256:") for label in labels)


@pytest.mark.parametrize("place", ["ocio://default", STUDIO, "minimal"])
def test_the_cache_id_is_that_of_opencolorio(tmp_path, place):
    """The library within OpenImageIO, with which other tests compare colours, reads the same configuration."""
    place = minimal(tmp_path / "house.ocio") if place == "minimal" else place
    with used(place):
        read = PyOpenColorIO.Config.CreateFromFile(place)
        assert current().cache_id == read.getCacheID()
        of_all = read.getColorSpaceNames(PyOpenColorIO.SEARCH_REFERENCE_SPACE_ALL, PyOpenColorIO.COLORSPACE_ALL)  # inactive ones too
        assert set(of_all) == set(oiio.ColorConfig(place).getColorSpaceNames())
    assert PyOpenColorIO.GetVersion().split(".")[:2] == oiio.get_string_attribute("opencolorio_version").split(".")[:2]


def _label_of(path):
    """Read a configuration as a process does that starts: its tables are read once."""
    path.touch()
    with used(str(path)):
        return current().label


def test_an_environment_with_a_declared_space_is_converted(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, STUDIO)
    sky = np.random.default_rng(4).uniform(0.2, 2, (4, 8, 3))
    path = write_exr(tmp_path / "sky.exr", sky, colorInteropID="Linear ARRI Wide Gamut 4")
    expected = sky @ (ACES_TO_ACESCG @ AWG4_TO_ACES).T
    assert np.allclose(read_environment(path, "lin_ap1_scene"), np.maximum(expected, 0), atol=3e-5)
    monkeypatch.delenv(VARIABLE)
    with pytest.raises(ValueError, match=f"sky.exr: Linear ARRI Wide Gamut 4 is no colour space .*give --ocio {STUDIO}"):
        read_environment(path, "lin_ap1_scene")


def test_files_declare_a_space_by_its_identifier(monkeypatch, tmp_path):
    monkeypatch.setenv(VARIABLE, STUDIO)
    space = linear_space("ARRI LogC4")
    exr.write(tmp_path / "a.exr", {"Y": np.ones((2, 2), np.float16)}, color_space=space, metadata={})
    declared = exr.color_space_of(exr.read_header(tmp_path / "a.exr").metadata)
    assert declared == "ocio:lin_awg4_scene" and current().find(declared) == "Linear ARRI Wide Gamut 4"


@pytest.mark.parametrize(("place", "space", "words"), [
    (None, "LogC4", "LogC4 is no colour space of the OpenColorIO configuration ocio://default: ocio://studio-config-latest has ARRI LogC4"),
    (STUDIO, "LogC4", "the nearest are ARRI LogC4"),
    (STUDIO, "SLog3", "the nearest are S-Log3 S-Gamut3, S-Log3 S-Gamut3.Cine"),
    (STUDIO, "ACESgc", "the nearest are ACEScg"),
    (STUDIO, "scene_liner", r"the nearest are scene_linear \(ACEScg\)"),
    (STUDIO, "Raw", "Raw holds data"),
    ("ocio://nothing", "ACEScg", "--ocio or \\$OCIO: ocio://nothing: .*nothing"),
    ("/no/such.ocio", "ACEScg", "/no/such.ocio: no such OpenColorIO configuration"),
])
def test_a_missing_space_or_configuration_is_one_sentence(place, space, words):
    with pytest.raises(ColourError, match=words) as raised, used(place):
        linear_space(space)
    assert "\n" not in str(raised.value)


def test_a_broken_configuration_is_one_sentence(tmp_path):
    (tmp_path / "bad.ocio").write_text("ocio_profile_version: 2\nroles: [\n")
    with pytest.raises(ColourError, match=r"bad\.ocio: is no OpenColorIO configuration") as raised, used(str(tmp_path / "bad.ocio")):
        pass
    assert "\n" not in str(raised.value)


def test_a_configuration_that_cannot_be_joined_says_so(tmp_path):
    with used(minimal(tmp_path / "lone.ocio", joined=False, scene=None)):
        assert np.array_equal(convert(PIXELS, "hl", "hl"), PIXELS)
        with pytest.raises(ColourError, match=r"lone\.ocio has no colour space lin_rec709_scene, and no role aces_interchange"):
            convert(PIXELS, "hl", "lin_rec709_scene")


def test_a_view_that_is_missing_is_one_sentence():
    with pytest.raises(ColourError, match=r"Un-toned is no view .* give .*/Un-tone-mapped"):
        current().view("Un-toned")
    assert current().view("Un-tone-mapped") == ("sRGB - Display", "Un-tone-mapped")
    assert current().view("display p3 - display/un-tone-mapped") == ("Display P3 - Display", "Un-tone-mapped")


@pytest.mark.parametrize(("look", "words"), [
    ("warn", "warn is no look of the OpenColorIO configuration house.ocio: give warm"),
    ("warm, -", "warm, - is no look of .*: give warm or cold"), ("warm, green", "green is no look of")])
def test_a_look_that_is_missing_is_one_sentence(tmp_path, look, words):
    with used(minimal(tmp_path / "house.ocio")), pytest.raises(ColourError, match=words):
        current().checked_look(look)
    with pytest.raises(ColourError, match=r"warm is no look of the OpenColorIO configuration ocio://default: give ACES 1\.3"):
        current().checked_look("warm")
