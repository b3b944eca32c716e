"""Dark, flat, saturation and white balance from images."""

import json

import numpy as np
import pytest

from service.calibrate.sensor import make_flat, mean_image, recorded_values
from service.calibrate.solvers.card_faults import card_faults
from service.calibrate.solvers.saturation_level import ChannelSaturation, ReadingHistogram, capture_saturation
from stage.capture.capture import Capture
from stage.errors import CalibrationError, ImageError
from stage.formats import exr
from stage.stack.correction import Correction
from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_exr, write_image
from tests.scenes.dng import RGGB, XYZ_TO_CAMERA, write_dng

SIZE = 8
BLACK, WHITE = (512, 520, 516, 530), 15000
ROWS, COLS = 32, 40
LIGHT = np.array([0.8, 1.0, 0.45])  # in the primaries of Rec.709
XYZ_FROM_REC709 = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
RNG = np.random.default_rng(4)


@pytest.fixture
def folder(tmp_path):
    return write_capture(tmp_path / "cap", make_scene(SIZE, 3))


def images(folder, name, stack):
    return [write_exr(folder.parent / f"{name}{i}.exr", image) for i, image in enumerate(stack)]


def test_the_mean_and_the_noise_of_one_image(folder):
    rng = np.random.default_rng(0)
    stack = 0.5 + 0.01 * rng.standard_normal((5, SIZE, SIZE, 3)).astype(np.float32)
    mean = mean_image(images(folder, "w", stack), Capture.open(folder))
    np.testing.assert_allclose(mean.pixels, stack.mean(axis=0), rtol=1e-6)
    assert mean.noise == pytest.approx(np.sqrt(stack.var(axis=0).mean()), rel=1e-3) and mean.images == 5
    assert mean_image(images(folder, "w", stack[:1]), Capture.open(folder)).noise == 0


@pytest.mark.parametrize("own_dark", [False, True])
def test_a_card_is_flat_after_correction(folder, own_dark):
    """Vignetting v, dark d of the frames, d' of the card: correction of a frame v·s + d gives s times one number."""
    rng = np.random.default_rng(1)
    vignetting = rng.uniform(0.5, 1, (SIZE, SIZE, 3))
    dark, card_dark = rng.uniform(0.01, 0.02, (2, SIZE, SIZE, 3))
    write_exr(folder / "dark.exr", dark)
    edit_manifest(folder, dark="dark.exr")
    capture = Capture.open(folder)
    white = mean_image(images(folder, "w", [3 * vignetting + (card_dark if own_dark else dark)]), capture)
    flat = make_flat(white, mean_image(images(folder, "d", [card_dark]), capture) if own_dark else None, capture)
    write_exr(folder / "flat.exr", flat)
    write_exr(folder / "000.exr", 0.25 * vignetting + dark)
    edit_manifest(folder, flat="flat.exr")
    capture = Capture.open(folder)
    corrected = Correction.of(capture).apply(capture.manifest.frames[0]).pixels[capture.mask()]
    np.testing.assert_allclose(corrected / corrected.mean(axis=0), 1, rtol=1e-5)  # float32


def test_display_encoded_captures_keep_their_encoding(tmp_path):
    """Averages are of light, not of codes, and what is written reads back as that light."""
    folder = write_capture(tmp_path, make_scene(SIZE, 3), color_space="srgb_texture")
    capture = Capture.open(folder)
    paths = [write_image(tmp_path / f"w{v}.png", np.full((SIZE, SIZE, 3), v, np.uint8)) for v in (50, 200)]
    mean = mean_image(paths, capture)
    linear = srgb_to_linear(np.array([50, 200]) / 255)
    np.testing.assert_allclose(mean.pixels, np.mean(linear), rtol=1e-4)
    encoded = recorded_values(mean.pixels.astype(np.float32), capture)
    np.testing.assert_allclose(srgb_to_linear(encoded), np.mean(linear), rtol=1e-4)
    exr.write(tmp_path / "flat.exr", {c: encoded[..., i] for i, c in enumerate("RGB")}, color_space="srgb_texture", metadata={})
    np.testing.assert_allclose(mean_image([tmp_path / "flat.exr"], capture).pixels, mean.pixels, rtol=1e-4)


