"""Conversions of colours, and what recorded values become as radiance."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.colour.colour import convert, linearise, rgb_matrix
from stage.colour.colour_spaces import is_linear, linear_space
from stage.colour.environment_maps import read_environment
from stage.colour.radiance import check_radiance, clip_negative, noise_floor
from stage.errors import ImageError
from stage.formats.images import fractions
from stage.pixels import PixelChoices
from stage.stack.correction import Correction
from stage.stack.ingest import open_stack
from tests.reference.colour import AP1_TO_REC709, srgb_to_linear
from tests.scenes.captures import make_scene, write_capture, write_exr

RNG = np.random.default_rng(7)
UNIT = RNG.random((5, 7, 3))
SIGMA = 0.004


def dark_subtracted(size=96, seed=0, filtered=False):
    """A shaded ball before black with normal noise; `filtered` as demosaicing leaves it, alike in neighbours."""
    centre = (np.arange(size) + 0.5) / size * 2.4 - 1.2
    x, y = np.meshgrid(centre, centre)
    ball = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    noise = np.random.default_rng(seed).normal(0, SIGMA, (size + 1, size + 1, 3))
    if filtered:
        noise = (noise[1:, 1:] + noise[:-1, 1:] + noise[1:, :-1] + noise[:-1, :-1]) / 2  # of the same standard deviation
    return (ball[..., None] + noise[:size, :size]).astype(np.float32)


@pytest.mark.parametrize(("bad", "words"), [
    (np.nan, "1 pixel is not finite (NaN or infinity), the first at row 2"),
    (np.inf, "1 pixel is not finite (NaN or infinity), the first at row 2"),
    (-0.001, "1 pixel is negative, the first at row 2, column 3"),
])
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_impossible_values_are_counted_and_the_first_is_named(tmp_path, bad, words, dtype):
    pixels = UNIT.astype(dtype)
    pixels[0, 0] = -0.0
    check_radiance("a.exr", pixels)
    pixels[2, 3, 1] = bad
    with pytest.raises(ImageError) as caught:
        check_radiance("a.exr", pixels)
    assert words in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_noise_around_zero_is_kept(seed, filtered):
    """The noise is measured to a tenth: on 3000 readings before the ball, and a few of its edge that shading raises."""
    pixels = dark_subtracted(seed=seed, filtered=filtered)
    assert (pixels < 0).sum() > 3000
    check_radiance("a.exr", pixels)
    assert clip_negative(pixels) == (pytest.approx(pixels), 0)
    np.testing.assert_allclose(noise_floor(pixels), -6 * SIGMA, rtol=0.15)


@pytest.mark.parametrize("size", [12, 20])
def test_noise_in_one_small_shadow_is_kept_and_a_pedestal_is_not(size):
    """The floor is 6 σ and two standard errors of few triples; of ten shadows none is refused, and one 12 σ too dark is."""
    random = np.random.default_rng(size)
    for _ in range(10):
        pixels = np.full((200, 200, 3), 0.5, np.float32)
        pixels[40 : 40 + size, 60 : 60 + size] = 0
        pixels += random.normal(scale=SIGMA, size=pixels.shape).astype(np.float32)
        check_radiance("a.exr", pixels)
        assert (noise_floor(pixels) < -5 * SIGMA).all() and (noise_floor(pixels) > -10 * SIGMA).all()
    pixels[40 : 40 + size, 60 : 60 + size] -= 12 * SIGMA
    with pytest.raises(ImageError, match="negative"):
        check_radiance("a.exr", pixels)


def test_noise_in_a_shadow_of_few_pixels_is_kept():
    """A relief that fills the image: all is shaded, and eight pixels are dark. A pixel 20 σ below zero is no noise, nor is ringing."""
    random = np.random.default_rng(3)
    shaded = np.repeat(np.linspace(0.02, 0.8, 200, dtype=np.float32)[None, :, None], 200, axis=0).repeat(3, axis=2)
    shaded[7:11, 60:62] = 0
    for _ in range(10):
        noisy = shaded + random.normal(scale=SIGMA, size=shaded.shape).astype(np.float32)
        check_radiance("a.exr", noisy)
    noisy[7, 61] = -20 * SIGMA
    shaded[7:11, 60:62] = -0.02
    for wrong in (noisy, shaded):
        with pytest.raises(ImageError, match="negative"):
            check_radiance("a.exr", wrong)


@pytest.mark.parametrize("spoil", ["pedestal", "hot pixel", "ringing"])
def test_what_no_noise_explains_is_refused_and_counted(spoil):
    pixels = dark_subtracted()
    if spoil == "pedestal":  # a dark image of a longer exposure
        pixels -= np.float32(0.05)
    elif spoil == "hot pixel":
        pixels[5, 6] = -0.3
    else:  # of a sharp filter beside a bright edge, without noise
        pixels = np.maximum(pixels, 0)
        pixels[40, :10] = -0.02
    low = pixels < (0 if spoil == "ringing" else -6.9 * SIGMA)  # the noise is measured to 15 %
    count = int(low.any(axis=-1).sum())
    with pytest.raises(ImageError, match=r"a\.exr: \d+ pixels? (is|are) negative, the first"):
        check_radiance("a.exr", pixels)
    clipped, found = clip_negative(pixels)
    assert (clipped[low] == 0).all()
    kept = pixels > -5.1 * SIGMA
    np.testing.assert_array_equal(clipped[kept], np.maximum(pixels, 0)[kept] if spoil == "ringing" else pixels[kept])
    assert count <= found <= int((~kept).any(axis=-1).sum()) or (spoil == "ringing" and found == count == 10)


def test_rounding_below_zero_is_kept():
    """Dark areas of a rendered image after a filter in single precision."""
    pixels = np.zeros((20, 20, 3), np.float32)
    pixels[5:15, 5:15] = 2
    pixels[0, 0] = -1e-6
    check_radiance("a.exr", pixels)
    pixels[0, 0] = -1e-5
    with pytest.raises(ImageError, match="1 pixel is negative"):
        check_radiance("a.exr", pixels)


def test_a_capture_clips_and_remembers_how_many(tmp_path):
    scene = make_scene(size=12, lights=4)
    write_capture(tmp_path, scene)
    low = scene.images[2].copy()
    low[3, 3:6, 1] = -0.2
    write_exr(tmp_path / "002.exr", low)
    with pytest.raises(ImageError, match=r"002\.exr: 3 pixels are negative.*: --clip-negative sets such"):
        open_stack(Capture.open(tmp_path))
    capture = Capture.open(tmp_path, PixelChoices(clip_negative=True))
    pixels = Correction.of(capture).apply(capture.manifest.frames[2]).pixels
    np.testing.assert_array_equal(pixels, np.maximum(low, 0).astype(np.float32))
    assert capture.clipped == {"002.exr": 3}
    assert open_stack(capture).clipped == {"002.exr": 3}
    again = Capture.open(tmp_path, PixelChoices(clip_negative=True))
    assert open_stack(again).clipped == again.clipped == {"002.exr": 3}  # from the cache


def test_environments_with_noise_are_read_and_others_are_clipped_on_request(tmp_path):
    sky = dark_subtracted()[:48]
    found = read_environment(write_exr(tmp_path / "sky.exr", sky), "lin_rec709_scene")
    np.testing.assert_array_equal(found, np.maximum(sky, 0))
    sky[:4] = -1
    path = write_exr(tmp_path / "low.exr", sky)
    with pytest.raises(ImageError, match=r"low\.exr: 384 pixels are negative.*--clip-negative"):
        read_environment(path, "lin_rec709_scene")
    clipped = {}
    found = read_environment(path, "lin_rec709_scene", clipped=clipped)
    assert clipped == {"low.exr": 384} and (found[:4] == 0).all()


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
