"""Correction of recorded values, and exposures of one light merged."""

from math import isqrt

import numpy as np
import pytest

from stage.capture.capture import Capture, PixelChoices
from stage.capture.lighting import distant_lights
from stage.errors import ImageError
from stage.stack.brackets import merge_brackets, one_frame_a_light
from stage.stack.correction import CodedRadiance, Correction, Radiance
from stage.stack.ingest import open_stack
from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, manifest_of, write_capture, write_exr, write_image, write_manifest

SCENE = make_scene(size=8, lights=4)
RNG = np.random.default_rng(11)
DARK = 0.01 + 0.01 * RNG.random((8, 8, 3)).astype(np.float32)
FLAT = 0.5 + RNG.random((8, 8, 3)).astype(np.float32)
ROUNDING = {"rtol": 1e-5, "atol": 1e-6}  # a handful of float32 operations on values up to one
BRACKETED = make_scene(size=12, lights=4)
EXPOSURES = (4.0, 1.0, 0.25)
LEVEL = 0.2
"""Recorded value at which the camera clips: at 4 s most readings, at 1 s few, at 0.25 s none."""
HALF = 2.0**-10


def corrected(folder, index=0):
    capture = Capture.open(folder)
    return Correction.of(capture).apply(capture.sources()[index])


def test_nothing_declared_is_nothing_done(tmp_path):
    radiance = corrected(write_capture(tmp_path, SCENE), 1)
    assert np.array_equal(radiance.pixels, SCENE.images[1].astype(np.float32))
    assert radiance.saturated is None


def test_dark_flat_exposure_and_ambient_together(tmp_path):
    write_capture(tmp_path, SCENE)
    write_exr(tmp_path / "dark.exr", DARK)
    write_exr(tmp_path / "flat.exr", FLAT)
    edit_manifest(tmp_path, dark="dark.exr", flat="flat.exr")
    exposures = [0.5, 0.25, 2.0, 4.0]
    images = [image * (0.1 if index > 1 else 1.0) for index, image in enumerate(SCENE.images)]
    recorded = [(DARK + image * exposure).astype(np.float32) for image, exposure in zip(images, exposures, strict=True)]
    for index, (image, exposure) in enumerate(zip(recorded, exposures, strict=True)):
        write_exr(tmp_path / f"{index:03d}.exr", image)
        edit_frame(tmp_path, index, exposure_s=exposure)
    edit_frame(tmp_path, 3, light={"type": "off"})
    edit_frame(tmp_path, 2, light={"type": "off"})

    dark, gain = DARK.astype(np.float64), FLAT.astype(np.float64) - DARK
    gain /= gain[SCENE.mask].mean(axis=0)
    linear = [(image - dark) / gain / exposure for image, exposure in zip(recorded, exposures, strict=True)]
    ambient = (linear[2] + linear[3]) / 2
    for index in (0, 1):
        assert np.allclose(corrected(tmp_path, index).pixels, linear[index] - ambient, **ROUNDING)
    # the matrix of the capture, and that of a frame in its place, each on what is left without the ambient light
    common, own = np.array([[1.6, -0.5, -0.1], [-0.2, 1.5, -0.3], [0, -0.4, 1.4]]), np.array([[2.0, 0, 0], [0.1, 1, 0], [0, 0, 0.5]])
    edit_manifest(tmp_path, color_matrix=common.tolist())
    edit_frame(tmp_path, 1, color_matrix=own.tolist())
    edit_frame(tmp_path, 2, color_matrix=own.tolist())  # of an off frame: it is of no account
    for index, matrix in ((0, common), (1, own)):
        assert np.allclose(corrected(tmp_path, index).pixels, (linear[index] - ambient) @ matrix.T, **ROUNDING)


def test_the_flat_keeps_the_mean_over_the_mask_and_takes_its_shape_away(tmp_path):
    """A scene seen through a vignette comes back as the scene."""
    vignette = np.where(SCENE.mask[..., None], FLAT / FLAT[SCENE.mask].mean(axis=0), 0.3)
    write_capture(tmp_path, SCENE)
    write_exr(tmp_path / "000.exr", SCENE.images[0] * vignette)
    write_exr(tmp_path / "flat.exr", 7 * vignette)
    edit_manifest(tmp_path, flat="flat.exr")
    assert np.allclose(corrected(tmp_path).pixels[SCENE.mask], SCENE.images[0][SCENE.mask], **ROUNDING)


