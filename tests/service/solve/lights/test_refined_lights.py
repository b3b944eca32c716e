"""Directions that are off by five degrees, each light by itself, and what the images make of them."""

import json

import numpy as np
import pytest

from service.requests.solve import SolveRequest
from service.solve.solve import solve
from stage.errors import CalibrationError
from tests.scenes.captures import angles_degrees, edit_frame, make_scene, write_capture
from tests.scenes.ellipsoid import ellipsoid

LIGHTS = 30


def turned(directions, degrees, seed=1):
    """Each direction turned by an angle in a direction of its own."""
    aside = np.random.default_rng(seed).normal(size=directions.shape)
    aside -= (aside * directions).sum(axis=1, keepdims=True) * directions
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = np.radians(np.broadcast_to(degrees, len(directions)))[:, None]
    return directions * np.cos(angle) + aside * np.sin(angle)


def solved(tmp_path, scene, directions, lights="refined", **options):
    folder = write_capture(tmp_path / "capture", scene._replace(directions=directions))
    result = solve(SolveRequest(capture=folder, out=tmp_path / lights, method="robust", lights=lights, device="cpu", **options))
    error = angles_degrees(result.maps.normal, scene.normal)[result.maps.estimated]
    return result, json.loads((tmp_path / lights / "report.json").read_text()), error


# √(9/2n) of independent errors is left: 0.39 and 0.61
@pytest.mark.long
@pytest.mark.parametrize(("count", "part"), [(LIGHTS, 0.5), (12, 0.7)])
def test_errors_of_five_degrees_are_refined(tmp_path, count, part):
    scene = ellipsoid(count=count)
    rough = turned(scene.directions, 5)
    result, report, error = solved(tmp_path, scene, rough)
    told = report["found"]["refined_lights"]
    left = angles_degrees(np.array(told["directions"]), scene.directions)
    assert left.mean() < part * 5, left
    assert 0.4 < left.mean() / told["left_degrees"] < 2.5
    _, _, before = solved(tmp_path, scene, rough, "declared")
    assert np.mean(error) < np.mean(before)
    assert np.median(result.maps.sigma[result.maps.estimated]) > told["left_degrees"]


@pytest.mark.long
def test_right_directions_stay(tmp_path):
    scene = ellipsoid(count=LIGHTS)
    _, report, _ = solved(tmp_path, scene, scene.directions)
    found = np.array(report["found"]["refined_lights"]["directions"])
    assert angles_degrees(found, scene.directions).max() < 1  # noise and attached shadow


@pytest.mark.long
def test_what_all_lights_have_wrong_together_stays(tmp_path):
    """A turn of the whole table is one of the nine numbers that it alone tells."""
    scene = ellipsoid(count=LIGHTS)
    angle = np.radians(5)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    _, report, _ = solved(tmp_path, scene, scene.directions @ turn.T)
    assert np.mean(angles_degrees(np.array(report["found"]["refined_lights"]["directions"]), scene.directions @ turn.T)) < 1


@pytest.mark.long
def test_one_wrong_light_is_put_right_and_named(tmp_path):
    scene = ellipsoid(count=LIGHTS)
    degrees = np.zeros(LIGHTS)
    degrees[4] = 25
    result, report, _ = solved(tmp_path, scene, turned(scene.directions, degrees))
    assert angles_degrees(np.array(report["found"]["refined_lights"]["directions"][4]), scene.directions[4]) < 1.5
    assert any(warning.startswith("004.exr: its light moved by 2") for warning in result.warnings)


@pytest.mark.long
def test_declared_intensities_are_kept_where_they_are_asked_for(tmp_path):
    scene = ellipsoid(count=LIGHTS)
    _, report, _ = solved(tmp_path, scene, turned(scene.directions, 5), intensities="declared")
    assert set(report["found"]["refined_lights"]["factors"]) == {1.0}


def test_what_cannot_be_refined_is_refused(tmp_path):
    scene = ellipsoid(count=10)
    with pytest.raises(CalibrationError, match="--lights refined: 10 distant lights"):
        solved(tmp_path / "few", scene, scene.directions)
    folder = write_capture(tmp_path / "near", make_scene(24, 13), camera={"projection": "orthographic", "resolution": [24, 24],
                                                                          "pixel_size_m": 0.001})
    edit_frame(folder, 3, light={"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]})
    with pytest.raises(CalibrationError, match="1 near lights do not tell where they stand"):
        solve(SolveRequest(capture=folder, out=tmp_path / "out", method="robust", lights="refined", device="cpu"))
