"""Normals without lights: an ellipsoid that no axis of the camera suits, under lights of which the manifest knows nothing."""

import json

import numpy as np
import pytest

from service.errors import RequestError
from service.requests.solve import SolveRequest
from service.solve.solve import solve
from stage.errors import CalibrationError, ManifestError
from tests.reference import microfacet
from tests.scenes.captures import Scene, angles_degrees, edit_frame, edit_manifest, make_scene, write_capture
from tests.scenes.ellipsoid import ellipsoid

VIEW = np.array([0.0, 0.0, 1.0])
LIGHTS = 24


def shiny(scene, roughness, f0):
    """The scene with highlights of the contract's lobe, of two roughnesses side by side."""
    left = np.arange(scene.mask.shape[1]) < scene.mask.shape[1] // 2
    alpha = np.where(left, roughness[0], roughness[1])[None, :] ** 2
    lobes = np.stack([microfacet.specular(scene.normal, direction, VIEW, alpha, f0) for direction in scene.directions])
    images = scene.images + scene.mask[..., None] * lobes[..., None] * scene.irradiance[:, None, None]
    return scene._replace(images=images)


def relief(seed, *, shadows, size=96):
    """A plate that fills the image, with 14 bumps, two albedos and highlights, under 24 lights 35 to 72° from the view axis."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid((np.arange(size) + 0.5) / size * 2 - 1, 1 - (np.arange(size) + 0.5) / size * 2)
    z, slope = np.zeros_like(x), np.zeros((2, size, size))
    for _ in range(14):
        (across, up), wide, high = random.uniform(-0.9, 0.9, 2), random.uniform(0.06, 0.12), random.uniform(0.12, 0.25)
        bump = high * np.exp(-((x - across) ** 2 + (y - up) ** 2) / (2 * wide**2))
        z, slope = z + bump, slope - bump * np.stack([x - across, y - up]) / wide**2
    normal = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    albedo = np.repeat((0.3 + 0.4 * (np.sin(7 * x + 1) * np.sin(6 * y + 2) > 0))[..., None], 3, axis=-1)
    tilt, turn = np.radians(random.uniform(35, 72, LIGHTS)), random.uniform(0, 2 * np.pi, LIGHTS)
    directions = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    images = []
    for direction in directions:
        lit = np.ones_like(x, bool)
        aside = direction[:2] / np.hypot(*direction[:2])
        for step in np.arange(1, size) if shadows else ():
            row, col = np.rint(np.mgrid[:size, :size] + step * np.array([-aside[1], aside[0]])[:, None, None]).astype(int)
            inside = (row >= 0) & (row < size) & (col >= 0) & (col < size)
            above = z[row.clip(0, size - 1), col.clip(0, size - 1)] - z
            lit &= ~(inside & (above > step * 2 / size * direction[2] / np.hypot(*direction[:2])))
        lobe = microfacet.specular(normal, direction, VIEW, np.full(x.shape, 0.09), 0.08)
        images.append((albedo * np.maximum(normal @ direction, 0)[..., None] + lobe[..., None]) * lit[..., None])
    noisy = np.array(images) / np.max(images) + random.normal(0, 5e-4, (LIGHTS, size, size, 1))
    return Scene(normal, albedo, np.ones_like(x, bool), directions, np.full((LIGHTS, 3), np.pi), np.maximum(noisy, 0))


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_cast_shadows_tell_bumps_from_hollows(tmp_path, seed):
    """Weak highlights leave the depth and tilt open, with a wide σ; but the inverse, taken as often before, is never nearer."""
    scene = relief(seed, shadows=True)
    result, _, error = solved(tmp_path, scene)
    pixels, normal = np.asarray(result.maps.mask), np.asarray(result.maps.normal)
    inverse = angles_degrees(normal * [-1, -1, 1], scene.normal)[pixels]
    assert np.mean(error) < np.mean(inverse) and not any("bumps from hollows" in words for words in result.warnings)


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_where_nothing_tells_bumps_from_hollows_sigma_holds_both(tmp_path, seed):
    """Normals are off by nothing or by twice their tilt."""
    scene = relief(seed, shadows=False)
    result, _, _ = solved(tmp_path, scene, max_sigma=180)
    assert any("bumps from hollows" in words for words in result.warnings)
    solved_pixels = np.asarray(result.maps.mask)
    error, sigma = angles_degrees(result.maps.normal, scene.normal)[solved_pixels], np.asarray(result.maps.sigma)[solved_pixels]
    assert np.median(error / sigma) < 1.5 and np.mean(error > 5 * sigma) < 0.01  # √2 of the RMS of both, where it is the inverse


def solved(tmp_path, scene, method="robust", **options):
    """The result and report under lights that are declared to shine from the camera, all alike; the error where there is an estimate."""
    count = len(scene.directions)
    placeholders = scene._replace(directions=np.tile(VIEW, (count, 1)), irradiance=np.ones((count, 3)))
    folder = write_capture(tmp_path / "capture", placeholders)
    result = solve(SolveRequest(capture=folder, out=tmp_path / "out", method=method, lights="unknown", device="cpu", **options))
    error = angles_degrees(result.maps.normal, scene.normal)[result.maps.estimated]
    return result, json.loads((tmp_path / "out" / "report.json").read_text()), error


@pytest.fixture(scope="module")
def glossy(tmp_path_factory):
    scene = shiny(ellipsoid(size=48, count=LIGHTS), (0.45, 0.6), 0.08)
    return scene, *solved(tmp_path_factory.mktemp("glossy"), scene)


@pytest.mark.long
def test_highlights_tell_normals_without_lights(glossy):
    scene, _, report, error = glossy
    told = report["found"]["unknown_lights"]
    assert told["resolved_by"] == "highlights"
    assert np.mean(error) < 4, np.mean(error)  # texture, noise and highlights under 24 lights: 2° with known lights
    assert np.mean(angles_degrees(np.array(told["directions"]), scene.directions)) < 4


def test_irradiance_is_found_up_to_one_factor_and_sigma_counts_the_lights(glossy):
    scene, result, report, error = glossy
    told, sigma = report["found"]["unknown_lights"], result.maps.sigma[result.maps.estimated]
    assert np.std(np.log(np.array(told["irradiance"]) / scene.irradiance[:, 0])) < 0.05  # the declared ones vary by 35 %
    assert np.median(sigma) >= told["sigma_degrees"] * 0.9 and np.mean(error < 2 * sigma) > 0.9
    assert any("found.unknown_lights" in warning for warning in result.warnings)  # the manifest has other lights


@pytest.mark.long
def test_a_matt_object_of_one_albedo_is_told_by_it_and_doubted(tmp_path):
    scene = ellipsoid(count=LIGHTS)
    even = np.where(scene.albedo > 0, scene.images / np.maximum(scene.albedo, 1e-9) * 0.4, 0)
    result, report, error = solved(tmp_path, scene._replace(images=even))
    assert report["found"]["unknown_lights"]["resolved_by"] == "albedo"
    assert np.mean(error) < 5, np.mean(error)
    assert np.median(result.maps.sigma[result.maps.estimated]) > 15  # real matt objects were 4 to 29 degrees off
    assert any("no highlights" in warning for warning in result.warnings)


@pytest.mark.long
def test_lights_that_are_placeholders_are_no_bracket_and_choose_svbrdf(tmp_path):
    scene = shiny(ellipsoid(size=40, count=LIGHTS), (0.45, 0.6), 0.08)
    _, report, error = solved(tmp_path, scene, None)
    assert report["method"] == "svbrdf"
    assert np.mean(error) < 6, np.mean(error)


def test_what_lights_cannot_be_found_for_is_refused(tmp_path):
    with pytest.raises(RequestError, match="8 or more"):
        solved(tmp_path / "few", make_scene(24, 7))
    with pytest.raises(RequestError, match="not for distant lights"):
        solved(tmp_path / "gradient", make_scene(24, 9), "gradient")
    scene = make_scene(40, 12)
    noise = np.random.default_rng(0).random(scene.images.shape) * scene.mask[..., None]
    with pytest.raises(CalibrationError, match="--lights unknown: "):
        solved(tmp_path / "noise", scene._replace(images=noise))
    flat = scene._replace(images=np.broadcast_to(scene.images[:, 20:21, 20:21], scene.images.shape) * scene.mask[..., None])
    with pytest.raises(CalibrationError, match="--lights unknown: "):
        solved(tmp_path / "flat", flat)


def test_a_perspective_camera_and_a_near_light_are_refused(tmp_path):
    folder = write_capture(tmp_path / "capture", make_scene(24, 9))
    request = SolveRequest(capture=folder, out=tmp_path / "out", lights="unknown", device="cpu")
    edit_manifest(folder, camera={"projection": "perspective", "resolution": [24, 24], "focal_px": [50, 50], "principal_px": [12, 12]})
    with pytest.raises(RequestError, match="orthographic"):
        solve(request)
    edit_frame(folder, 3, light={"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]})
    with pytest.raises(ManifestError, match="distant lights"):
        solve(request)
    assert not (tmp_path / "out").exists()
