"""relit solve on polarised pairs: against the truth, and against the same object without polarisers."""

import json

import numpy as np
import pytest

from service.errors import RequestError
from service.relight.relight import relight
from service.requests.relight import RelightRequest
from service.requests.solve import LightsKnown, Method, SolveRequest
from service.solve.solve import solve
from stage.errors import ManifestError
from stage.formats import exr
from tests.reference import microfacet
from tests.scenes import near_lights
from tests.scenes.captures import angles_degrees, edit_manifest, write_lit
from tests.scenes.polarised import MATERIALS, polarised_scene, with_two_beckmann_lobes, write_plain, write_polarised

SCENE = polarised_scene(size=28, lights=40)
NOISE, LEAK = 0.01, 0.02


def solved(folder, method=Method.SVBRDF, **options):
    result = solve(SolveRequest(capture=folder, out=folder / "out", method=method, device="cpu", **options))
    return result, json.loads(result.report_path.read_text())


@pytest.fixture(scope="module")
def leaking(tmp_path_factory):
    return write_polarised(tmp_path_factory.mktemp("leaking"), SCENE, leak=LEAK, declared=LEAK, noise=NOISE)


@pytest.fixture(scope="module")
def found(leaking):
    return solved(leaking)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return write_plain(tmp_path_factory.mktemp("plain"), SCENE, noise=NOISE)


def error(maps, name):
    return angles_degrees(maps.normal, SCENE.surface.normal)[SCENE.of(name)]


@pytest.mark.long
def test_svbrdf_finds_every_material(found):
    """Noise of 1 % under 36 lights turns normals by 0.1°; tolerances are twice what was measured."""
    result, report = found
    maps = result.maps
    assert maps.mask[SCENE.surface.mask].all()
    for name, (_, f0, roughness) in MATERIALS.items():
        where = SCENE.of(name)
        assert error(maps, name).mean() < 0.3, name
        assert np.abs(maps.diffuse_albedo.astype(float) - SCENE.albedo)[where].mean() < 0.008, name
        np.testing.assert_allclose(np.median(maps.specular[where].astype(float), axis=0), f0, atol=0.02 * max(f0) + 0.001)
        if max(f0) > 0:
            assert np.median(maps.roughness[where].astype(float)) == pytest.approx(roughness, abs=0.02), name
    found_of = report["found"]["polarisation"]
    assert found_of["leak"] == LEAK and found_of["leak_declared"] and found_of["pairs"] == len(SCENE.directions)
    assert found_of["pixels_without_diffuse_light"] == SCENE.of("metal").sum()


@pytest.mark.long
def test_errors_are_those_that_sigma_says(found):
    maps = found[0].maps
    inside = SCENE.surface.mask
    ratio = angles_degrees(maps.normal, SCENE.surface.normal)[inside] / maps.sigma[inside].astype(float)
    assert np.mean(ratio > 3) < 0.02


@pytest.mark.long
def test_a_metal_has_no_albedo_even_where_nobody_declares_the_leak(tmp_path, found):
    """2 % that leak of F₀ 0.9 look like an albedo of 0.04 · 0.9, which the leak's bound in the report tells."""
    where = SCENE.of("metal")
    assert found[0].maps.diffuse_albedo[where].max() < 0.005
    result, report = solved(write_polarised(tmp_path, SCENE, leak=LEAK, noise=NOISE))
    assert result.maps.diffuse_albedo[where].max() < 0.05 and error(result.maps, "metal").mean() < 0.3
    assert not report["found"]["polarisation"]["leak_declared"]
    assert LEAK <= report["found"]["polarisation"]["leak_at_most"] < 0.03


@pytest.mark.long
def test_robust_normals_of_glossy_surfaces_are_better_than_without_polarisers(leaking, plain):
    with_pairs, without = (solved(folder, Method.ROBUST)[0].maps for folder in (leaking, plain))
    for name in ("plastic", "black"):
        assert error(with_pairs, name).mean() < 0.4 * error(without, name).mean()
    metal = SCENE.of("metal")
    assert not with_pairs.mask[metal].any()


@pytest.mark.long
def test_svbrdf_is_as_good_as_without_polarisers(found, plain):
    """Diffuse images gather half of the light, so that noise turns their normals by up to √2 as much."""
    without = solved(plain)[0].maps
    for name in MATERIALS:
        assert error(found[0].maps, name).mean() < 1.5 * error(without, name).mean() + 0.05, name


@pytest.mark.long
def test_metals_speak_neither_of_the_shape_of_others_nor_of_the_support_by_few_lights(tmp_path):
    """Their diffuse images are noise, which no model predicts, and they hold none of the light that their highlights send: noise of 4 %
    left no normal sure, and the height was said to throw none of the shadows."""
    scene = polarised_scene(size=28, lights=30)
    result, report = solved(write_polarised(tmp_path, scene, leak=LEAK, declared=LEAK, noise=0.04))
    assert result.maps.mask[scene.surface.mask].all()
    assert report["warnings"] == []
    errors = angles_degrees(result.maps.normal, scene.surface.normal)[scene.surface.mask]
    assert np.median(errors) < 0.75  # twice what was measured


