"""Colour: sRGB against its closed form, AP1 against the published matrix, and what stays untouched."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stage.colour.colour import convert, linearise, rgb_matrix
from stage.colour.colour_spaces import is_linear, linear_space
from stage.formats.images import fractions
from tests.reference.colour import AP1_TO_REC709, srgb_to_linear


def test_srgb_is_its_closed_form():
    codes = np.arange(256, dtype=np.float32) / 255
    pixels = np.repeat(codes.reshape(16, 16, 1), 3, axis=2)
    linear = linearise(pixels, "srgb_texture")
    # OpenColorIO joins the two pieces smoothly (slope 12.9232, not 12.92: 2.5e-4) and approximates the power to 2e-5; a step of
    # 8 bits is 9e-3 at the least
    assert np.allclose(linear, srgb_to_linear(pixels.astype(np.float64)), rtol=3e-4, atol=0)


@pytest.mark.parametrize("space", ["srgb_texture", "g22_rec709_scene", "lin_rec709_scene"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_become_what_their_fractions_become(space, dtype):
    codes = np.arange(np.iinfo(dtype).max + 1, dtype=dtype).reshape(16, -1, 1)
    assert np.array_equal(linearise(codes, space), linearise(fractions(codes.dtype)[codes], space))


def test_gamma_spaces_are_powers():
    pixels = np.full((1, 1, 3), 0.5, dtype=np.float32)
    assert np.allclose(linearise(pixels, "g22_rec709_scene"), 0.5**2.2, rtol=3e-5)
    assert np.allclose(linearise(pixels, "g18_rec709_scene"), 0.5**1.8, rtol=3e-5)  # its fast power


def test_linear_spaces_are_returned_as_they_are():
    pixels = np.array([[[0.1, 7.0, -0.5]]], dtype=np.float32)
    assert linearise(pixels, "lin_ap1_scene") is pixels
    assert convert(pixels, "lin_ap1_scene", "lin_ap1_scene") is pixels
    assert is_linear("lin_rec709_scene") and not is_linear("srgb_texture")


def test_grey_keeps_one_channel():
    grey = np.full((2, 3, 1), 0.5, dtype=np.float32)
    linear = linearise(grey, "srgb_texture")
    assert linear.shape == (2, 3, 1)
    assert np.allclose(linear, srgb_to_linear(0.5), rtol=5e-5)


def test_the_working_space_keeps_the_primaries():
    assert linear_space("srgb_texture") == "lin_rec709_scene"
    assert linear_space("srgb_p3d65_scene") == "lin_p3d65_scene"
    assert linear_space("lin_ap0_scene") == "lin_ap0_scene"
    with pytest.raises(ValueError, match="rgb is no colour space"):
        linear_space("rgb")


def test_an_unknown_space_is_an_error():
    with pytest.raises(ValueError, match="no_such_space"):
        convert(np.zeros((1, 1, 3), dtype=np.float32), "no_such_space", "lin_rec709_scene")


def test_the_matrix_is_the_conversion():
    assert np.allclose(rgb_matrix("lin_ap1_scene", "lin_rec709_scene"), AP1_TO_REC709, atol=1e-5)
    colours = np.random.default_rng(0).random((2, 5, 3)).astype(np.float32)
    converted = convert(colours, "lin_rec709_scene", "lin_ap1_scene")
    assert np.allclose(colours @ rgb_matrix("lin_rec709_scene", "lin_ap1_scene").T, converted, atol=1e-6)
    assert np.array_equal(rgb_matrix("lin_ap1_scene", "lin_ap1_scene"), np.eye(3))


def test_requests_can_check_a_name_without_numpy_or_an_image_library():
    """service.requests imports these modules, and the command line imports service.requests at its start."""
    code = ("import sys, stage.colour.colour_spaces, stage.errors, stage.model, stage.records\n"
            "print({'numpy', 'OpenImageIO'} & set(sys.modules))")
    home = Path(__file__).parents[3]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=home, timeout=60, check=True)
    assert done.stdout.strip() == "set()"