def test_cards_that_are_refused(folder):
    edit_manifest(folder, saturation=0.9)
    capture = Capture.open(folder)
    bright = images(folder, "w", [np.full((SIZE, SIZE, 3), 0.95)])
    with pytest.raises(ImageError, match=r"w0.exr: \d+ pixels are at or above the saturation of 0.9"):
        mean_image(bright, capture, refuse_saturated=True)
    with pytest.raises(CalibrationError, match="no image"):
        mean_image([], capture)
    with pytest.raises(ImageError, match=r"w0\.exr: is 4x4"):
        mean_image([write_exr(folder.parent / "w0.exr", np.ones((4, 4, 3)))], capture)
    grey = mean_image(images(folder, "g", [np.full((SIZE, SIZE, 3), 0.1)]), capture)
    with pytest.raises(CalibrationError, match="not brighter than the dark frame at"):
        make_flat(grey, mean_image(images(folder, "d", [np.full((SIZE, SIZE, 3), 0.2)]), capture), capture)


def test_a_clipped_white_card_is_refused_where_the_manifest_says_no_saturation(relit, folder):
    """The largest integer is clipped; a card below it, or one in floating point, is not."""
    levels = np.linspace(200, 400, SIZE * SIZE).reshape(SIZE, SIZE, 1) * np.ones(3)
    card = write_image(folder.parent / "card.png", np.uint8(np.minimum(levels, 255)))
    count = (levels[..., 0][Capture.open(folder).mask()] >= 255).sum()
    assert f"card.png: {count} pixels are at or above the saturation of 1" in relit.refused("calibrate", "flat-field", folder, card)
    relit.done("calibrate", "flat-field", folder, write_image(folder.parent / "darker.png", np.uint8(levels * 0.6)))
    relit.done("calibrate", "flat-field", folder, write_exr(folder.parent / "card.exr", levels / 100))


@pytest.mark.parametrize("kind", ["flat-field", "white-balance"])
def test_a_card_that_is_clipped_below_full_scale_is_refused(relit, tmp_path, kind):
    """Converters of camera raw clip at other values than the largest, and EXR has none: half of the card was read as its middle, and red
    was 8 % too weak. One of several images is enough; with less light the card is right, and even light in eight bits is no clipping."""
    folder = write_capture(tmp_path / "cap", make_scene(64, 3))
    v, u = np.mgrid[-0.7:0.7:64j, -0.7:0.7:64j]
    card = (1 - 0.35 * (u**2 + v**2))[..., None] * (1.1, 0.98, 0.85) + RNG.normal(0, 0.003, (64, 64, 3))
    clipped = write_exr(tmp_path / "clipped.exr", np.minimum(card, 0.9))
    right = write_exr(tmp_path / "right.exr", 0.7 * card)
    assert "clipped.exr" in relit.refused("calibrate", kind, folder, right, clipped)
    relit.done("calibrate", kind, folder, right)
    even = np.rint(200 + RNG.normal(0, 0.3, (64, 64, 3))).astype(np.uint8)
    relit.done("calibrate", kind, folder, write_image(tmp_path / "even.png", even))


def test_a_card_above_the_saturation_of_the_manifest_gives_no_white_balance(relit, folder):
    """Fourteen bits in sixteen end at a quarter of full scale, where every colour becomes grey."""
    edit_manifest(folder, saturation=0.249)
    card = write_exr(folder.parent / "card.exr", np.minimum(np.ones((SIZE, SIZE, 3)) * (0.4, 0.3, 0.2), 0.25))
    assert f"card.exr: {SIZE * SIZE} pixels of the card are saturated" in relit.refused("calibrate", "white-balance", folder, card)
    relit.done("calibrate", "white-balance", folder, write_exr(folder.parent / "card2.exr", np.ones((SIZE, SIZE, 3)) * (0.2, 0.15, 0.1)))


def test_a_dark_image_with_light_in_it_is_refused(relit, tmp_path):
    folder = write_capture(tmp_path / "cap", make_scene(32, 3))
    before = (folder / "capture.json").read_bytes()
    lit = write_exr(tmp_path / "lit.exr", Capture.open(folder).recorded(Capture.open(folder).manifest.frames[0].image))
    assert "are darker than the dark image" in relit.refused("calibrate", "dark", folder, lit)
    assert (folder / "capture.json").read_bytes() == before
    covered = [write_exr(tmp_path / f"{number}.exr", np.abs(RNG.normal(0, 1e-4, (32, 32, 3)))) for number in range(3)]
    relit.done("calibrate", "dark", folder, *covered)
    said = relit.refused("calibrate", "dark", folder, covered[0], lit, *covered[1:])  # its light was a part of the mean, and of its noise
    assert "lit.exr: is brighter than" in said and "cover the lens in all dark images" in said
    card = write_exr(tmp_path / "card.exr", np.full((32, 32, 3), 0.5))
    assert "lit.exr" in relit.refused("calibrate", "flat-field", folder, card, "--dark", covered[0], "--dark", lit)
    relit.done("calibrate", "flat-field", folder, card, "--dark", covered[0], "--dark", covered[1])


