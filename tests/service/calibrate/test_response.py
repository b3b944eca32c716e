"""The response of a projector from images of its grey levels."""

import numpy as np
import pytest

from service.calibrate.response import fit_response
from stage.capture.capture import Capture
from stage.errors import CalibrationError
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_image

COLS = 40
RNG = np.random.default_rng(4)
AMBIENT, SCALE = RNG.uniform(0.02, 0.1, 500), np.where(np.arange(500) < 400, RNG.uniform(0.2, 0.8, 500), 0.0)


def grey_images(levels, curve, noise=0.0):
    clean = AMBIENT + SCALE * curve(np.asarray(levels))[:, None]
    return (clean + RNG.normal(0, noise, clean.shape)).astype(np.float32)


@pytest.mark.parametrize("gamma", [0.5, 1.0, 2.2])
def test_a_power_law_is_found(gamma):
    levels = np.linspace(0, 1, 9)
    found = fit_response(levels, grey_images(levels, lambda x: x**gamma))
    assert found.gamma == pytest.approx(gamma, rel=1e-3)
    assert np.abs(found.values - np.linspace(0, 1, 256) ** gamma).max() < 1e-3
    assert (np.diff(found.values) > 0).all() and found.values[0] == 0 and found.values[-1] == 1


def test_levels_in_any_order_noise_and_an_s_curve():
    levels = np.linspace(0, 1, 17)[RNG.permutation(17)]

    def curve(x):
        return x * x * (3 - 2 * x)

    found = fit_response(levels, grey_images(levels, curve, noise=0.01))
    assert np.abs(found.values - curve(np.linspace(0, 1, 256))).max() < 0.01
    assert 0.002 < found.spread < 0.05


def test_saturated_pixels_take_no_part():
    levels = np.linspace(0, 1, 9)
    seen = grey_images(levels, lambda x: x)
    cut = np.minimum(seen, 0.3)
    found = fit_response(levels, cut, usable=(seen < 0.3).all(axis=0))
    assert np.abs(found.values - np.linspace(0, 1, 256)).max() < 1e-3


def squared(images):
    return 0.9 * np.clip(images, 0, None) ** 0.5


@pytest.mark.parametrize(("change", "words"), [
    (lambda images: images, None),
    (squared, "not linear in light"),
    (lambda images: images * np.linspace(1, 0.6, 9)[:, None], "gets darker with the level"),
    (lambda images: images * (1 + 0.1 * np.sin(17 * np.arange(9)))[:, None], "not linear in light, or exposure"),
    (lambda images: images[[0, 1, 2, 3, 4, 4, 5, 7, 8]], "the light of level 0.75"),
    (lambda images: images + RNG.normal(0, 0.05, images.shape), "give brighter images"),
], ids=["right", "gamma of the camera", "automatic exposure", "flicker", "a level shown twice", "noise"])
def test_images_that_contradict_the_response_are_said(change, words):
    """Pixels that read between nothing and half of full scale of the projector, under light of the room."""
    levels, scale = np.linspace(0, 1, 9), np.concatenate([np.zeros(200), np.linspace(0.1, 0.5, 2000)])
    images = change(0.05 + scale * (levels**2.2)[:, None] + RNG.normal(0, 0.002, (9, 2200))).astype(np.float32)
    found = fit_response(levels, images)
    assert (found.faults == ()) if words is None else any(words in fault for fault in found.faults), found.faults


def video(levels):
    return np.clip((255 * levels - 16) / 219, 0, 1) ** 2.2


@pytest.mark.parametrize(("light", "words"), [
    (lambda levels: levels**2.2, None),
    (video, None),
    (lambda levels: levels * levels * (3 - 2 * levels), None),
    (lambda levels: np.minimum(levels**2.2, 0.65), "does not rise above level 0.875"),
    (lambda levels: levels**2.2 * (1 + 0.03 * np.random.default_rng(5).standard_normal(levels.size)), "% from level to level"),
], ids=["power", "black and white of video", "S", "clipped", "flicker"])
def test_an_even_wall_tells_of_clipped_and_of_flickering_light(light, words):
    levels = np.linspace(0, 1, 17)
    images = 0.3 * light(levels)[:, None] + RNG.normal(0, 0.001, (17, 2000))
    faults = fit_response(levels, images.astype(np.float32)).faults
    assert (faults == ()) if words is None else any(words in fault for fault in faults), faults


