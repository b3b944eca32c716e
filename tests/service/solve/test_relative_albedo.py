"""The albedo of captures whose lights lack a factor: within 0…1 whatever the unit, recorded, and one with the frames that maps guide."""


import numpy as np
import pytest

from tests.marks import first_short
from tests.scenes import near_lights
from tests.scenes.captures import edit_manifest, make_scene, rgb, write_capture, write_exr
from tests.scenes.near_lights import lamps

SCENE = make_scene(size=20, lights=7)
SKY = np.full((8, 16, 3), 0.5)
ROBUST = "--method", "robust"


@first_short("unit", [3e-4, 0.17, 40.0, 2e7])
def test_the_brightest_pixels_are_as_bright_as_paint_whatever_the_unit_of_the_lights(relit, tmp_path, unit):
    write_capture(tmp_path, SCENE._replace(irradiance=SCENE.irradiance * unit), irradiance_scale="relative")
    maps, report, _ = relit.solve(tmp_path, *ROBUST, code=None)
    assert np.percentile(maps.diffuse_albedo[maps.mask].max(axis=-1), 99) == pytest.approx(0.8, rel=2e-3)  # halves, twice
    factor = maps.diffuse_albedo[SCENE.mask] / SCENE.albedo[SCENE.mask]
    assert np.allclose(factor, report["found"]["albedo_factor"] / unit, rtol=4e-3)  # halves of the readings, and twice of the albedo
    assert report["albedo_above_one"] == 0
    kept, again, _ = relit.solve(tmp_path, *ROBUST, "--albedo-scale", str(unit / 2), code=None)
    assert again["found"]["albedo_factor"] == pytest.approx(unit / 2)
    assert np.allclose(kept.diffuse_albedo[SCENE.mask], SCENE.albedo[SCENE.mask] / 2, rtol=4e-3)


@pytest.mark.long
def test_near_lights_in_large_units_are_relit_and_exported(relit, tmp_path):
    """As near_ps has them: without the distance of the surface, which the solve finds and all that light its maps take from these."""
    scene = near_lights.dome(24, perspective=True)
    near_lights.write(tmp_path / "cap", scene, lamps(scene, 10, 1.5))
    edit_manifest(tmp_path / "cap", irradiance_scale="relative", camera=lambda camera: camera | {"surface_z_m": None},
                  frames=lambda frames: [frame | {"light": frame["light"] | {
                      "intensity": [4e7 * value for value in frame["light"]["intensity"]]}} for frame in frames])
    maps, *_ = relit.solve(tmp_path / "cap", *ROBUST, code=None)
    assert np.percentile(maps.diffuse_albedo[maps.mask].max(axis=-1), 99) == pytest.approx(0.8, rel=2e-3)
    write_exr(tmp_path / "sky.exr", SKY)
    relit.done("relight", tmp_path / "cap", "--environment", tmp_path / "sky.exr", "--maps", tmp_path / "cap" / "out",
               "--out", tmp_path / "f.#.exr")
    frame = rgb(tmp_path / "f.1.exr")[maps.mask]
    # a surface under an even sky returns its albedo times the sky, less what lamps above the horizon alone do not light: a half to all
    assert 0.5 < np.median(frame / (0.5 * maps.diffuse_albedo[maps.mask])) < 1.2
    told = relit.done("export", tmp_path / "cap" / "out", "--rig", tmp_path / "cap", "--out", tmp_path / "a.usdz").out
    assert "all over" not in told and "other lights" not in told
    picture = ("shade", tmp_path / "cap" / "out", "--environment", tmp_path / "sky.exr", "--capture", tmp_path / "cap")
    assert "other lights" not in relit.done(*picture, "--out", tmp_path / "p.exr").out
    np.testing.assert_allclose(rgb(tmp_path / "p.exr")[maps.mask], frame, rtol=2e-3)  # half rounding; the frame is the same picture


def test_absolute_lights_are_never_rescaled(relit, tmp_path):
    """A unit that no surface fits is refused, and nothing is written; an albedo above 1 is said; a factor is for relative lights."""
    write_capture(tmp_path / "far_off", SCENE._replace(irradiance=SCENE.irradiance * 3e7))
    assert "frames[].light" in relit.refused("solve", tmp_path / "far_off", "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    write_capture(tmp_path / "weak", SCENE._replace(irradiance=SCENE.irradiance / 3))
    _, report, told = relit.solve(tmp_path / "weak", *ROBUST, code=None)
    assert report["albedo_above_one"] > 0 and "diffuse_albedo: is above 1" in told
    assert "--albedo-scale" in relit.refused("solve", tmp_path / "weak", "--out", tmp_path / "none", "--albedo-scale", "2")


@pytest.mark.parametrize(("albedo", "word"), [(4e-4, "black"), (1.4, "white")])
def test_an_asset_of_one_shade_says_so(relit, tmp_path, albedo, word):
    flat = SCENE.albedo.max(axis=-1, keepdims=True) > 0
    images = SCENE.images / np.where(flat, SCENE.albedo, 1) * albedo
    write_capture(tmp_path, SCENE._replace(images=images))
    relit.solve(tmp_path, *ROBUST, code=None)
    assert f"{word} all over" in relit.done("export", tmp_path / "out", "--out", tmp_path / "a.usdz").out
