"""A light source beside the camera through `relit depth` and `relit simulate`: light goes from the source to the surface to the sensor."""

import json

import numpy as np
import pytest

from kernels.status import Status
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from tests.reference import tof
from tests.scenes.tof import cw_frames, pulsed_frames, write

ROWS, COLS = 30, 40
CAMERA = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [35.0, 35.0]}
SOURCE = (0.05, -0.02, 0.01)
SETTINGS = tof.even((60e6, 80e6), 4)


def scene():
    """[rows, cols] ranges along the rays of a floor and a ball, and the legs from the source, from points in space."""
    x, y = Camera.model_validate(CAMERA).plane_coordinates()
    ray = np.stack([x, y, -np.ones_like(x)], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    centre, radius = np.array([0.05, 0.02, -0.6]), 0.2
    middle = ray @ centre
    square = middle**2 - (centre @ centre - radius**2)
    ball = np.where(square > 0, middle - np.sqrt(np.maximum(square, 0)), np.inf)
    range_m = np.minimum(ball, 1.4 / (-ray[..., 2] + 0.3 * ray[..., 1] + 0.2))
    return range_m, np.linalg.norm(range_m[..., None] * ray - SOURCE, axis=-1)


def solve(folder, **span):
    return depth(DepthRequest(capture=folder, out=folder / "out", device="cpu", **span)).maps


def view():
    range_m, leg = scene()
    return tof.View((range_m + leg) / 2, np.full(range_m.shape, 0.6), np.full(range_m.shape, 0.9))


def test_continuous_wave_is_exact_and_as_sure_as_it_says(tmp_path):
    truth, images = scene()[0], tof.correlations(view(), 3e4, SETTINGS, seed=3)
    maps = solve(write(tmp_path / "c", cw_frames(images, SETTINGS, source_m=SOURCE), camera=CAMERA))
    along = maps.depth / maps.range
    error = (maps.range - truth) * along / maps.sigma
    assert maps.mask.all() and 0.8 < np.median(np.abs(error)) / 0.6745 < 1.2 and np.abs(error).max() < 5
    assert np.abs(np.mean(maps.range - truth)) < 2.5e-4  # the mean of 1200 errors of 2 mm is 0.06 mm
    bare = solve(write(tmp_path / "b", cw_frames(images, SETTINGS), camera=CAMERA))
    assert np.median(np.abs(bare.range - truth)) > 3e-3  # half of the 5 cm, times their direction: what an undeclared source costs


def test_near_and_far_are_ranges_from_the_camera(tmp_path):
    truth = scene()[0]
    frames = cw_frames(tof.correlations(view(), 3e4, SETTINGS, seed=3), SETTINGS, source_m=SOURCE)
    maps = solve(write(tmp_path / "c", frames, camera=CAMERA), near_m=0.5, far_m=1.3)
    clear = np.minimum(np.abs(truth - 1.3), np.abs(truth - 0.5)) > 0.015  # at least seven standard deviations
    outside = (truth > 1.3) | (truth < 0.5)
    assert np.mean(((maps.status == Status.OUT_OF_RANGE) == outside)[clear]) > 0.99  # at the rim of the ball σ reaches across the limit
    assert (truth > 1.32).any() and (truth < 1.28).any()


@pytest.mark.long
def test_histograms_with_a_source(tmp_path):
    truth = scene()[0]
    counts = tof.histogram(view(), 4000, bins=40, bin_s=0.5e-9, sigma_s=0.4e-9, background=0.1, seed=4)
    maps = solve(write(tmp_path / "p", pulsed_frames(counts, bin_s=0.5e-9, source_m=SOURCE), camera=CAMERA))
    error = (maps.range - truth)[maps.mask]
    assert maps.mask.mean() > 0.99 and np.abs(np.mean(error)) < 3e-4  # 2.5 mm too far without the source


@pytest.mark.long
@pytest.mark.parametrize("kind", ["cw", "pulsed"])
def test_what_is_simulated_is_solved_again(kind, tmp_path, relit):
    camera = Camera.model_validate(CAMERA)
    x, y = camera.plane_coordinates()
    z = (scene()[0] / np.sqrt(x * x + y * y + 1)).astype(np.float32)
    DepthMaps(camera=camera, mask=np.ones(z.shape, bool), depth=z, provenance={}).write(tmp_path / "depth.exr")
    outcome = relit("simulate", kind, tmp_path, "--out", tmp_path / "capture", "--no-noise", "--source-m", "0.05,-0.02,0.01")
    assert outcome.code == 0, outcome.err
    assert json.loads((tmp_path / "capture" / "capture.json").read_text())["frames"][0]["tof"]["source_m"] == list(SOURCE)
    assert relit("depth", tmp_path / "capture", "--out", tmp_path / "out", "--device", "cpu").code == 0
    maps = DepthMaps.read(tmp_path / "out" / "depth.exr")
    lit = maps.mask & (maps.sigma < 0.05)
    assert lit.mean() > 0.8 and np.abs(maps.depth - z)[lit].max() < (1e-4 if kind == "cw" else 4e-3)  # pulsed: bins of 22 cm
