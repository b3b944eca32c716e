"""relit simulate: a depth to a capture, and back."""

import json

import numpy as np
import pytest

from kernels.status import Status
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps


def scene(folder):
    camera = Camera(projection="perspective", resolution=(20, 14), focal_px=(30, 30))
    depth = np.full((14, 20), 2.0, np.float32) + 0.05 * np.arange(20, dtype=np.float32)
    mask = np.ones(depth.shape, bool)
    mask[3:5, 4] = False
    maps = DepthMaps(camera=camera, mask=mask, depth=np.where(mask, depth, 0).astype(np.float32), provenance={"relit:capture": "wall"})
    maps.write(folder / "depth.exr")
    return maps


@pytest.mark.long
@pytest.mark.parametrize(("kind", "options", "most_m"), [
    ("cw", ["--modulation-hz", "20e6,80e6", "--no-noise"], 1e-4), ("cw", ["--phases", "3", "--full-well", "1e6"], 0.03),
    ("cw", ["--no-noise", "--source-m", "0.05,-0.02,0.01"], 1e-4), ("pulsed", ["--no-noise", "--source-m", "0.05,-0.02,0.01"], 4e-3),
    ("pulsed", ["--no-noise"], 2e-3), ("pulsed", ["--signal-photons", "40000", "--pulses", "20000"], 0.1),
])
def test_what_is_simulated_is_solved_again(kind, options, most_m, tmp_path, relit):
    truth = scene(tmp_path)
    assert "capture.json" in relit.done("simulate", kind, tmp_path, "--out", tmp_path / "capture", *options).out
    light = json.loads((tmp_path / "capture" / "capture.json").read_text())["frames"][0]["tof"]
    assert light.get("source_m") == ([0.05, -0.02, 0.01] if "--source-m" in options else None)
    maps, *_ = relit.depth(tmp_path / "capture", "--device", "cpu")
    assert np.abs(maps.depth - truth.depth)[truth.mask].max() < most_m
    assert (maps.status[~truth.mask] == Status.LOW_MODULATION).all()


def test_bad_options_are_one_sentence(tmp_path, relit):
    scene(tmp_path)
    for options in (["--phases", "2"], ["--modulation-hz", "0"], ["--modulation-hz", "fast"], ["--albedo", "2"]):
        outcome = relit("simulate", "cw", tmp_path, "--out", tmp_path / "c", *options)
        assert outcome.code == 2 and outcome.err.count("\n") == 1, outcome.err
    assert relit("simulate", "cw", tmp_path / "nothing", "--out", tmp_path / "c").code == 2
