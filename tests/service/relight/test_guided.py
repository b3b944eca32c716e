"""relit relight --maps: guided by a model, nearer to the truth than the plain sum, and never away from it."""

import json
import shutil

import numpy as np
import pytest

from service.relight.model_range import LitModel, correction
from service.reporting.provenance import HASHING
from stage.stack.ingest import LAYOUT
from tests.reference.sampling import lattice
from tests.scenes.captures import edit_manifest, rgb, write_exr
from tests.scenes.glossy import dome, lat_long, reflect, write_dome, write_maps

SURFACE = dome()
MIDDLE = np.array([0.35, 0.45, 0.82]) / np.linalg.norm([0.35, 0.45, 0.82])


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Capture, maps, an environment with a small sun that is no captured light, and the dome under it by the twin."""
    folder = tmp_path_factory.mktemp("guided")
    write_dome(folder / "cap", SURFACE)
    write_maps(folder / "maps", SURFACE)
    directions, solid_angle = lat_long(48)
    sky = np.where((directions @ MIDDLE > np.cos(np.radians(4.0)))[..., None], [60.0, 50.0, 40.0], 0.1)
    write_exr(folder / "sky.exr", sky)
    sky = sky.astype(np.float32).astype(np.float64)  # as the file has it
    truth = np.zeros((*SURFACE.mask.shape, 3))
    for row in range(len(sky)):
        lit = reflect(SURFACE.normal[SURFACE.mask][:, None], directions[row])  # [pixels, texels, 3]
        truth[SURFACE.mask] += np.einsum("ptk,tk->pk", lit, sky[row] * solid_angle[row])
    return folder, truth


def relight(relit, folder, out, *options):
    relit.done("relight", folder / "cap", "--environment", folder / "sky.exr", "--out", out / "f.#.exr", *options)
    return rgb(out / "f.1.exr")


def test_true_maps_make_up_for_what_lies_between_lights(relit, scene, tmp_path):
    """Plain weights are off by the spread of the sun over 30° between lights; what guided ones leave is the widening of the
    lobe to what such lights can tell, and 1024 samples of the map."""
    folder, truth = scene
    plain = SURFACE.off(relight(relit, folder, tmp_path / "a", "--weights", "smooth"), truth)
    kernel = SURFACE.off(relight(relit, folder, tmp_path / "b"), truth)
    guided = SURFACE.off(relight(relit, folder, tmp_path / "c", "--maps", folder / "maps" / "maps.exr"), truth)
    assert guided < 0.5 * min(plain, kernel)


@pytest.mark.long
@pytest.mark.parametrize("wrong", ["normals", "gloss"])
def test_wrong_maps_do_no_harm(relit, scene, tmp_path, wrong):
    """Normals that all face the camera, or a bright narrow lobe that no light saw: β and the widest lobe keep the result near the plain
    sum's. Turned normals are refused."""
    folder, truth = scene
    if wrong == "normals":
        flat = np.broadcast_to(np.float32([0, 0, 1]), SURFACE.normal.shape)
        maps = write_maps(tmp_path / "maps", SURFACE, normal=flat)
    else:
        shape = SURFACE.mask.shape
        maps = write_maps(tmp_path / "maps", SURFACE, specular=np.full((*shape, 3), 0.9), roughness=np.full(shape, 0.12))
    plain = SURFACE.off(relight(relit, folder, tmp_path / "a", "--weights", "smooth"), truth)
    guided = SURFACE.off(relight(relit, folder, tmp_path / "b", "--maps", maps), truth)
    assert guided < 1.1 * plain