@pytest.mark.long
@pytest.mark.parametrize("method", [Method.SVBRDF, Method.ROBUST])
def test_highlights_that_the_model_does_not_know_are_left_out(tmp_path, method):
    """Errors of the normals and of albedo, with pairs and without: measured are 0.10° for 0.57° and 0.002 for 0.10 at the least."""
    scene = with_two_beckmann_lobes(SCENE)
    with_pairs, without = (solved(write(tmp_path / name, scene, noise=NOISE, **options), method)[0].maps for name, write, options in
                           (("pairs", write_polarised, {"leak": LEAK, "declared": LEAK}), ("plain", write_plain, {})))
    inside = scene.surface.mask
    apart = [angles_degrees(maps.normal, scene.surface.normal)[inside] for maps in (with_pairs, without)]
    assert apart[0].mean() < 0.25 and apart[0].mean() < 0.25 * apart[1].mean()
    assert np.mean(apart[0] > 3 * with_pairs.sigma[inside].astype(float)) < 0.02
    off = [np.abs(maps.diffuse_albedo[inside] / scene.albedo[inside] - 1).mean() for maps in (with_pairs, without)]
    assert off[0] < 0.01 and off[0] < 0.1 * off[1]


def test_relighting_adds_both_images_of_a_pair(tmp_path, leaking, plain):
    """The sum of a pair is what a camera without polariser sees, up to the noise of both."""
    frames = []
    for folder in (leaking, plain):
        keys = tmp_path / "keys.json"
        sun = {"frame": 1, "direction": [0.2, 0.1, 1], "irradiance": [3, 3, 3], "angle_degrees": 20}
        keys.write_text(json.dumps({"schema": "relit.keys/1", "lights": [{"name": "sun", "keys": [sun]}]}))
        relight(RelightRequest(capture=folder, out=str(tmp_path / f"{folder.name}.#.exr"), keys=keys, device="cpu"))
        channels, _ = exr.read(tmp_path / f"{folder.name}.1.exr")
        frames.append(np.stack([channels[name] for name in "RGB"], axis=-1).astype(float))
    inside = SCENE.surface.mask
    assert frames[1][inside].mean() > 0.1
    np.testing.assert_allclose(frames[0][inside], frames[1][inside], atol=8 * NOISE * frames[1].max())
    assert frames[0][inside].mean() == pytest.approx(frames[1][inside].mean(), rel=0.01)


def test_what_is_refused(tmp_path, leaking):
    with pytest.raises(RequestError, match=r"--lights unknown.*polarised pairs"):
        solved(leaking, lights=LightsKnown.UNKNOWN)
    swapped = write_polarised(tmp_path / "swapped", SCENE)
    data = json.loads((swapped / "capture.json").read_text())
    for frame in data["frames"]:
        frame["light"]["polarization"] = {"cross": "parallel", "parallel": "cross"}[frame["light"]["polarization"]]
    edit_manifest(swapped, frames=data["frames"])
    with pytest.raises(ManifestError, match="the two are swapped"):
        solved(swapped)
    assert not (swapped / "out").exists()


@pytest.mark.long
def test_too_much_leak_is_said(tmp_path):
    result, _ = solved(write_polarised(tmp_path, SCENE, leak=0.005, declared=0.05, noise=NOISE))
    assert any("polarizer_leak: is 0.05" in sentence for sentence in result.warnings)


@pytest.mark.long
def test_near_lights(tmp_path):
    """Glossy ripples under lamps at 1.3 radii: half rounding and the part not yet settled leave 0.1°."""
    dome = near_lights.dome(32)
    view, f0, roughness, images, lights = np.array([0.0, 0.0, 1.0]), 0.05, 0.35, [], []
    for lamp in near_lights.lamps(dome, 48, 1.3):
        way = lamp.position - dome.points
        distance = np.linalg.norm(way, axis=-1, keepdims=True)
        half = near_lights.render(dome, lamp) / 2 * dome.mask[..., None]
        shine = microfacet.specular(dome.normal, way / distance, view, roughness**2, f0)[..., None] * lamp.strength / distance**2
        images += half, half + shine * dome.mask[..., None]
        lights += [{**lamp.manifest(), "polarization": kind} for kind in ("cross", "parallel")]
    write_lit(tmp_path, images, lights, camera=dome.camera, mask=dome.mask)
    maps = solved(tmp_path)[0].maps
    assert angles_degrees(maps.normal, dome.normal)[dome.mask].mean() < 0.1
    assert np.median(np.abs(maps.diffuse_albedo.astype(float) / dome.albedo - 1)[dome.mask]) < 0.01
    np.testing.assert_allclose(np.median(maps.specular[dome.mask].astype(float), axis=0), f0, rtol=0.05)
    assert np.median(maps.roughness[dome.mask].astype(float)) == pytest.approx(roughness, abs=0.02)