def test_a_flat_that_is_dark_inside_the_mask_is_named(tmp_path):
    write_capture(tmp_path, SCENE)
    flat = FLAT.copy()
    flat[4, 4] = flat[4, 5] = 0
    write_exr(tmp_path / "flat.exr", flat)
    edit_manifest(tmp_path, flat="flat.exr")
    with pytest.raises(ImageError, match=r"flat\.exr: flat is not above dark at 2 of the mask's pixels"):
        Correction.of(Capture.open(tmp_path))
    flat[4, 4] = flat[4, 5] = 1
    flat[0, 0] = 0  # outside the mask it is nobody's business
    write_exr(tmp_path / "flat.exr", flat)
    assert np.isfinite(corrected(tmp_path).pixels).all()


def test_saturation_is_judged_on_recorded_values_in_any_channel(tmp_path):
    image = np.full((8, 8, 3), 0.5, np.float32)
    image[1, 2, 0], image[3, 4, 2], image[5, 6, 1] = 0.9, 0.95, 0.899
    write_capture(tmp_path, SCENE, saturation=0.9)
    write_exr(tmp_path / "000.exr", image)
    write_exr(tmp_path / "dark.exr", DARK)
    edit_manifest(tmp_path, dark="dark.exr")  # dark does not move the limit
    assert np.argwhere(corrected(tmp_path).saturated).tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize(("limit", "first"), [(200 / 255, 200), (0.5, 128), (1.0, 255), (1.5, 256)])
def test_saturation_of_integers_begins_at_the_first_that_stands_for_as_much(tmp_path, limit, first):
    codes = np.arange(192, dtype=np.uint8).reshape(8, 8, 3) + 64
    write_image(tmp_path / "000.png", codes)
    data = manifest_of(SCENE, mask=None, saturation=limit)
    write_manifest(tmp_path, {**data, "frames": [{**data["frames"][0], "image": "000.png"}]})
    assert np.array_equal(corrected(tmp_path).saturated, (codes >= first).any(axis=-1))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_integers_with_the_table_of_their_radiance_are_the_corrected_pixels(tmp_path, dtype):
    write_image(tmp_path / "000.png", RNG.integers(0, np.iinfo(dtype).max, (8, 8, 3)).astype(dtype))
    data = manifest_of(SCENE, color_space="srgb_texture", mask=None)
    write_manifest(tmp_path, {**data, "frames": [{**data["frames"][0], "image": "000.png", "exposure_s": 0.25}]})
    capture = Capture.open(tmp_path)
    frame, without = capture.sources()[0], Correction.of(capture)
    coded = without.coded(frame)
    assert isinstance(coded, CodedRadiance)
    assert coded.codes.dtype == dtype
    assert (np.diff(coded.values) >= 0).all()
    flat = Correction(capture, None, np.ones((8, 8, 3), np.float32), None)  # which divides every pixel by one
    assert isinstance(flat.coded(frame), Radiance)
    assert np.array_equal(without.apply(frame).pixels, coded.values[coded.codes])
    assert np.array_equal(without.apply(frame).pixels, flat.apply(frame).pixels)


@pytest.mark.parametrize("limit", [0.0625, 0.3, 5.0])
def test_half_values_with_the_table_of_their_radiance_are_the_corrected_pixels(tmp_path, limit):
    image = RNG.normal(0, 0.01, (64, 64, 3)).astype(np.float16)  # noise around zero, as after the subtraction of a dark image
    image[:32] += np.float16(0.3)
    image[3, 5, 1] = limit
    write_exr(tmp_path / "000.exr", image, np.float16)
    data = manifest_of(SCENE, mask=None, saturation=limit)
    data["camera"]["resolution"] = [64, 64]
    write_manifest(tmp_path, {**data, "frames": [{**data["frames"][0], "image": "000.exr", "exposure_s": 0.3}]})
    capture = Capture.open(tmp_path)
    frame, without = capture.sources()[0], Correction.of(capture)
    coded = without.coded(frame)
    assert isinstance(coded, CodedRadiance)
    assert without.has_codes(frame)
    flat = Correction(capture, None, np.ones((64, 64, 3), np.float32), None)  # which divides every pixel by one
    assert isinstance(flat.coded(frame), Radiance)
    assert np.array_equal(without.apply(frame).pixels, flat.apply(frame).pixels)
    wanted = (image.astype(np.float32) >= np.float32(limit)).any(axis=-1)
    assert np.array_equal(coded.saturated, wanted)
    assert wanted[3, 5] == (np.float32(np.float16(limit)) >= np.float32(limit))


