"""Polarised pairs and spherical gradients: which frames make them up, and when they determine what is asked of them."""

import json

import numpy as np
import pytest

from service.solve.methods.pairs import examine_pairs
from stage.capture.capture import Capture
from stage.capture.gradients import gradient_frames, has_gradients
from stage.capture.lighting import distant_lights, has_placeholders
from stage.capture.polarised_pairs import Component
from stage.errors import ManifestError
from stage.stack.brackets import merge_brackets, one_frame_a_light
from stage.stack.ingest import open_stack
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, write_capture, write_exr
from tests.scenes.polarised import PEDESTAL, polarised_scene, write_polarised
from tests.stage.capture.test_light import capture_of
from tests.stage.stack.test_correction import radiance

SCENE = polarised_scene(size=24, lights=12)
HALF = 2.0**-10
FULL = {"type": "full"}


def separated(folder, component, leak=0.0):
    capture = Capture.open(folder)
    lights = distant_lights(capture)
    merged = merge_brackets(open_stack(capture), capture.sources(), lights, component=component, leak=leak)
    return one_frame_a_light(merged, lights)


@pytest.mark.parametrize("leak", [0.0, 0.02, 0.2])
@pytest.mark.parametrize("exposures", [(), (1.0, 0.25)])
def test_both_parts_are_told_apart_exactly(tmp_path, leak, exposures):
    """To half rounding of each image relative to its brightest value, which the factors of leaking polarisers multiply."""
    write_polarised(tmp_path, SCENE, leak=leak, exposures=exposures)
    whole = SCENE.diffuse + SCENE.specular
    for component, expected in ((Component.DIFFUSE, SCENE.diffuse), (Component.SPECULAR, SCENE.specular), (Component.WHOLE, whole)):
        stack, lights = separated(tmp_path, component, leak)
        assert stack.light_count == len(SCENE.directions) == len(lights.direction)
        gain = sum(map(abs, component.gains(leak)))
        np.testing.assert_allclose(radiance(stack), expected, atol=2 * HALF * gain * whole.max())
        np.testing.assert_allclose(radiance(stack).sum(), expected.sum(), rtol=1e-3)


def test_noise_of_a_part_is_that_of_its_images_times_the_factors_and_stays_below_zero(tmp_path):
    """Of the dark paint quarter, which has no highlight, S is noise around zero: its mean within four standard errors of zero."""
    write_polarised(tmp_path, SCENE, noise=0.05, leak=0.02)
    specular = radiance(separated(tmp_path, Component.SPECULAR, 0.02)[0])[:, SCENE.of("paint")]
    crossed, along = (radiance(separated(tmp_path, part)[0])[:, SCENE.of("paint")] for part in (Component.CROSS, Component.PARALLEL))
    truth = SCENE.diffuse[:, SCENE.of("paint")] / 2
    expected = np.hypot((crossed - truth).std(), (along - truth).std()) / (1 - 2 * 0.02)
    assert specular.std() == pytest.approx(expected, rel=0.05)
    assert abs(specular.mean()) < 4 * specular.std() / np.sqrt(specular.size)
    assert (specular < 0).mean() == pytest.approx(0.5, abs=0.02)


def test_a_pair_clipped_in_one_image_is_clipped(tmp_path):
    write_polarised(tmp_path, SCENE)
    limit = 0.5
    edit_manifest(tmp_path, saturation=limit + PEDESTAL)
    bits = separated(tmp_path, Component.DIFFUSE)[0].saturated(0, 576)
    clipped = np.unpackbits(bits, axis=0, bitorder="little")[: len(SCENE.directions), :576].reshape(-1, 24, 24).astype(bool)
    along = SCENE.diffuse / 2 + SCENE.specular
    sure = np.abs(along - limit).min(axis=-1) > 1e-3
    np.testing.assert_array_equal(clipped[sure], (along >= limit).any(axis=-1)[sure])


def examine(folder):
    stacks = [separated(folder, part)[0] for part in (Component.CROSS, Component.PARALLEL)]
    names = [(name, name.replace("cross", "parallel")) for name in stacks[0].frames]
    return examine_pairs(*stacks, names, SCENE.surface.mask)


@pytest.mark.parametrize("leak", [0.0, 0.02])
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_pairs_that_fit_are_not_doubted_and_bound_the_leak(tmp_path, leak, noise):
    """The metal shows the leak itself; 3 standard errors of 24 lights' sums are added."""
    write_polarised(tmp_path, SCENE, leak=leak, noise=noise)
    found = examine(tmp_path)
    assert found.fault is None
    assert found.leak_at_most is not None and leak - 1e-4 <= found.leak_at_most < leak + 0.05


def test_one_swapped_pair_is_named(tmp_path):
    write_polarised(tmp_path, SCENE, noise=0.01)
    crossed, along = tmp_path / "003_0_cross.exr", tmp_path / "003_0_parallel.exr"
    crossed.rename(tmp_path / "x.exr")
    along.rename(crossed)
    (tmp_path / "x.exr").rename(along)
    assert "003_0_parallel.exr" in examine(tmp_path).fault and "swapped" in examine(tmp_path).fault


