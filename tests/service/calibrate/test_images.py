"""Dark, flat and saturation: what correction does with them afterwards is the test."""

import numpy as np
import pytest

from service.calibrate.images import ChannelSaturation, TopHistogram, capture_saturation, make_flat, mean_image, recorded_values
from stage.capture.capture import Capture
from stage.errors import CalibrationError, ImageError
from stage.formats import exr
from stage.stack.correction import Correction
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr, write_image

SIZE = 8


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
    linear = [((v / 255 + 0.055) / 1.055) ** 2.4 for v in (50, 200)]
    np.testing.assert_allclose(mean.pixels, np.mean(linear), rtol=1e-4)
    encoded = recorded_values(mean.pixels.astype(np.float32), capture)
    np.testing.assert_allclose(((encoded + 0.055) / 1.055) ** 2.4, np.mean(linear), rtol=1e-4)
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


def pile(values, peak=None):
    top = TopHistogram(float(values.max() if peak is None else peak))
    for part in np.array_split(values, 3):
        top.add(part)
    return top.saturation()


def test_a_pile_at_the_top():
    rng = np.random.default_rng(2)
    light = rng.exponential(0.4, 20_000)
    found = pile(np.minimum(light, 0.8) + 0.001 * rng.standard_normal(20_000))
    assert found.level == pytest.approx(0.8, rel=0.02) and found.readings > 2000
    assert pile(light) == ChannelSaturation(None, 0)
    assert pile(rng.uniform(0, 1, 20_000)) == ChannelSaturation(None, 0)  # a flat histogram is no pile
    assert pile(np.zeros(100)) == ChannelSaturation(None, 0)


def test_the_least_level_stands_for_all_channels():
    assert capture_saturation([ChannelSaturation(0.9, 50), ChannelSaturation(None, 0), ChannelSaturation(0.71234, 30)]) == 0.7123
    with pytest.raises(CalibrationError, match="no channel piles up"):
        capture_saturation([ChannelSaturation(None, 0)] * 3)
