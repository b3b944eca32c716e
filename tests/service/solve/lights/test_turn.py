"""Lights that are all declared turned alike: named with the turn, held by σ, and turned back on request."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.requests.solve import SolveRequest
from service.solve.solve import solve
from tests.marks import first_short
from tests.reference.microfacet import specular
from tests.scenes.captures import angles_degrees, write_capture
from tests.scenes.ellipsoid import ellipsoid, seen_from_near

DEGREES = 6.0
TURNS = {"tilted": (DEGREES, 0, 0), "about the view axis": (0, 0, DEGREES)}
BACK = 1.6
"""How far the turn that is found may be from the one that was made: two standard deviations of it where images have this noise."""


def glossy(count):
    """The ellipsoid with highlights of two roughnesses in squares, brighter than its texture."""
    scene = ellipsoid(size=96, count=count)
    row, col = np.indices(scene.mask.shape)
    alpha = np.where((row // 12 + col // 12) % 2, 0.25, 0.4) ** 2
    shine = np.stack([specular(scene.normal, light, np.array([0.0, 0.0, 1.0]), alpha, 0.06) for light in scene.directions])
    return scene._replace(images=scene.images + (shine * scene.mask)[..., None] * scene.irradiance[:, None, None])


SCENES = {"matt": (ellipsoid(size=160, count=16), "robust", None), "few lights": (ellipsoid(size=160, count=8), "robust", None),
          "perspective": (*seen_from_near(size=112)[:1], "lambert", seen_from_near(size=112)[1]),
          "glossy": (glossy(16), "svbrdf", None)}
QUICK = ["matt", "few lights", "perspective"]
"""The names of the scenes that take a second or two; the others are `long`."""


def solved(folder, name, turn, lights="declared"):
    scene, method, camera = SCENES[name]
    told = scene._replace(directions=Rotation.from_rotvec(turn, degrees=True).apply(scene.directions))
    capture = write_capture(folder / "capture", told, **({} if camera is None else {"camera": camera}))
    result = solve(SolveRequest(capture=capture, out=folder / "out", method=method, lights=lights, device="cpu"))
    known = result.maps.estimated
    error = angles_degrees(result.maps.normal, scene.normal)[known]
    return error, result.maps.sigma[known].astype(float), json.loads((folder / "out" / "report.json").read_text())


@pytest.mark.long
@pytest.mark.parametrize("name", [*QUICK, "glossy"])
def test_lights_that_are_declared_right_raise_no_doubt(tmp_path, name):
    _, _, report = solved(tmp_path, name, (0, 0, 0))
    assert "light_turn" not in report["found"] and not any("frames[]" in sentence for sentence in report["warnings"])


@first_short(("name", "how"), [*((name, "tilted") for name in QUICK), ("perspective", "about the view axis"), ("glossy", "tilted")])
def test_lights_that_are_turned_are_named_and_sigma_holds_it(tmp_path, name, how):
    """Without it normals were wrong by the turn, beyond ten σ of matt ones, without a word."""
    error, sigma, report = solved(tmp_path, name, TURNS[how])
    assert any("frames[].light.direction" in sentence and "--lights refined" in sentence for sentence in report["warnings"])
    found = report["found"]["light_turn"]
    assert np.abs(np.add(found["turn_degrees"], TURNS[how])).max() < BACK and found["sigma_degrees"] < BACK
    assert np.median(error) > 2 and np.median(error / sigma) < 1.4 and (error > 5 * sigma).mean() < 0.01


@pytest.mark.long
@pytest.mark.parametrize("turn", [(30, 0, 0), (0, -45, 0)])
def test_matt_surfaces_tell_larger_turns(tmp_path, turn):
    """They were taken for what metals make up: normals were wrong by 27° at a σ of 2°, without a word."""
    error, sigma, report = solved(tmp_path, "matt", turn)
    assert np.abs(np.add(report["found"]["light_turn"]["turn_degrees"], turn)).max() < BACK
    assert np.median(error) > 10 and np.median(error / sigma) < 1.4 and (error > 5 * sigma).mean() < 0.01


@pytest.mark.long
@pytest.mark.parametrize("name", ["few lights", "glossy"])
def test_lights_are_turned_back(tmp_path, name):
    error, sigma, report = solved(tmp_path, name, TURNS["tilted"], "refined")
    right, _, _ = solved(tmp_path / "right", name, (0, 0, 0))
    assert np.median(error) < np.median(right) + BACK and np.median(error / sigma) < 1.4
    assert len(report["found"]["refined_lights"]["directions"]) == len(SCENES[name][0].directions)
    left = angles_degrees(np.array(report["found"]["refined_lights"]["directions"]), SCENES[name][0].directions)
    assert np.median(left) < BACK


@pytest.mark.long
def test_highlights_refute_slopes(tmp_path, monkeypatch):
    """Materials that the model lacks bend slopes; where there are highlights these decide."""
    monkeypatch.setattr("service.solve.lights.turn.turn_by_slopes", lambda *_, **__: (Rotation.from_rotvec([0, 0.2, 0]), 1e-6 * np.eye(3)))
    assert "light_turn" not in solved(tmp_path / "glossy", "glossy", (0, 0, 0))[2]["found"]
    assert "light_turn" in solved(tmp_path / "matt", "matt", (0, 0, 0))[2]["found"]
