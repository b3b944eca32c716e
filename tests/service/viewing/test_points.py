"""Depth as points: places, colours, depth and confidence of its pixels."""

from pathlib import Path

import numpy as np
import pytest

from service.depth.depth import depth
from service.requests.captures import ViewRequest
from service.requests.depth import DepthRequest
from service.viewing import points
from service.viewing.view_files import view
from stage.formats.ply import read_ply
from stage.results.depth_maps import DepthMaps
from tests.reference.view import View

RIG = Path(__file__).parents[3] / "samples" / "rig"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("points")
    depth(DepthRequest(capture=RIG, out=folder / "maps", cache=folder / "cache", device="cpu"))
    return folder


def show(folder, maps="maps") -> View:
    view(ViewRequest(capture=RIG, maps=folder / maps, out=folder / "out", cache=folder / "cache", device="cpu"))
    return View(folder / "out")


def arrays(found: View) -> tuple[np.ndarray, ...]:
    facts = found.facts["points"]
    count = facts["count"] + facts["unsure"]
    return (found.block(facts["positions"], "f4", count, 3), found.block(facts["colours"], "u1", count, 3),
            found.block(facts["depth"], "f4", count), found.block(facts["confidence"], "u1", count))


def test_points_are_those_of_the_cloud_and_then_the_unsure_ones(folder):
    found = show(folder)
    facts, cloud = found.facts["points"], read_ply(folder / "maps" / "points.ply")
    maps = DepthMaps.read(folder / "maps" / "depth.exr", unsure=True)
    positions, colours, depths, confidence = arrays(found)
    assert (facts["count"], facts["step"]) == (len(cloud.points), 1)
    np.testing.assert_allclose(positions[: facts["count"]], cloud.points, rtol=1e-6, atol=1e-7)
    assert np.array_equal(colours[: facts["count"]], cloud.colours)
    assert np.array_equal(depths[: facts["count"]], maps.depth[maps.mask])
    assert np.array_equal(confidence[: facts["count"]], np.rint(255 * maps.confidence[maps.mask]).astype(np.uint8))
    unsure = maps.estimated & ~maps.mask
    assert facts["unsure"] == unsure.sum() > 0
    assert np.array_equal(depths[facts["count"] :], maps.depth[unsure])
    assert found.facts["relight"] is None and found.facts["samples"] is None
    assert found.facts["layers"][0]["name"] == "depth"


def test_every_second_pixel_of_a_large_depth_and_grey_without_the_cloud(folder, monkeypatch):
    monkeypatch.setattr(points, "MOST_POINTS", 15000)
    found = show(folder)
    maps = DepthMaps.read(folder / "maps" / "depth.exr")
    assert found.facts["points"]["step"] == 2 and found.facts["points"]["count"] <= 15000
    assert np.array_equal(arrays(found)[2][: found.facts["points"]["count"]], maps.depth[::2, ::2][maps.mask[::2, ::2]])
    (folder / "alone").mkdir()
    (folder / "alone" / "depth.exr").write_bytes((folder / "maps" / "depth.exr").read_bytes())
    colours = arrays(show(folder, "alone"))[1]
    assert (colours == colours[:, :1]).all() and np.ptp(colours) > 100