def test_display_encoded_frames_are_linearised_dark_and_all(tmp_path):
    codes = {name: RNG.integers(low, high, (8, 8, 3)).astype(np.uint8) for name, low, high in (("000", 60, 255), ("dark", 0, 30))}
    for name, values in codes.items():
        write_image(tmp_path / f"{name}.png", values)
    data = manifest_of(SCENE, color_space="srgb_texture", mask=None, dark="dark.png")
    write_manifest(tmp_path, {**data, "frames": [{**data["frames"][0], "image": "000.png"}]})
    linear = {name: srgb_to_linear(values / 255) for name, values in codes.items()}
    # OpenColorIO's curve is 3e-4 off IEC's at most (tests/stage/colour/test_radiance.py)
    assert np.allclose(corrected(tmp_path).pixels, linear["000"] - linear["dark"], rtol=1e-3, atol=1e-5)


def test_noise_below_dark_stays_negative(tmp_path):
    noise = 0.002 * np.random.default_rng(4).standard_normal((64, 64, 3)).astype(np.float32)
    write_capture(tmp_path, make_scene(size=64, lights=4))
    write_exr(tmp_path / "000.exr", 0.01 + noise)
    write_exr(tmp_path / "dark.exr", np.full((64, 64, 3), 0.01, np.float32))
    edit_manifest(tmp_path, dark="dark.exr")
    assert np.allclose(corrected(tmp_path).pixels, noise, **ROUNDING)


@pytest.mark.parametrize("kind", ["dark", "off", "dark, integers"])
def test_dark_images_that_are_brighter_than_the_others_are_refused(tmp_path, kind):
    """Readings of two thirds of an object were below zero, and pictures of it dark, without a word."""
    write_capture(tmp_path, SCENE)
    bright = SCENE.images[0] + 0.02
    if kind == "off":
        write_exr(tmp_path / "003.exr", bright)
        edit_frame(tmp_path, 3, light={"type": "off"})
    elif kind == "dark":
        write_exr(tmp_path / "dark.exr", bright)
        edit_manifest(tmp_path, dark="dark.exr")
    else:
        write_image(tmp_path / "000.png", np.rint(65535 * SCENE.images[0]).astype(np.uint16))
        write_image(tmp_path / "dark.png", np.rint(65535 * bright).astype(np.uint16))
        edit_frame(tmp_path, 0, image="000.png")
        edit_manifest(tmp_path, dark="dark.png")
    with pytest.raises(ImageError, match=r"000\.(exr|png): .*(dark|off).* is brighter at 52 of 52 pixels"):
        corrected(tmp_path)
    capture = Capture.open(tmp_path, PixelChoices(clip_negative=True))
    assert Correction.of(capture).apply(capture.sources()[0]).pixels.min() == 0 and capture.clipped


def test_a_dark_image_of_a_code_more_is_rounding(tmp_path):
    write_capture(tmp_path, SCENE)
    for name, code in (("000", 6), ("dark", 7)):
        write_image(tmp_path / f"{name}.png", np.full((8, 8, 3), code, np.uint8))
    edit_frame(tmp_path, 0, image="000.png")
    edit_manifest(tmp_path, dark="dark.png")
    assert np.allclose(corrected(tmp_path).pixels, -1 / 255, **ROUNDING)


@pytest.mark.parametrize("name", ["dark.exr", "flat.exr", "000.exr"])
@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_impossible_values_are_named_in_every_kind_of_frame(tmp_path, name, value):
    write_capture(tmp_path, SCENE)
    for file in ("dark.exr", "flat.exr"):
        write_exr(tmp_path / file, DARK if file == "dark.exr" else FLAT)
    bad = np.full((8, 8, 3), 0.5)
    bad[2, 3, 1] = value
    write_exr(tmp_path / name, bad)
    edit_manifest(tmp_path, dark="dark.exr", flat="flat.exr")
    with pytest.raises(ImageError, match=rf"{name}: 1 pixel is .*, the first at row 2, column 3"):
        corrected(tmp_path)


def bracketed(folder, exposures=EXPOSURES, noise=0.0, strengths=(1.0, 1.0, 1.0)):
    """The scene with every light at each exposure, and the stack that is merged."""
    rng = np.random.default_rng(0)
    write_capture(folder, BRACKETED)
    frames = []
    for light, image in enumerate(BRACKETED.images):
        for index, (exposure, strength) in enumerate(zip(exposures, strengths, strict=False)):
            name = f"b{light}{index}.exr"
            recorded = image * exposure * strength
            recorded = np.maximum(recorded + noise * np.sqrt(recorded) * rng.normal(size=recorded.shape), 0)
            write_exr(folder / name, np.minimum(recorded, LEVEL))
            irradiance = strength * BRACKETED.irradiance[light]
            frames.append({"image": name, "exposure_s": exposure, "light": {
                "type": "distant", "direction": BRACKETED.directions[light].tolist(), "irradiance": irradiance.tolist()}})
    size = len(BRACKETED.mask)
    write_manifest(folder, {"schema": "relit.capture/1", "name": "b", "saturation": LEVEL, "frames": frames,
                            "camera": {"projection": "orthographic", "resolution": [size, size]}})
    capture = Capture.open(folder)
    return merge_brackets(open_stack(capture), capture.sources(), distant_lights(capture))


