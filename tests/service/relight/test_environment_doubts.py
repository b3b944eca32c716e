"""Environment maps whose light is another one where they are used: colours outside of the gamut, too few rows, values that were clipped or
multiplied."""

import numpy as np
import pytest

from service.relight.environments import Environments
from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import write_exr, write_radiance

REC709 = "lin_rec709_scene"


def doubts(folder, colour, rows=32, space=REC709):
    environments = Environments(write_exr(folder / "sky.exr", np.broadcast_to(colour, (rows, 2 * rows, 3)), colorInteropID=space))
    radiance = environments.read(folder / "sky.exr", REC709).radiance
    return radiance, environments


@pytest.mark.parametrize(("colour", "part"), [((0.1, 0.6, 0.2), 0.02), ((0.3, 0.5, 0.4), 0.0)])
def test_colours_outside_of_the_gamut_are_said(tmp_path, colour, part):
    """A green of ACEScg has less than no red in Rec.709; it was set to 0, and the light was another one, without a word."""
    radiance, environments = doubts(tmp_path, colour, space="lin_ap1_scene")
    added = environments.outside["sky.exr"]
    assert radiance.min() >= 0 and (added > part if part else added == 0)
    assert [f"adds {100 * added:.2g} %" in sentence for sentence in environments.doubts()] == [True] * (part > 0)


@pytest.mark.parametrize(("rows", "words"), [(1, "57 % too bright"), (4, "2.6 % too bright"), (16, None), (32, None)])
def test_too_few_rows_are_said(tmp_path, rows, words):
    """Truth: (π/2n) / sin(π/2n), the sum of the rows' solid angles over 4π."""
    found = doubts(tmp_path, (1.0, 1.0, 1.0), rows)[1].doubts()
    assert [words in sentence for sentence in found] == [True] if words else found == []


@pytest.mark.parametrize(("spin", "words"), [(6.28, "give 360"), (-3.1416, "give -180"), (360, None), (6, None), (0, None)])
def test_turns_in_radians_are_said(tmp_path, spin, words):
    environments = Environments(tmp_path / "sky.exr", spin_degrees=spin)
    found = environments.doubts()
    assert [words in sentence for sentence in found] == [True] if words else found == []


def test_plans_of_domes_say_what_is_doubtful_about_environments(relit, tmp_path):
    write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3)))
    said = relit("rig", "plan", "--environment", tmp_path / "sky.exr", "--lights", "8", "--out", tmp_path / "plan")
    assert "sky.exr: has 4 rows" in said.out + said.err


@pytest.mark.parametrize(("sun", "dtype", "said"), [(9e4, np.float16, True), (9e4, np.float32, False), (6e4, np.float16, False)])
def test_a_sun_that_half_floats_cannot_hold_is_said(tmp_path, sun, dtype, said):
    """Two texels at the horizon of 32 × 64, each 2 sin(π/64) 2π/64 sr, hold 65504 of their 90000; the rest has 4π sr of 1."""
    radiance = np.ones((32, 64, 3))
    radiance[15, 20:22] += sun
    environments = Environments(write_exr(tmp_path / "sky.exr", np.minimum(radiance, 65504 if dtype == np.float16 else np.inf), dtype))
    environments.read(tmp_path / "sky.exr", REC709)
    texel = 2 * np.sin(np.pi / 64) * 2 * np.pi / 64
    share = 2 * texel * 65504 / (2 * texel * 65504 + 4 * np.pi)
    assert [f"{100 * share:.0f} % of its light is from texels at 65504" in each for each in environments.doubts()] == [True] * said


@pytest.mark.parametrize(("factors", "words"), [
    ((1, 1), None), ((4, 4), "multiplied by 4 (EXPOSURE)"), ((1, 4), "multiplied by 1 (sky.1.hdr) to 4 (EXPOSURE)")])
def test_radiance_maps_that_were_multiplied_are_said(tmp_path, factors, words):
    environments = Environments(tmp_path / "sky.#.hdr")
    for number, factor in enumerate(factors, start=1):
        write_radiance(tmp_path / f"sky.{number}.hdr", np.full((16, 32, 3), float(factor)), f"EXPOSURE={factor}")
        assert (environments.read(environments.path(number), REC709).radiance == factor).all()
    assert [words in each for each in environments.doubts()] == ([] if words is None else [True])


@pytest.mark.parametrize(("lines", "said"), [
    (("GAMMA=2.2",), "says GAMMA=2.2,"), (("COLORCORR= 2.0 1 0.5", "GAMMA= 1"), "says COLORCORR=2 1 0.5,"),
    (("PRIMARIES= .708 .292 .170 .797 .131 .046 .3127 .3290",), "says PRIMARIES=0.708 0.292"), (("GAMMA=1.2.3",), None),
    (("PRIMARIES=.640 .330 .290 .600 .150 .060 .333 .333", "COLORCORR= 1 1 1"), None)])
def test_radiance_maps_of_another_encoding_are_said(tmp_path, lines, said):
    environments = Environments(write_radiance(tmp_path / "sky.hdr", np.full((16, 32, 3), 0.5), *lines))
    assert (environments.read(tmp_path / "sky.hdr", REC709).radiance == 0.5).all()
    assert [said in each for each in environments.doubts()] == ([] if said is None else [True])


@pytest.mark.parametrize(("declared", "value", "wanted", "said"), [
    ("sRGB", 0.5, srgb_to_linear(0.5), False), ("sRGB", 3.0, srgb_to_linear(3.0), True), ("Linear", 3.0, 3.0, False)])
def test_the_space_of_older_openimageio_is_heeded(tmp_path, declared, value, wanted, said):
    """Grey by the formula of IEC 61966-2-1; what is decoded above white is said."""
    environments = Environments(write_exr(tmp_path / "sky.exr", np.full((16, 32, 3), value), **{"oiio:ColorSpace": declared}))
    np.testing.assert_allclose(environments.read(tmp_path / "sky.exr", REC709).radiance, wanted, rtol=1e-3)
    assert ["declares srgb_texture" in each and "go up to 3," in each for each in environments.doubts()] == [True] * said


@pytest.mark.parametrize(("encoded", "dtype"), [(True, np.float16), (True, np.float32), (False, np.float16), (False, np.float32)])
def test_maps_of_8_bits_are_said(tmp_path, encoded, dtype):
    """A sky of 8 bits as it is recorded, or decoded by the formula of IEC 61966-2-1."""
    codes = np.random.default_rng(2).integers(0, 256, (32, 64, 3)) / 255
    light = srgb_to_linear(codes)
    for space, said in ((REC709, [encoded]), ("srgb_texture", [False])):
        environments = Environments(write_exr(tmp_path / "sky.exr", codes if encoded else light, dtype, colorInteropID=space))
        environments.read(tmp_path / "sky.exr", REC709)
        assert ["display-encoded" in each for each in environments.doubts() if "8 bits" in each] == said


def test_other_maps_are_not_of_8_bits(tmp_path):
    """Light of any value below 1; a drawn map of few values."""
    light = np.random.default_rng(3).uniform(0, 1, (32, 64, 3))
    for radiance in (light, light + 0.5, np.round(3 * light) / 3):
        environments = Environments(write_exr(tmp_path / "sky.exr", radiance, np.float16))
        environments.read(tmp_path / "sky.exr", REC709)
        assert environments.doubts() == []