@pytest.mark.parametrize("shift", [1, 3])
def test_a_shifted_pair_is_named(tmp_path, shift):
    write_polarised(tmp_path, SCENE, noise=0.01)
    image = SCENE.diffuse[5] / 2 + SCENE.specular[5]
    write_exr(tmp_path / "005_0_parallel.exr", np.roll(image, shift, axis=1) + PEDESTAL)
    assert "005_0_parallel.exr" in examine(tmp_path).fault


def test_images_without_partners_are_named(tmp_path):
    write_polarised(tmp_path, SCENE)
    pairs = json.loads((tmp_path / "capture.json").read_text())["frames"]
    edit_manifest(tmp_path, frames=[*pairs[:5], *pairs[6:]])
    with pytest.raises(ManifestError, match=r"frames\[4\].light.polarization: is cross, and no parallel"):
        distant_lights(Capture.open(tmp_path))
    edit_manifest(tmp_path, frames=pairs)
    edit_frame(tmp_path, 3, light={**pairs[3]["light"], "polarization": "none"})
    with pytest.raises(ManifestError, match=r"frames\[3\].light.polarization: is none where other lights"):
        distant_lights(Capture.open(tmp_path))


def test_polarised_placeholders_are_placeholders(tmp_path):
    write_polarised(tmp_path, SCENE)
    edit_manifest(tmp_path, frames=lambda frames: [
        frame | {"light": frame["light"] | {"direction": [0, 0, 1], "irradiance": [1, 1, 1]}} for frame in frames])
    assert has_placeholders(Capture.open(tmp_path))


def gradient(axis: str, sign: int = 1, polarization: str = "none") -> dict:
    return {"type": "gradient", "axis": axis, "sign": sign, "polarization": polarization}


def test_rows_are_mean_and_dipole_in_the_order_of_the_stack(tmp_path):
    capture = capture_of(tmp_path, gradient("x"), {"type": "off"}, FULL, gradient("y", -1), gradient("z"))
    frames = gradient_frames(capture)
    assert [frame.image for frame in capture.sources()] == ["0.exr", "2.exr", "3.exr", "4.exr"]
    assert np.array_equal(frames.diffuse, [[0.5, 0.5, 0, 0], [1, 0, 0, 0], [0.5, 0, -0.5, 0], [0.5, 0, 0, 0.5]])
    assert frames.parallel is None and not frames.polarised and frames.unused == ()


@pytest.mark.parametrize("last", [FULL, gradient("full"), gradient("x", -1), gradient("z", -1)])
def test_three_axes_and_a_full_frame_or_one_opposite_are_enough(tmp_path, last):
    assert np.linalg.matrix_rank(gradient_frames(capture_of(tmp_path, *map(gradient, "xyz"), last)).diffuse) == 4


def test_polarised_frames_come_first_and_the_others_are_named(tmp_path):
    axes = [gradient(axis, sign, kind) for kind in ("cross", "parallel") for axis in "xyz" for sign in (1, -1)]
    frames = gradient_frames(capture_of(tmp_path, *axes, FULL, gradient("x")))
    assert frames.polarised and frames.unused == ("12.exr", "13.exr")
    assert not frames.diffuse[6:].any() and frames.diffuse[:6].any(axis=1).all()
    assert frames.parallel is not None and np.array_equal(frames.parallel[6:12], frames.diffuse[:6])


def test_cross_frames_alone_are_diffuse(tmp_path):
    frames = gradient_frames(capture_of(tmp_path, *(gradient(axis, polarization="cross") for axis in ("x", "y", "z", "full"))))
    assert frames.polarised and frames.parallel is None


@pytest.mark.parametrize(("lights", "words"), [
    ([gradient("x"), gradient("z"), FULL], "gradient capture lacks axis y: a normal needs x, y and z"),
    ([gradient("full")], "gradient capture lacks axis x and y and z"),
    ([*map(gradient, "xyz")], "gradient capture lacks a full frame, or the opposite sign of"),
    ([*(gradient(a, polarization="cross") for a in "xyz"), FULL], "lacks a full frame with polarization cross"),
    ([*(gradient(a, s, "cross") for a in "xyz" for s in (1, -1)), gradient("x", 1, "parallel")],
     "lacks axis y and z with polarization parallel"),
    ([*(gradient(a, s, "parallel") for a in "xyz" for s in (1, -1))], "has parallel frames without cross ones"),
    ([FULL, {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}], "none is lit by a gradient light"),
])
def test_what_is_missing_is_named(tmp_path, lights, words):
    with pytest.raises(ManifestError, match=words):
        gradient_frames(capture_of(tmp_path, *lights))


def test_one_pixel_is_no_surface(tmp_path):
    with pytest.raises(ManifestError, match="is 1x1"):
        gradient_frames(capture_of(tmp_path, *map(gradient, "xyz"), FULL, size=1))


def test_full_frames_are_tracking_frames_beside_other_lights(tmp_path):
    write_capture(tmp_path, make_scene(size=6, lights=4))
    edit_frame(tmp_path, 2, light=FULL)
    capture = Capture.open(tmp_path)
    assert not has_gradients(capture) and len(capture.sources()) == 3
    edit_frame(tmp_path, 1, light=gradient("x"))
    assert len(Capture.open(tmp_path).sources()) == 4
    with pytest.raises(ManifestError, match=r"frames\[1\].light: is gradient: this needs distant lights"):
        distant_lights(Capture.open(tmp_path))
