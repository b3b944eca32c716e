"""solve, export: the whole way from a capture with a known truth to its results."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from service.requests.solve import Method
from service.solve.methods.methods import METHODS
from stage.formats import exr
from tests.scenes.captures import angles_degrees, files_in, make_scene, write_capture

SCENE = make_scene(size=16, lights=7)


@pytest.mark.parametrize("method", ["lambert", "robust"])
def test_solve_finds_the_normals_and_albedo_that_were_rendered(relit, tmp_path, method):
    write_capture(tmp_path / "cap", SCENE)
    maps, _, said = relit.solve(tmp_path / "cap", "--method", method, out=tmp_path / "out")
    assert said.splitlines()[:3] == [f"maps     {tmp_path}/out/maps.exr", f"report   {tmp_path}/out/report.json",
                                     f"pixels   {SCENE.mask.sum()} ok"]
    assert np.array_equal(maps.mask, SCENE.mask)
    # half rounding in the stack, up to 2^-11 of each reading, gives 0.02 degrees at this tilt of the lights
    assert angles_degrees(maps.normal, SCENE.normal)[SCENE.mask].max() < 0.05
    assert np.allclose(maps.diffuse_albedo[SCENE.mask], SCENE.albedo[SCENE.mask], rtol=1.5e-3)  # that, and half in the file
    assert maps.specular is None and maps.roughness is None


def test_solve_finds_the_height_of_the_cap(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE, camera={"projection": "orthographic", "resolution": [16, 16], "pixel_size_m": 0.01})
    maps, *_ = relit.solve(tmp_path / "cap")
    radius = 0.08 / np.sin(np.radians(45))
    x, y = maps.camera.plane_coordinates()
    truth = np.sqrt(np.where(SCENE.mask, radius**2 - x**2 - y**2, radius**2))
    truth -= truth[SCENE.mask].mean()
    assert maps.height[SCENE.mask].mean() == pytest.approx(0, abs=1e-7)
    # normals that are 0.02 degrees off, all to one side, would tilt the cap by that over its radius of 0.08 m
    assert np.abs(maps.height - truth)[SCENE.mask].max() < 0.08 * np.radians(0.02)


def test_the_report_and_the_maps_say_where_they_come_from(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    _, report, _ = relit.solve(tmp_path / "cap", "--method", "lambert", "--device", "cpu", out=tmp_path / "out")
    assert report["schema"] == "relit.report/1" and report["method"] == "lambert" and report["device"].startswith("cpu")
    assert report["inputs"]["name"] == "cap" and report["inputs"]["frames"] == 7 and report["inputs"]["resolution"] == [16, 16]
    assert report["pixels"]["mask"] == report["pixels"]["ok"] == int(SCENE.mask.sum())
    assert set(report["timings_s"]) >= {"open", "ingest", "normals", "height"}
    assert {"relit", "warp-lang", "numpy", "OpenEXR"} <= set(report["versions"])
    assert report["residual"]["p95"] < 0.01
    assert report["residual"]["meaning"] == METHODS[Method.LAMBERT].residual
    metadata = exr.read_header(tmp_path / "out" / "maps.exr").metadata
    assert metadata["relit:capture"] == "cap" and metadata["relit:inputs"] == report["inputs"]["content"]
    assert json.loads(metadata["relit:options"]) == {"method": "lambert", "intensities": "chosen", "lights": "declared",
                                                        "materials": "coherent"}
    assert metadata["colorInteropID"] == "lin_rec709_scene" and "chromaticities" in metadata


def test_the_residual_of_every_method_is_documented():
    text = (Path(__file__).parents[3] / "docs" / "capture.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (.+) \|$", text.split("| method | residual of a pixel |")[1].split("\n\n")[0], re.MULTILINE)
    assert rows == [(str(method), entry.residual) for method, entry in METHODS.items()]


def test_solve_twice_is_the_same_file_and_the_cache_may_lie_elsewhere(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    before = files_in(tmp_path / "cap")
    for out in ("a", "b"):
        assert relit("solve", tmp_path / "cap", "--out", tmp_path / out, "--cache", tmp_path / "cache").code == 0
    assert (tmp_path / "a" / "maps.exr").read_bytes() == (tmp_path / "b" / "maps.exr").read_bytes()
    assert files_in(tmp_path / "cap") == before
    assert files_in(tmp_path / "a") == {"maps.exr", "report.json"}
