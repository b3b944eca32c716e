"""The distance of a surface under near lights, which the manifest does not give: found with its σ, or refused."""


import numpy as np
import pytest

from tests.scenes import near_lights
from tests.scenes.captures import angles_degrees, edit_manifest
from tests.scenes.near_lights import lamps

DOME = near_lights.dome(40, perspective=True)
FLAT = near_lights.dome(40)
DEPTH = -DOME.camera["surface_z_m"]
RNG = np.random.default_rng(3)
ROBUST = "--method", "robust", "--device", "cpu"


def capture(folder, lights, told=None, scene=DOME):
    near_lights.write(folder, scene, lights, told=told)
    edit_manifest(folder, camera={name: value for name, value in scene.camera.items() if name != "surface_z_m"})
    return folder


@pytest.mark.long
@pytest.mark.parametrize(("radii", "count"), [(3.0, 8), (1.5, 16)])
def test_the_distance_is_found(relit, tmp_path, radii, count):
    """The coarse grid follows the ripples with chords: within half a per cent, and within what the report says."""
    maps, report, out = relit.solve(capture(tmp_path / "c", lamps(DOME, count, radii)), *ROBUST)
    found = report["found"]["distance"]
    assert found["surface_z_m"] == pytest.approx(-DEPTH, rel=0.005)
    assert abs(found["surface_z_m"] + DEPTH) < 2 * found["sigma_m"] < 0.08 * DEPTH
    assert "camera.surface_z_m: is missing, and was taken as" in out
    angle = angles_degrees(maps.normal, DOME.normal)[maps.mask]
    assert angle.mean() < max(0.3, found["sigma_of_normals_degrees"])
    assert np.abs(maps.height - DOME.points[..., 2])[maps.mask].mean() < found["sigma_m"]


@pytest.mark.long
def test_lights_that_are_not_where_they_are_said_to_be(relit, tmp_path):
    """Places off by 2 % of their distance and intensities by 3 %: the error stays within what the report says."""
    lights = lamps(DOME, 12, 3.0)
    told = [lamp._replace(position=lamp.position + RNG.normal(0, 0.006, 3), strength=lamp.strength * np.exp(RNG.normal(0, 0.03)))
            for lamp in lights]
    report = relit.solve(capture(tmp_path / "c", lights, told), *ROBUST).report
    found = report["found"]["distance"]
    assert abs(found["surface_z_m"] + DEPTH) < 2 * found["sigma_m"]


@pytest.mark.long
def test_an_orthographic_camera_sees_it_by_the_lights(relit, tmp_path):
    """The dome stands 0.08 m before z = 0, which is the default; depths count from the nearest light."""
    lights = lamps(FLAT, 12, 6.0)
    maps, report, out = relit.solve(capture(tmp_path / "c", lights, scene=FLAT), *ROBUST)
    found, true = report["found"]["distance"], FLAT.camera["surface_z_m"]
    below = max(lamp.position[2] for lamp in lights) - true
    assert abs(found["surface_z_m"] - true) < min(2 * found["sigma_m"], 0.01 * below)
    assert "camera.surface_z_m: is missing, and was taken as" in out
    assert np.abs(maps.height - FLAT.points[..., 2])[maps.mask].mean() < found["sigma_m"]
    assert angles_degrees(maps.normal, FLAT.normal)[maps.mask].mean() < max(0.3, found["sigma_of_normals_degrees"])


def test_an_orthographic_camera_keeps_its_default_where_images_do_not_tell(relit, tmp_path):
    lights = lamps(FLAT, 4, 3.0)
    folder = capture(tmp_path / "c", lights, scene=FLAT)  # at the wrong distance few or no pixels settle
    _, report, out = relit.solve(folder, *ROBUST, code=None)
    assert "distance" not in report["found"]
    sentence = next(one for one in report["warnings"] if "surface_z_m" in one)
    assert "the images of 4 lights do not tell it" in sentence and "0 was taken, the default of an orthographic camera" in sentence
    assert sentence in out and "surface is" in relit("info", tmp_path / "c").out


@pytest.mark.long
def test_images_that_do_not_tell_it_are_refused(relit, tmp_path):
    """Lights in another order than the images; and too few lights."""
    lights = lamps(DOME, 8, 2.0)
    folder = capture(tmp_path / "c", lights, lights[::-1])
    outcome = relit("solve", folder, "--out", folder / "out")
    assert outcome.code == 2 and "camera.surface_z_m: is missing, and the images" in outcome.err and "tell it" in outcome.err
    assert not (folder / "out").exists()
    folder = capture(tmp_path / "few", lights[:4])
    assert "the images of 4 lights do not tell it (5 or more do)" in relit.refused("solve", folder, "--out", folder / "out")