V, U = np.mgrid[-0.74:0.74:60j, -0.99:0.99:80j]
LENS = 1 - 0.25 * (V**2 + U**2)


@pytest.mark.parametrize(("light", "words"), [
    (LENS, None),
    (1 - 0.25 * (V**2 + (U - 0.1) ** 2), None),  # of a lens that stands aside of the sensor
    ((1 + ((U - 0.1) ** 2 + (V - 0.1) ** 2) / 1.44) ** -2, None),  # cos⁴ of a wide lens, 5 % of the width and height aside
    (LENS * (1 + 0.2 * U), "falls by"),  # by 33 %, of which a quadratic lens aside may make a part
    ((1 + (U**2 + V**2) / 1.44) ** -2 * (1 + 0.2 * U), "falls by"),
    (LENS * np.where(U > 0.3, 0.6, 1), "uneven by"),
    (LENS * (1 + 0.1 * np.sin(12 * U) * np.sin(9 * V)), "uneven by"),
], ids=["a lens", "aside", "a wide lens aside", "a lamp from the side", "and a wide lens", "a shadow", "an object"])
def test_a_card_that_is_not_evenly_lit_is_said(light, words):
    card = light[..., None] * (0.8, 0.7, 0.6) * (1 + RNG.normal(0, 0.02, (60, 80, 3)))
    faults = card_faults(card, V**2 + U**2 < 1.2)
    assert (faults == ()) if words is None else any(words in fault for fault in faults), faults


def test_a_region_with_more_than_the_card_is_said(relit, tmp_path):
    folder = write_capture(tmp_path / "cap", make_scene(32, 3))
    card = np.linspace(0.3, 0.6, 32)[:, None, None] * np.array((1.0, 0.8, 0.5)) * np.ones((32, 32, 1))
    assert "colours in it differ" not in relit.done("calibrate", "white-balance", folder, write_exr(tmp_path / "card.exr", card)).out
    card[:, 24:] *= (0.6, 1.0, 1.4)
    assert "colours in it differ" in relit.done("calibrate", "white-balance", folder, write_exr(tmp_path / "half.exr", card)).out


def pile(*images):
    histogram = ReadingHistogram(float(max(image.max() for image in images)))
    for image in images:
        histogram.add(image)
    return histogram.saturation()


def test_a_pile_at_the_top():
    rng = np.random.default_rng(2)
    light = rng.exponential(0.4, (3, 7_000))
    found = pile(*np.minimum(light, 0.8))
    assert found.level == pytest.approx(0.792) and found.readings == (light >= 0.792).sum()
    assert pile(*light) == ChannelSaturation(None, 0)
    assert pile(*rng.uniform(0, 1, (3, 7_000))) == ChannelSaturation(None, 0)  # a flat histogram is no pile
    assert pile(np.zeros(100)) == ChannelSaturation(None, 0)
    hot = np.where(rng.random(light.shape) < 0.001, 0.95, np.minimum(light, 0.8))
    assert pile(*hot).level == pytest.approx(0.792, rel=1e-4)  # told apart to 1.5e-5 of the largest value


@pytest.mark.parametrize("bits", [8, 16])
def test_bright_things_are_no_pile(bits):
    """Spheres without noise, of which eight bits have few codes, and half an image at one brightness, with the noise of 60 000 electrons
    or with another one in each image."""
    rng, codes = np.random.default_rng(3), 2**bits - 1
    y, x = np.mgrid[-1:1:121j, -1:1:121j]
    sphere = np.sqrt(np.maximum(1 - x**2 - y**2, 0))
    for peak in (0.1, 0.35, 0.8):
        spheres = [np.rint(codes * sphere * light) / codes for light in (0.7 * peak, 0.9 * peak, peak)]
        assert pile(*spheres) == ChannelSaturation(None, 0)
        backs = [np.where(x > 0, light, ball) for light, ball in zip((0.5, 0.55, 0.6), spheres, strict=True)]
        assert pile(*(np.rint(codes * back) / codes for back in backs)) == ChannelSaturation(None, 0)
        noisy = [np.where(x > 0, 0.6, ball) + 0.004 * rng.standard_normal(x.shape) for ball in spheres]
        assert pile(*(np.rint(codes * np.maximum(back, 0)) / codes for back in noisy)) == ChannelSaturation(None, 0)
        assert pile(*(np.minimum(ball, 0.6 * peak) for ball in spheres)).level == pytest.approx(0.594 * peak, rel=1e-4)