def test_highlights_of_the_captured_lights_are_no_light_from_behind(relit, tmp_path):
    """Maps with narrower highlights than a ball has that lights in front of it lit, and a sun behind it: the plain sum has the shading and
    highlights of the nearest lights. A fifth of it was left where the readings of highlights contradict the maps; a hundredth is what the
    trust of the median pixel may lack of 1."""
    write_dome(tmp_path / "cap", SURFACE, directions=lattice(24, 40))
    write_maps(tmp_path / "maps", SURFACE, roughness=np.full(SURFACE.mask.shape, 0.3, np.float32))
    sun = {"name": "sun", "keys": [{"frame": 1, "direction": [-0.6, 0, -0.8], "irradiance": [2, 2, 2]}]}
    (tmp_path / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", "lights": [sun]}))
    words = ("relight", tmp_path / "cap", "--keys", tmp_path / "keys.json")
    relit.done(*words, "--out", tmp_path / "plain.#.exr")
    relit.done(*words, "--maps", tmp_path / "maps", "--out", tmp_path / "guided.#.exr")
    assert rgb(tmp_path / "guided.1.exr").max() < 0.01 * rgb(tmp_path / "plain.1.exr").max()


@pytest.mark.parametrize(("plain", "guided"), [(0.5, 0.1), (1.0, 0.2), (1.3, 0.5)])
def test_what_a_shadow_has_taken_is_not_taken_again(plain, guided):
    """The model says that the sum of images holds 1 and that the frame holds 0.2, because a shadow falls there. Images that lie in that
    shadow already, so that their sum is 0.5, are left a fifth; a loss of 0.8 would make the pixel black."""
    one = np.ones((3, 1))
    change, _ = correction(LitModel(0.2 * one, 0 * one, one, one, None, None), plain * one, np.ones(1), None, 0.0)
    np.testing.assert_allclose(plain + change, guided)


def test_diffuse_and_specular_add_up_to_the_beauty(relit, scene, tmp_path):
    """To the rounding of three half values; and the specular layer is that of the twin, widened as guided lobes are."""
    folder, truth = scene
    beauty = relight(relit, folder, tmp_path, "--maps", folder / "maps", "--aov", "diffuse,specular,normal,mask,confidence")
    diffuse, specular = (rgb(tmp_path / "f.1.exr", layer) for layer in ("diffuse.", "specular."))
    np.testing.assert_allclose(diffuse + specular, beauty, rtol=2e-3, atol=1e-6)
    assert (specular >= 0).all() and (specular <= beauty * 1.001).all() and specular[SURFACE.mask].min() > 0
    assert specular[SURFACE.mask].mean() < 0.5 * truth[SURFACE.mask].mean()


@pytest.mark.long
def test_guided_frames_are_known_again(relit, scene, tmp_path):
    folder, _ = scene
    relight(relit, folder, tmp_path, "--maps", folder / "maps")
    again = "relight", folder / "cap", "--environment", folder / "sky.exr", "--out", tmp_path / "f.#.exr"
    assert "skipped  1 of 1" in relit(*again, "--maps", folder / "maps").out
    assert "skipped" not in relit(*again, "--weights", "smooth").out


def holed():
    height = SURFACE.height.astype(np.float32)
    height[tuple(np.argwhere(SURFACE.mask)[0])] = np.nan
    return height


@pytest.mark.parametrize(("changes", "words"), [
    ({"height": None}, "has no layer height"), ({"color_space": "lin_ap1_scene"}, "solve it again"),
    ({"height": holed()}, "layer height has 1 values that are not finite"),
    ({"provenance": {"relit:inputs": "of something else", HASHING: str(LAYOUT)}}, "solved from other images"),
])
def test_bad_maps_are_a_sentence(relit, scene, tmp_path, changes, words):
    folder, _ = scene
    maps = write_maps(tmp_path / "maps", SURFACE, **changes)
    error = relit.refused("relight", folder / "cap", "--environment", folder / "sky.exr", "--out", tmp_path / "f.#.exr", "--maps", maps)
    assert words in error and str(maps) in error and not (tmp_path / "f.1.exr").exists()


@pytest.mark.long
def test_a_finished_range_is_the_undisturbed_one_to_the_last_bit(relit, scene, tmp_path, monkeypatch):
    """Frames of a range that are made later, among others, are the same: plain in all weightings, and guided."""
    monkeypatch.setattr("kernels.relight.directions.latlong.SAMPLE_PITCH_DEGREES", 4.0)  # bits are compared: few samples show it as well
    folder, _ = scene
    for options in ((), ("--weights", "cells"), ("--weights", "smooth"), ("--maps", folder / "maps")):
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        words = ("relight", folder / "cap", "--environment", folder / "sky.exr", "--frames", "1-40", "--spin-degrees", "360", *options)
        relit(*words, "--out", out / "f.##.exr")
        whole = {path.name: rgb(path) for path in out.iterdir()}
        for number in (2, 3, 7, 20, 21, 33, 40):
            (out / f"f.{number:02d}.exr").unlink()
        assert "skipped  33 of 40" in relit(*words, "--out", out / "f.##.exr").out
        assert all(np.array_equal(rgb(out / name), pixels) for name, pixels in whole.items())


@pytest.mark.long
def test_maps_of_a_version_that_hashed_otherwise_guide_with_a_warning(relit, scene, tmp_path):
    folder, _ = scene
    words = ("relight", folder / "cap", "--environment", folder / "sky.exr")
    for name, provenance in (("one", {}), ("other", {"relit:inputs": "of something else"})):
        outcome = relit(*words, "--out", tmp_path / f"{name}.#.exr", "--maps", write_maps(tmp_path / name, SURFACE, provenance=provenance))
        assert outcome.code == 0 and (HASHING in outcome.out) == (name == "other")
    assert np.array_equal(rgb(tmp_path / "one.1.exr"), rgb(tmp_path / "other.1.exr"))


@pytest.mark.long
def test_maps_with_another_camera_guide_with_a_warning(relit, scene, tmp_path):
    """A manifest that was corrected after the solve: what `P` and the cameras of frames say did not fit together."""
    folder, _ = scene
    words = ("relight", folder / "cap", "--environment", folder / "sky.exr", "--maps", folder / "maps")
    assert "another camera" not in relit(*words, "--out", tmp_path / "a.#.exr").out
    copy = shutil.copytree(folder / "cap", tmp_path / "cap")
    edit_manifest(copy, camera=lambda camera: {**camera, "pixel_size_m": 0.5})
    assert "another camera.pixel_size_m than" in relit(words[0], copy, *words[2:], "--out", tmp_path / "b.#.exr").out


@pytest.mark.long
def test_maps_that_were_solved_with_other_lights_guide_and_are_exported_with_a_warning(relit, scene, tmp_path):
    """Lights that were corrected in the manifest after the solve; beside it the same lights, of an irradiance that the solve scaled."""
    folder = shutil.copytree(scene[0], tmp_path / "scene")
    edit_manifest(folder / "cap", irradiance_scale="relative")
    assert relit("solve", folder / "cap", "--method", "lambert", "--albedo-scale", "2", "--out", folder / "solved").code == 0
    words = ("relight", folder / "cap", "--environment", folder / "sky.exr", "--maps", folder / "solved")
    asset = ("export", folder / "solved", "--rig", folder / "cap", "--out", tmp_path / "a.usda")
    assert "other lights" not in relit(*words, "--out", tmp_path / "a.#.exr").out + relit.done(*asset).out
    frames = json.loads((folder / "cap" / "capture.json").read_text())["frames"]
    frames[0]["light"]["irradiance"] = [3.0, 3.0, 3.0]
    edit_manifest(folder / "cap", frames=frames)
    assert "solved with other lights than" in relit(*words, "--out", tmp_path / "b.#.exr").out
    assert "solved with other lights than" in relit.done(*asset).out
