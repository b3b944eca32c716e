"""relit solve on captures under diffused sources: from images on disk to maps.exr, with a known truth."""

import numpy as np
import pytest

from stage.formats import exr
from tests.marks import first_short
from tests.reference import sampling as twin
from tests.scenes import horn
from tests.scenes.captures import angles_degrees
from tests.scenes.extended_lights import COLOUR, SHARPNESS, VIEW, ball, light, write_sampling

SIDE, LIGHTS = 16, 20
CENTRES = twin.lattice(LIGHTS)
BALL = ball(SIDE)
NORMALS = BALL.normal[BALL.mask]
PAINTED = NORMALS[:, 0] < 0
PAINT, METAL, ALPHA = np.array([0.6, 0.3, 0.15]), 0.8, 0.1


@pytest.fixture(scope="module")
def half_painted() -> np.ndarray:
    """[n, lights, 3]: paint on the left, metal on the right."""
    paint = twin.lambert(NORMALS, CENTRES, SHARPNESS)[..., None] * PAINT
    metal = twin.ggx(NORMALS, VIEW, CENTRES, SHARPNESS, alpha=ALPHA, f0=METAL)[..., None]
    return np.where(PAINTED[:, None, None], paint, metal) * COLOUR


@pytest.mark.long
def test_half_painted_half_metallic(relit, tmp_path, half_painted):
    maps, report, _ = relit.solve(write_sampling(tmp_path, BALL, half_painted, CENTRES))
    assert np.array_equal(maps.mask, BALL.mask) and report["method"] == "svbrdf"
    assert angles_degrees(maps.normal, BALL.normal)[BALL.mask].mean() < 0.3
    regime = maps.regime[BALL.mask]
    assert (regime == np.where(PAINTED, 1, 2)).mean() > 0.99
    albedo, specular, roughness = (layer[BALL.mask] for layer in (maps.diffuse_albedo, maps.specular, maps.roughness))
    assert np.allclose(np.median(albedo[PAINTED], axis=0), PAINT, rtol=0.02)
    assert np.median(specular[~PAINTED]) == pytest.approx(METAL, abs=0.02)
    assert np.median(roughness[~PAINTED]) == pytest.approx(ALPHA**0.5, abs=0.03)
    channels, _ = exr.read(tmp_path / "out" / "maps.exr")
    layers = {name.partition(".")[0] for name in channels}
    assert layers == {"normal", "diffuse_albedo", "specular", "roughness", "regime", "height", "sigma", "confidence", "status", "mask"}
    assert all(np.isfinite(plane).all() for plane in channels.values())
    found = report["found"]
    assert sum(found["regimes"].values()) == BALL.mask.sum() and found["views"] == 1 and found["light_samples"] > 1000
    assert found.get("own_light", {"pixels": 0})["pixels"] < 0.1 * BALL.mask.sum()  # a ball hides nothing; noise at its rim may


@pytest.mark.long
def test_sources_that_a_horn_hides_in_part(relit, tmp_path):
    """Taken as if every pixel saw every source, the mean error is 1.14°, and the largest 8.1°."""
    scene = horn.horn(20)
    maps, report, _ = relit.solve(horn.write(tmp_path, scene, 16))
    error = angles_degrees(maps.normal, scene.normal)[scene.mask]
    assert error.mean() < 0.55 and np.median(error) < 0.3  # the horn is five pixels wide, and its height is integrated in one pixel's steps
    assert (error < 5 * np.maximum(maps.sigma[scene.mask], 0.05)).all()
    own = report["found"]["own_light"]
    assert own["used"] and own["cost"] < 0.5 * own["cost_without"] and own["pixels"] > 0.3 * scene.mask.sum()
    assert np.allclose(np.median(maps.diffuse_albedo[scene.mask], axis=0), horn.ALBEDO, rtol=0.02)


@pytest.mark.long
def test_a_mirror_with_a_distant_light_among_the_sources(relit, tmp_path):
    """The distant light shows in a few pixels alone; all others have to bear a reading of zero."""
    radiance = twin.mirror(NORMALS, VIEW, CENTRES, SHARPNESS, f0=0.9)[..., None] * COLOUR
    dark = np.zeros((len(NORMALS), 1, 3))
    lights = [light(centre) for centre in CENTRES]
    lights.append({"type": "distant", "direction": [0.0, 0.6, 0.8], "irradiance": [1.0, 1.0, 1.0]})
    write_sampling(tmp_path, BALL, np.concatenate([radiance, dark], axis=1), CENTRES, lights=lights)
    maps, *_ = relit.solve(tmp_path, "--method", "svbrdf")
    error = angles_degrees(maps.normal, BALL.normal)[BALL.mask]
    assert np.percentile(error, 95) < 0.5
    assert (maps.regime[BALL.mask] == 3).mean() > 0.95


@pytest.mark.long
def test_a_perspective_view_is_solved_in_parts(relit, tmp_path):
    """A ball, half paint and half mirror, 14 degrees wide: its pixels see it from different sides, in parts of 7 degrees."""
    focal = SIDE / (2 * np.tan(np.radians(7)))
    offset = (np.arange(SIDE) + 0.5 - SIDE / 2) / focal
    x, y = np.meshgrid(offset, -offset)
    view = np.stack([-x, -y, np.ones_like(x)], axis=-1)
    view = (view / np.linalg.norm(view, axis=-1, keepdims=True))[BALL.mask]
    radiance = np.where(PAINTED[:, None], 0.5 * twin.lambert(NORMALS, CENTRES, SHARPNESS),
                        twin.mirror(NORMALS, view, CENTRES, SHARPNESS, f0=0.9))[..., None] * COLOUR
    facing = (NORMALS * view).sum(axis=1) > 0.25
    camera = {"projection": "perspective", "resolution": [SIDE, SIDE], "focal_px": [focal, focal],
              "principal_px": [SIDE / 2, SIDE / 2]}
    maps, report, _ = relit.solve(write_sampling(tmp_path, BALL, radiance, CENTRES, camera=camera))
    error = angles_degrees(maps.normal, BALL.normal)[BALL.mask]
    assert error[facing].mean() < 0.2 and error[facing].max() < 1
    assert report["found"]["views"] == 4
    assert (maps.regime[BALL.mask] == np.where(PAINTED, 1, 3))[facing].mean() > 0.99


@first_short("method", ["lambert", "robust"])
def test_methods_for_one_direction_refuse(relit, tmp_path, half_painted, method):
    write_sampling(tmp_path, BALL, half_painted, CENTRES)
    relit("solve", tmp_path, "--out", tmp_path / "out", "--method", method).refused("some are extended: --method svbrdf solves these")
    assert not (tmp_path / "out").exists()


def test_info_counts_them_and_finds_no_fault(relit, tmp_path, half_painted):
    outcome = relit("info", write_sampling(tmp_path, BALL, half_painted, CENTRES))
    assert outcome.code == 0 and f"{LIGHTS} extended light" in outcome.out


@pytest.mark.long
def test_dark_pixels_have_a_status(relit, tmp_path, half_painted):
    radiance = half_painted.copy()
    radiance[:5] = 0
    maps, report, _ = relit.solve(write_sampling(tmp_path, BALL, radiance, CENTRES))
    assert report["pixels"]["dark"] == 5 and maps.mask.sum() == BALL.mask.sum() - 5
