"""relit publish --as openlime: the pictures that OpenLIME shows of the planes are the captured images."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from tests.reference.colour import srgb
from tests.scenes.captures import edit_manifest, make_scene, render, write_capture
from tests.service.publish.published import SIZE, dome, image, levels_rms, sample, shown, tiles_joined

SAMPLES = Path(__file__).parents[3] / "samples"


def capture(folder, lights=7):
    """A cap under white lights in its own space, of which two rows of tiles are needed; returns the scene."""
    scene = make_scene(size=SIZE, lights=lights)
    white = np.ones_like(scene.irradiance)
    scene = scene._replace(irradiance=white, images=render(scene.normal, scene.albedo, scene.directions, white))
    write_capture(folder, scene)
    return scene


def test_captured_lights_show_the_captured_images(relit, tmp_path):
    scene = capture(tmp_path / "cap")
    out = relit.done("publish", tmp_path / "cap", "--to", tmp_path / "out", "--as", "openlime").out
    exposure = np.quantile(scene.images[:, scene.mask], 0.999)
    truth = srgb(np.clip(scene.images / exposure, 0, 1)) * scene.mask[..., None]
    got = shown(tmp_path / "out", scene.directions)
    # seven lights of three channels have 21 components, which are all there; 2 levels are those of JPEG at the default quality, the limit
    # that the page of the documentation states for the sample
    assert 255 * np.sqrt(np.mean(np.square(got - truth))) < 2
    said = float(re.search(r"error +([\d.]+) of 255", out)[1])
    assert said < 1  # bytes alone
    between = shown(tmp_path / "out", np.array([[0.25, 0.0, 0.968]]))[0]  # halfway between the light in front and one beside it
    ends = truth[[0, int(np.argmax(scene.directions[:, 0]))]]
    assert np.abs(between - ends.mean(axis=0))[scene.mask].mean() < np.abs(ends[0] - ends[1])[scene.mask].mean()


@pytest.mark.long
@pytest.mark.parametrize("owl", [False, True])
def test_each_light_is_shown_as_the_basis_has_it(relit, tmp_path, owl):
    """The dome's 32 lights and the sample's 47: OpenLIME shows each within 2 levels of the components before bytes and JPEG files."""
    folder = SAMPLES / "owl" if owl else tmp_path / "dome"
    lights, truth = sample(folder) if owl else dome(folder)
    relit.done("publish", folder, "--to", tmp_path / "out", "--as", "openlime", "--cache", tmp_path / "cache")
    for tiles in (False, True):
        found = np.rint(255 * shown(tmp_path / "out", lights, tiles=tiles)) / 255  # as a canvas has it
        assert levels_rms(found, truth).max() < 2


@pytest.mark.long
def test_lights_close_to_one_another_show_their_own_images(relit, tmp_path):
    """Seven lights within 8 degrees, whose images differ little; those of their neighbours are farther than the limit."""
    scene = capture(tmp_path / "cap")
    near = scene.directions * [0.25, 0.25, 1]
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    white, marks = np.ones_like(near), np.random.default_rng(2).uniform(0.5, 1, (len(near), SIZE // 30, SIZE // 30, 3))
    images = render(scene.normal, scene.albedo, near, white) * marks.repeat(30, axis=1).repeat(30, axis=2)
    write_capture(tmp_path / "near", scene._replace(directions=near, irradiance=white, images=images))
    relit.done("publish", tmp_path / "near", "--to", tmp_path / "out", "--as", "openlime")
    exposure = np.quantile(images[:, scene.mask], 0.999)
    truth = srgb(np.clip(images / exposure, 0, 1)) * scene.mask[..., None]
    got = shown(tmp_path / "out", near)
    assert 255 * np.sqrt(np.mean(np.square(got - truth))) < 3  # JPEG of squares that differ in each component
    assert 255 * np.sqrt(np.mean(np.square(truth[1:] - truth[:-1]))) > 20


@pytest.mark.long
def test_tiles_of_each_level_are_the_whole_image_made_smaller(relit, tmp_path):
    capture(tmp_path / "cap")
    relit.done("publish", tmp_path / "cap", "--to", tmp_path / "out", "--as", "openlime", "--quality", "100")
    whole = image(tmp_path / "out" / "plane_0.jpg")
    assert (tmp_path / "out" / "plane_0.dzi").read_text().count(f'Width="{SIZE}" Height="{SIZE}"') == 1
    side, wanted = SIZE, whole.astype(float)
    for level in (1, 0):  # the last is one tile
        joined = tiles_joined(tmp_path / "out" / "plane_0_files" / str(level), side, side)
        # JPEG rounds each file, and each level the one before, by half a step
        assert np.abs(joined - wanted).mean() < 2
        side = -(-side // 2)
        even = np.pad(wanted, [(0, len(wanted) % 2), (0, len(wanted) % 2), (0, 0)], mode="edge")
        wanted = even.reshape(side, 2, side, 2, 3).mean(axis=(1, 3))
    assert {path.name for path in (tmp_path / "out" / "plane_0_files").iterdir()} == {"0", "1"}


def test_black_stays_black_and_the_scale_is_told(relit, tmp_path):
    scene = capture(tmp_path / "cap", lights=4)
    edit_manifest(tmp_path / "cap", camera={"projection": "orthographic", "resolution": [SIZE, SIZE], "pixel_size_m": 2e-4})
    relit.done("publish", tmp_path / "cap", "--to", tmp_path / "out", "--as", "openlime", "--quality", "100")
    info = json.loads((tmp_path / "out" / "info.json").read_text())
    assert info["pixelSizeInMM"] == 0.2 and info["nplanes"] == 12  # as many as four lights of three channels have
    corner = shown(tmp_path / "out", scene.directions)[:, :20, :20]
    assert 255 * corner.max() < 1.5  # a step of JPEG


@pytest.mark.long
def test_lights_in_pairs_show_their_images_and_something_between(relit, tmp_path):
    """Their Gaussians are as wide as the distances between the pairs ask for."""
    scene = capture(tmp_path / "cap", lights=4)
    near = scene.directions + [0.01, 0, 0]
    directions = np.concatenate([scene.directions, near / np.linalg.norm(near, axis=1, keepdims=True)])
    white = np.ones_like(directions)
    images = render(scene.normal, scene.albedo, directions, white)
    write_capture(tmp_path / "pairs", scene._replace(directions=directions, irradiance=white, images=images))
    relit.done("publish", tmp_path / "pairs", "--to", tmp_path / "out", "--as", "openlime")
    between = shown(tmp_path / "out", np.array([[0.0, 0.25, 0.968], [0.0, 0.0, 1.0]]))
    assert np.isfinite(between).all()
    assert np.abs(between[0] - between[1])[scene.mask].mean() > 0.01
    relit.done("publish", tmp_path / "pairs", "--to", tmp_path / "iiif", "--as", "iiif", "--url", "https://museum.org/cap")