def test_readings_at_full_scale_of_an_image_take_no_part(relit, tmp_path):
    """Most pixels of 8-bit images clip at the brighter levels, and no saturation is declared."""
    folder = write_capture(tmp_path / "cap", make_scene(COLS, 3))
    levels, lit = np.linspace(0, 1, 9), np.linspace(0.2, 4, COLS)
    edit_manifest(folder, mask=None, color_space="lin_rec709_scene", projector={"resolution": [64, 48]})
    for number, level in enumerate(levels):
        seen = np.clip(255 * (0.02 + lit * level**2.2), 0, 255).round().astype(np.uint8)
        write_image(folder / f"grey{number}.png", np.broadcast_to(seen[None, :, None], (COLS, COLS, 3)))
    relit.done("calibrate", "response", folder, *(folder / f"grey{number}.png" for number in range(9)))
    response = Capture.open(folder).manifest.projector.response
    assert np.abs(np.array(response) - np.linspace(0, 1, 256) ** 2.2).max() < 0.005  # half a step of the file is 0.004


@pytest.mark.parametrize(("levels", "curve", "words"), [
    ([0, 1], lambda x: x, "three or more"),
    ([0, 0.5, 0.9], lambda x: x, "with 0 and 1"),
    ([0, 0.5, 0.5, 1], lambda x: x, "three or more different"),
    ([0, 0.3, 0.6, 1], lambda x: np.where(x == 0.6, 0.1, x), "the light falls from level 0.3 to 0.6"),
    ([0, 0.5, 1], lambda x: 0 * x, "only 0 pixels get brighter"),
])
def test_what_cannot_be_a_response_is_named(levels, curve, words):
    with pytest.raises(CalibrationError, match=words):
        fit_response(levels, grey_images(levels, curve))


def test_few_levels_of_a_wall_accuse_nothing():
    """Groups of pixels were chosen by the noise that they were judged by: three or four levels of a wall were called bent."""
    random = np.random.default_rng(6)
    for count in (3, 4, 5, 9):
        levels = np.linspace(0, 1, count)
        clean = 0.05 + random.uniform(0.3, 0.6, 15_000).round(1) * (levels**2.2)[:, None]
        assert fit_response(levels, (clean + random.normal(0, 0.01, clean.shape)).astype(np.float32)).faults == ()


@pytest.mark.parametrize(("count", "curve", "words"), [
    (9, video, "between its levels the light is known to"),
    (9, lambda levels: levels**4, "the response is nearest to level^4"),
    (9, lambda levels: np.maximum(levels - 0.3, 0) ** 2, "the light does not rise up to level 0.25"),
    (3, lambda levels: np.where(levels < 1, 0.0, 1.0), "the light does not rise up to level 0.5"),
], ids=["few levels", "encoded", "dark levels", "a level shown twice"])
def test_what_levels_leave_open_is_said(count, curve, words):
    """A response that bends between its levels was 0.08 of full scale off, linear images declared encoded ones 0.24, without a word."""
    levels = np.linspace(0, 1, count)
    found = fit_response(levels, grey_images(levels, curve, noise=0.001))
    assert [words in fault for fault in found.faults] == [True], found.faults
    assert (found.between is None) == (count == 3)


@pytest.mark.parametrize("curve", [lambda x: x * x * (3 - 2 * x), lambda x: 0.5 * x**2.2 + 0.5 * (3 * x**2 - 2 * x**3)], ids=["S", "panel"])
def test_smooth_curves_are_followed_between_few_levels(curve):
    """Interpolated along straight lines they were 0.010 and 0.004 off; what the levels themselves tell is never less than the error."""
    levels = np.linspace(0, 1, 9)
    found = fit_response(levels, grey_images(levels, curve))
    error = np.abs(found.values - curve(np.linspace(0, 1, 256))).max()
    assert error < 0.004 and error < found.between < 0.02


def test_images_in_the_wrong_order_and_clipped_ones_are_refused_apart():
    levels = np.linspace(0, 1, 5)
    seen = grey_images(levels, lambda x: x**2.2, noise=0.001)
    with pytest.raises(CalibrationError, match="only 0 pixels get brighter"):
        fit_response(levels, seen[::-1])
    with pytest.raises(CalibrationError, match="3 saturate in no image: shorten the exposure"):
        fit_response(levels, seen, usable=np.arange(500) < 3)


def test_images_of_another_exposure_are_refused(relit, tmp_path):
    """A level that was exposed for twice as long made a response that was 0.28 of full scale off, and on an even wall nothing told it."""
    folder = write_capture(tmp_path / "cap", make_scene(COLS, 3))
    edit_manifest(folder, mask=None, color_space="lin_rec709_scene", projector={"resolution": [64, 48]})
    for number, time in enumerate((0.01, 0.02, 0.01)):
        write_image(folder / f"grey{number}.tif", np.full((COLS, COLS, 3), 50 * number + 10, np.uint8), ExposureTime=time)
    words = relit.refused("calibrate", "response", folder, *(folder / f"grey{number}.tif" for number in range(3)))
    assert "EXIF has 0.01 as the exposure time" in words and "0.02 in grey1.tif" in words
