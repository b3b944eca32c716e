"""A light source beside the camera through `relit depth`: light goes from the source to the surface to the sensor."""

import numpy as np
import pytest

from kernels.status import Status
from stage.capture.camera import Camera
from tests.reference import tof
from tests.scenes.depth import depth_of
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


def view():
    range_m, leg = scene()
    return tof.View((range_m + leg) / 2, np.full(range_m.shape, 0.6), np.full(range_m.shape, 0.9))


def test_continuous_wave_is_exact_and_as_sure_as_it_says(tmp_path):
    truth, images = scene()[0], tof.correlations(view(), 3e4, SETTINGS, seed=3)
    maps = depth_of(write(tmp_path / "c", cw_frames(images, SETTINGS, source_m=SOURCE), camera=CAMERA)).maps
    along = maps.depth / maps.range
    error = (maps.range - truth) * along / maps.sigma
    assert maps.mask.all() and 0.8 < np.median(np.abs(error)) / 0.6745 < 1.2 and np.abs(error).max() < 5
    assert np.abs(np.mean(maps.range - truth)) < 2.5e-4  # the mean of 1200 errors of 2 mm is 0.06 mm
    bare = depth_of(write(tmp_path / "b", cw_frames(images, SETTINGS), camera=CAMERA)).maps
    assert np.median(np.abs(bare.range - truth)) > 3e-3  # half of the 5 cm, times their direction: what an undeclared source costs


def test_near_and_far_are_ranges_from_the_camera(tmp_path):
    truth = scene()[0]
    frames = cw_frames(tof.correlations(view(), 3e4, SETTINGS, seed=3), SETTINGS, source_m=SOURCE)
    maps = depth_of(write(tmp_path / "c", frames, camera=CAMERA), near_m=0.5, far_m=1.3).maps
    clear = np.minimum(np.abs(truth - 1.3), np.abs(truth - 0.5)) > 0.015  # at least seven standard deviations
    outside = (truth > 1.3) | (truth < 0.5)
    assert np.mean(((maps.status == Status.OUT_OF_RANGE) == outside)[clear]) > 0.99  # at the rim of the ball σ reaches across the limit
    assert (truth > 1.32).any() and (truth < 1.28).any()


@pytest.mark.long
def test_histograms_with_a_source(tmp_path):
    truth = scene()[0]
    counts = tof.histogram(view(), 4000, bins=40, bin_s=0.5e-9, sigma_s=0.4e-9, background=0.1, seed=4)
    maps = depth_of(write(tmp_path / "p", pulsed_frames(counts, bin_s=0.5e-9, source_m=SOURCE), camera=CAMERA)).maps
    error = (maps.range - truth)[maps.mask]
    assert maps.mask.mean() > 0.99 and np.abs(np.mean(error)) < 3e-4  # 2.5 mm too far without the source
