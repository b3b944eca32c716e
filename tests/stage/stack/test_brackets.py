"""Frames of one light at several exposures: merged by what each gathers, without clipped readings."""

from math import isqrt

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.stack.brackets import merge_brackets, one_frame_a_light
from stage.stack.ingest import open_stack
from tests.scenes.captures import make_scene, write_capture, write_exr, write_manifest

SCENE = make_scene(size=12, lights=4)
EXPOSURES = (4.0, 1.0, 0.25)
LEVEL = 0.2
"""Recorded value at which the camera clips: at 4 s most readings, at 1 s few, at 0.25 s none."""
HALF = 2.0**-10


def bracketed(folder, exposures=EXPOSURES, noise=0.0, strengths=(1.0, 1.0, 1.0)):
    """The scene with every light at each exposure, and the stack that is merged."""
    rng = np.random.default_rng(0)
    write_capture(folder, SCENE)
    frames = []
    for light, image in enumerate(SCENE.images):
        for index, (exposure, strength) in enumerate(zip(exposures, strengths, strict=False)):
            name = f"b{light}{index}.exr"
            recorded = image * exposure * strength
            recorded = np.maximum(recorded + noise * np.sqrt(recorded) * rng.normal(size=recorded.shape), 0)
            write_exr(folder / name, np.minimum(recorded, LEVEL))
            irradiance = strength * SCENE.irradiance[light]
            frames.append({"image": name, "exposure_s": exposure, "light": {
                "type": "distant", "direction": SCENE.directions[light].tolist(), "irradiance": irradiance.tolist()}})
    size = len(SCENE.mask)
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
    np.testing.assert_allclose(radiance(stack), np.repeat(SCENE.images, 3, axis=0), rtol=2 * HALF, atol=1e-6)


def test_lights_of_other_strength_in_one_place_are_merged_in_their_own(tmp_path):
    strengths = (1.0, 0.5, 3.0)
    stack = bracketed(tmp_path, exposures=(1.0, 1.0, 1.0), strengths=strengths)
    expected = (SCENE.images[:, None] * np.array(strengths)[:, None, None, None]).reshape(-1, 12, 12, 3)
    clipped = np.unpackbits(stack.saturated(0, stack.shape[2]), axis=0, bitorder="little")[: stack.light_count, : stack.pixel_count]
    whole = ~clipped.reshape(-1, 12, 12).astype(bool)
    np.testing.assert_allclose(radiance(stack)[whole], expected[whole], rtol=2 * HALF, atol=1e-6)


def test_longer_exposures_count_for_more(tmp_path):
    """Under photon noise of a hundredth of the root of a reading, the merged one has that of all the light gathered together."""
    stack = bracketed(tmp_path, exposures=(0.05, 0.2), noise=0.01)
    lit = SCENE.images > 0.02
    off = (radiance(stack)[::2] - SCENE.images)[lit] / np.sqrt(SCENE.images[lit] / 0.25)
    assert np.std(off) == pytest.approx(0.01, rel=0.1)  # some thousand readings


def test_where_all_are_clipped_the_largest_stands_and_is_marked(tmp_path):
    stack = bracketed(tmp_path, exposures=(4.0, 1.0))
    over = SCENE.images.max(axis=-1) >= LEVEL
    marked = np.unpackbits(stack.saturated(0, stack.shape[2]), axis=0, bitorder="little")[:8:2, :144].reshape(4, 12, 12).astype(bool)
    np.testing.assert_array_equal(marked, over)
    np.testing.assert_allclose(radiance(stack)[::2][over], np.minimum(SCENE.images, LEVEL)[over], rtol=2 * HALF)


def test_single_pixels_are_those_of_the_band(tmp_path):
    stack = bracketed(tmp_path)
    pixels = np.array([5, 17, 18, 100])
    values, bits = stack.pick(pixels)
    np.testing.assert_array_equal(values, stack.band(0, stack.shape[2])[:, :, pixels])
    np.testing.assert_array_equal(bits, stack.saturated(0, stack.shape[2])[:, pixels])
    np.testing.assert_array_equal(bits, stack.pick_saturated(pixels))


def test_a_capture_without_brackets_is_left_as_it_is(tmp_path):
    write_capture(tmp_path, SCENE)
    capture = Capture.open(tmp_path)
    stack = open_stack(capture)
    assert merge_brackets(stack, capture.sources(), distant_lights(capture)) is stack


def test_one_frame_a_light_is_left_for_solvers(tmp_path):
    stack = bracketed(tmp_path)
    one, lights = one_frame_a_light(stack, distant_lights(Capture.open(tmp_path)))
    assert one.frames == ("b00.exr", "b10.exr", "b20.exr", "b30.exr") and one.shape == (3, 8, 192)
    np.testing.assert_allclose(lights.direction, SCENE.directions)
    np.testing.assert_allclose(radiance(one), SCENE.images, rtol=2 * HALF, atol=1e-6)
    assert not one.band(0, 192)[:, 4:].any() and one.saturated(0, 192).shape == (1, 192)
    assert not one.scale[4:].any()