def radiance(stack):
    """[frames, rows, cols, 3]"""
    values = stack.band(0, stack.shape[2])[:, : stack.light_count, : stack.pixel_count].astype(float)
    side = isqrt(stack.pixel_count)
    return np.moveaxis(values * stack.scale[: stack.light_count, None], 0, -1).reshape(stack.light_count, side, side, 3)


def test_every_frame_of_a_bracket_has_the_whole_reading(tmp_path):
    """To half rounding of images and of their mean, although the first frame of each light is clipped at most pixels."""
    stack = bracketed(tmp_path)
    assert not stack.saturated(0, stack.shape[2]).any()
    np.testing.assert_allclose(radiance(stack), np.repeat(BRACKETED.images, 3, axis=0), rtol=2 * HALF, atol=1e-6)


def test_lights_of_other_strength_in_one_place_are_merged_in_their_own(tmp_path):
    strengths = (1.0, 0.5, 3.0)
    stack = bracketed(tmp_path, exposures=(1.0, 1.0, 1.0), strengths=strengths)
    expected = (BRACKETED.images[:, None] * np.array(strengths)[:, None, None, None]).reshape(-1, 12, 12, 3)
    clipped = np.unpackbits(stack.saturated(0, stack.shape[2]), axis=0, bitorder="little")[: stack.light_count, : stack.pixel_count]
    whole = ~clipped.reshape(-1, 12, 12).astype(bool)
    np.testing.assert_allclose(radiance(stack)[whole], expected[whole], rtol=2 * HALF, atol=1e-6)


def test_longer_exposures_count_for_more(tmp_path):
    """Under photon noise of a hundredth of the root of a reading, the merged one has that of all the light gathered together."""
    stack = bracketed(tmp_path, exposures=(0.05, 0.2), noise=0.01)
    lit = BRACKETED.images > 0.02
    off = (radiance(stack)[::2] - BRACKETED.images)[lit] / np.sqrt(BRACKETED.images[lit] / 0.25)
    assert np.std(off) == pytest.approx(0.01, rel=0.1)  # some thousand readings


def test_where_all_are_clipped_the_largest_stands_and_is_marked(tmp_path):
    stack = bracketed(tmp_path, exposures=(4.0, 1.0))
    over = BRACKETED.images.max(axis=-1) >= LEVEL
    marked = np.unpackbits(stack.saturated(0, stack.shape[2]), axis=0, bitorder="little")[:8:2, :144].reshape(4, 12, 12).astype(bool)
    np.testing.assert_array_equal(marked, over)
    np.testing.assert_allclose(radiance(stack)[::2][over], np.minimum(BRACKETED.images, LEVEL)[over], rtol=2 * HALF)


def test_single_pixels_are_those_of_the_band(tmp_path):
    stack = bracketed(tmp_path)
    pixels = np.array([5, 17, 18, 100])
    values, bits = stack.pick(pixels)
    np.testing.assert_array_equal(values, stack.band(0, stack.shape[2])[:, :, pixels])
    np.testing.assert_array_equal(bits, stack.saturated(0, stack.shape[2])[:, pixels])
    np.testing.assert_array_equal(bits, stack.pick_saturated(pixels))


def test_a_capture_without_brackets_is_left_as_it_is(tmp_path):
    write_capture(tmp_path, BRACKETED)
    capture = Capture.open(tmp_path)
    stack = open_stack(capture)
    assert merge_brackets(stack, capture.sources(), distant_lights(capture)) is stack


def test_one_frame_a_light_is_left_for_solvers(tmp_path):
    stack = bracketed(tmp_path)
    one, lights = one_frame_a_light(stack, distant_lights(Capture.open(tmp_path)))
    assert one.frames == ("b00.exr", "b10.exr", "b20.exr", "b30.exr") and one.shape == (3, 8, 192)
    np.testing.assert_allclose(lights.direction, BRACKETED.directions)
    np.testing.assert_allclose(radiance(one), BRACKETED.images, rtol=2 * HALF, atol=1e-6)
    assert not one.band(0, 192)[:, 4:].any() and one.saturated(0, 192).shape == (1, 192)
    assert not one.scale[4:].any()
