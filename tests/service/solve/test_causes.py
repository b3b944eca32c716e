"""What a report says of pixels that are hard, and of lights that are wrong."""

import json

import numpy as np
import pytest

from kernels.status import Status
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.formats import images
from stage.results.maps import SurfaceMaps
from tests.scenes import captures


def solved(folder, out, method=Method.ROBUST, **options):
    result = solve(SolveRequest(capture=folder, out=out, method=method, device="cpu", **options))
    return result, json.loads((out / "report.json").read_text())


@pytest.fixture
def scene():
    return captures.make_scene(size=24, lights=14)


@pytest.mark.long
@pytest.mark.parametrize("method", [Method.ROBUST, Method.SVBRDF])
def test_a_light_that_points_elsewhere_is_named(tmp_path, scene, method):
    folder = captures.write_capture(tmp_path / "capture", scene)
    manifest = json.loads((folder / "capture.json").read_text())
    assert solved(folder, tmp_path / "good", method)[1]["suspect_lights"] == []
    judged = [i for i, f in enumerate(manifest["frames"]) if f["light"]["direction"][2] > 0.45]
    wrong = min(judged, key=lambda i: manifest["frames"][i]["light"]["direction"][2])  # the one that turning round moves most
    x, y, z = manifest["frames"][wrong]["light"]["direction"]
    captures.edit_frame(folder, wrong, light={**manifest["frames"][wrong]["light"], "direction": [-x, -y, z]})
    result, report = solved(folder, tmp_path / "bad", method)
    assert [s["image"] for s in report["suspect_lights"]] == [manifest["frames"][wrong]["image"]]
    assert result.suspects[0].misfit > 0.1


def test_a_light_of_another_strength_is_named_with_how_far_it_is_off(tmp_path, scene):
    folder = captures.write_capture(tmp_path / "capture", scene)
    manifest = json.loads((folder / "capture.json").read_text())
    wrong = next(i for i, f in enumerate(manifest["frames"]) if f["light"]["direction"][2] > 0.6)
    light = manifest["frames"][wrong]["light"]
    captures.edit_frame(folder, wrong, light={**light, "irradiance": [0.5 * e for e in light["irradiance"]]})
    _, report = solved(folder, tmp_path / "bad")
    assert report["suspect_lights"][0]["image"] == manifest["frames"][wrong]["image"]
    assert report["suspect_lights"][0]["misfit"] == pytest.approx(1.0, abs=0.05)  # reads twice what it should


def test_saturation_and_shadow_are_told_apart(tmp_path, scene):
    """A corner where all but two lights are cut off by the sensor, and one where they are dark."""
    folder = captures.write_capture(tmp_path / "capture", scene, saturation=0.9)
    manifest = json.loads((folder / "capture.json").read_text())
    rows = slice(11, 13)
    for index, frame in enumerate(manifest["frames"]):
        pixels = images.read_pixels(folder / frame["image"]).astype(np.float32)
        assert pixels.max() < 0.9
        if index >= 2:
            pixels[rows, 8:10] = 5.0
            pixels[rows, 14:16] = 0.0
        captures.write_exr(folder / frame["image"], pixels)
    _, report = solved(folder, tmp_path / "out", Method.LAMBERT)
    assert report["pixels"]["saturated"] == 4
    assert report["pixels"]["shadowed"] + report["pixels"]["dark"] >= 4
    assert report["pixels"]["too_few_lights"] == 0
    assert sum(report["pixels"][s.name.lower()] for s in Status) == report["pixels"]["mask"]


@pytest.mark.long
def test_loose_normals_are_counted_and_kept(tmp_path, scene):
    """Noise as strong as the light: the normals are given, as ambiguous, and as unsure where σ is above what was asked for."""
    folder = captures.write_capture(tmp_path / "capture", scene)
    rng = np.random.default_rng(1)
    for frame in json.loads((folder / "capture.json").read_text())["frames"]:
        pixels = images.read_pixels(folder / frame["image"]).astype(np.float32)
        captures.write_exr(folder / frame["image"], pixels * rng.uniform(0.05, 3, pixels.shape[:2] + (1,)).astype(np.float32))
    every, report = solved(folder, tmp_path / "all", max_sigma=180)
    assert report["pixels"]["ambiguous"] > 0.3 * report["pixels"]["mask"] and report["pixels"]["unsure"] == 0
    assert every.maps.mask.sum() == report["pixels"]["ok"] + report["pixels"]["ambiguous"]

    limit = float(np.quantile(every.maps.sigma[every.maps.mask], 0.2))  # that of normals which most readings contradict is a constant
    some, report = solved(folder, tmp_path / "some", max_sigma=limit)
    written = SurfaceMaps.read(tmp_path / "some" / "maps.exr", unsure=True)
    unsure = written.status == Status.UNSURE
    assert 0 < unsure.sum() == report["pixels"]["unsure"] < report["pixels"]["mask"]
    half = 1 + 2**-11  # the rounding of sigma in the file
    assert (written.sigma[unsure] > limit / half).all() and (written.sigma[written.mask] < limit * half).all()
    assert not written.mask[unsure].any() and np.array_equal(written.normal[unsure], every.maps.normal[unsure])
    assert np.array_equal(some.maps.mask, written.mask)


@pytest.mark.parametrize(("lights", "exposures", "method"), [(5, 3, "robust"), pytest.param(14, 1, "svbrdf", marks=pytest.mark.long)])
def test_exposures_of_one_light_do_not_make_a_capture_one_of_many_lights(tmp_path, lights, exposures, method):
    """Fifteen images of five lights say no more about a material than five do."""
    folder = captures.write_capture(tmp_path / "capture", captures.make_scene(size=16, lights=lights))
    manifest = json.loads((folder / "capture.json").read_text())
    frames = manifest["frames"]
    manifest["frames"] = [frame | {"exposure_s": 1.0} for frame in frames]
    for number in range(1, exposures):
        for frame in frames:
            name = f"exposure{number}_{frame['image']}"
            pixels = images.read_pixels(folder / frame["image"]).astype(np.float32)
            captures.write_exr(folder / name, pixels * np.float32(2**number))
            manifest["frames"].append(frame | {"image": name, "exposure_s": float(2**number)})
    (folder / "capture.json").write_text(json.dumps(manifest))
    assert solved(folder, tmp_path / "out", None)[1]["method"] == method
