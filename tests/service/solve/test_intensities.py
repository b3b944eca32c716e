"""Intensities of the lights that are declared wrongly are refined from the object, and still said to be wrong."""

import json

import numpy as np
import pytest

from service.requests.solve import SolveRequest
from service.solve.solve import solve
from tests.kernels.scenes import cap
from tests.scenes import captures

LIGHTS = 40
GROSS = 7
"""A light of which the manifest declares 2.5 times the irradiance."""


def solved(folder, factor):
    """The capture of a cap under lights whose irradiance is `factor` times what the manifest says: error of normals, report."""
    scene = captures.make_scene(28, LIGHTS)
    directions, ones = cap(LIGHTS, 60.0), np.ones((LIGHTS, 3))
    scene = scene._replace(directions=directions, irradiance=ones,
                           images=captures.render(scene.normal, scene.albedo, directions, ones * factor[:, None]))
    captures.write_capture(folder, scene)
    result = solve(SolveRequest(capture=folder, out=folder / "out", device="cpu", method="svbrdf"))
    cosine = (result.maps.normal * scene.normal).sum(axis=-1)[result.maps.mask]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1))), json.loads((folder / "out" / "report.json").read_text())


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    factor = np.exp(np.random.default_rng(2).normal(0, 0.06, LIGHTS))
    factor[GROSS] = 0.4
    return factor, *solved(tmp_path_factory.mktemp("wrong"), factor)


def test_wrong_intensities_are_refined_and_reported(wrong):
    factor, error, report = wrong
    told = report["found"]["light_factors"]
    assert told["believed"] and told["left_out_gain"] > 0.3
    untold = np.stack([np.ones(LIGHTS), cap(LIGHTS, 60.0)[:, 2]], axis=1)
    missed = np.log(np.array(told["factors"]) / factor)
    missed -= untold @ np.linalg.lstsq(untold, missed, rcond=None)[0]
    assert missed.std() < 0.2 * np.log(factor).std()  # what the rounds leave: normals have followed the wrong intensities
    assert np.median(error) < 0.6, np.median(error)


def test_a_gross_error_still_alarms(wrong):
    report = wrong[2]
    assert report["suspect_lights"][0]["image"] == f"{GROSS:03d}.exr"


def test_right_intensities_stay(tmp_path):
    error, report = solved(tmp_path, np.ones(LIGHTS))
    assert report["found"]["light_factors"]["believed"] is False
    assert "factors" not in report["found"]["light_factors"]
    assert np.median(error) < 0.1