def test_the_least_level_stands_for_all_channels():
    assert capture_saturation([ChannelSaturation(0.9, 50), ChannelSaturation(None, 0), ChannelSaturation(0.71234, 30)]) == 0.7123
    with pytest.raises(CalibrationError, match="no channel piles up"):
        capture_saturation([ChannelSaturation(None, 0)] * 3)


def radiance_of(folder, index=0):
    capture = Capture.open(folder)
    return Correction.of(capture).apply(capture.manifest.frames[index]).pixels


def test_a_card_becomes_grey(relit, tmp_path):
    scene = make_scene(16, 4)
    folder = write_capture(tmp_path / "cap", scene)
    for index, image in enumerate(scene.images):
        write_exr(folder / f"{index:03d}.exr", image * LIGHT)
    card = np.full((16, 16, 3), 0.4) * LIGHT
    card[:, :4] = 0  # the table that it lies on
    outcome = relit.done("calibrate", "white-balance", folder, write_exr(tmp_path / "card.exr", card), "--region", "4,0,12,16")
    assert "gains    1.2500 red, 1.0000 green, 2.2222 blue" in outcome.out
    np.testing.assert_allclose(radiance_of(folder), scene.images[0], rtol=1e-5, atol=1e-6)  # float32, digits of the report
    assert relit("info", folder).code == 0
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--region", "8,8,16,16")
    assert outcome.code == 2 and "--region 8,8,16,16: leads out of the images" in outcome.err
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--region", "0,0,4,4")
    assert outcome.code == 2 and "card.exr: the card is dark in red, green, blue" in outcome.err
    outcome = relit("calibrate", "white-balance", folder, tmp_path / "card.exr", "--sensor-colors")
    assert outcome.code == 2 and "--sensor-colors: is about camera raw files" in outcome.err


def counts_of(rec709):
    """What a sensor with the colour matrix of the file records of one colour, [rows, cols] uint16."""
    camera_from_rec709 = np.array(XYZ_TO_CAMERA) @ XYZ_FROM_REC709
    sensor = camera_from_rec709 @ rec709
    place = 2 * (np.arange(ROWS)[:, None] % 2) + np.arange(COLS) % 2
    levels = np.array(BLACK)[place]
    return np.rint(levels + sensor[np.array(RGGB)[place]] * (WHITE - levels)).astype(np.uint16)


def test_colours_of_camera_raw_become_those_of_the_space(relit, tmp_path):
    pytest.importorskip("rawpy")
    folder = write_capture(tmp_path / "cap", make_scene(8, 3))
    edit_manifest(folder, camera={"projection": "orthographic", "resolution": [COLS, ROWS]}, mask=None)
    colours = [np.array(c) for c in ((0.4, 0.2, 0.1), (0.1, 0.3, 0.2), (0.2, 0.25, 0.4))]
    for index, colour in enumerate(colours):
        write_dng(folder / f"{index}.dng", counts_of(colour))
        edit_frame(folder, index, image=f"{index}.dng")
    write_dng(folder / "card.dng", counts_of(np.full(3, 0.5)))
    relit.done("calibrate", "white-balance", folder, folder / "card.dng")
    for index, colour in enumerate(colours):
        found = radiance_of(folder, index).mean(axis=(0, 1))
        np.testing.assert_allclose(found / found.sum(), colour / colour.sum(), atol=3e-4)  # counts, and four digits of the matrix
    balanced = json.loads((folder / "calibration.json").read_text())["white-balance"]
    assert balanced["unevenness"] == pytest.approx([0, 0, 0], abs=1e-3)
    assert relit("calibrate", "white-balance", folder, folder / "card.dng", "--sensor-colors").code == 0
    matrix = np.array(Capture.open(folder).manifest.color_matrix)
    assert np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0
    write_dng(folder / "over.dng", np.full((ROWS, COLS), WHITE, np.uint16))
    relit("calibrate", "white-balance", folder, folder / "over.dng").refused(f"over.dng: {ROWS * COLS} pixels of the card are saturated")
    write_exr(folder / "card.exr", np.full((ROWS, COLS, 3), 0.5))
    assert "the card and the frames are to be of one kind" in relit.refused("calibrate", "white-balance", folder, folder / "card.exr")
