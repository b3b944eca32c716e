"""Squares of pixels: the depth at their centre, also of bent surfaces, the standard deviation of the fit, and none across steps."""

import numpy as np
import pytest

from service.scans.points.squares import squares_of
from stage.capture.camera import Camera

CAMERA = Camera(projection="perspective", resolution=(120, 90), focal_px=(400.0, 400.0))
SIDE = 5


def ball(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Depth of a ball of 0.5 m whose middle is 1 m away, on lines of sight (x, y, -1)."""
    square = x**2 + y**2 + 1
    return np.asarray((1 - np.sqrt(1 - square * (1 - 0.25))) / square)


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 1 / (1 + 2 * x - y)


@pytest.mark.parametrize(("surface", "most"), [(plane, 3e-7), (ball, 3e-7)], ids=["plane", "ball"])
def test_the_depth_is_that_at_the_centre(surface, most):
    """To rounding in single precision; the mean of the squares of the ball is 6 µm and more too far."""
    depth = surface(*CAMERA.plane_coordinates())
    found = squares_of(depth.astype(np.float32), np.full(depth.shape, 1e-5, np.float32), CAMERA, SIDE)
    there = found.depth > 0
    assert found.camera.resolution == (24, 18) and there.all()
    true = surface(*found.camera.plane_coordinates())
    assert np.abs(found.depth - true).max() < most
    if surface is ball:
        mean = depth.reshape(18, SIDE, 24, SIDE).mean(axis=(1, 3))
        assert np.abs(mean - true).min() > 20 * most


@pytest.mark.parametrize("side", [2, 3, 5])
def test_sigma_is_what_noise_does(side):
    """There are some 1700 squares of 5 pixels, so that their standard deviation is known to 1.7 %, and more smaller ones."""
    rng = np.random.default_rng(2)
    off = []
    for _ in range(4):
        noisy = (1 + 1e-3 * rng.standard_normal((90, 120))).astype(np.float32)
        found = squares_of(noisy, np.full(noisy.shape, 1e-3, np.float32), CAMERA, side)
        off.append(((found.depth - 1) / found.sigma)[found.depth > 0])
    assert np.concatenate(off).std() == pytest.approx(1, abs=0.03 if side < 5 else 0.06)


def test_squares_show_one_surface_alone():
    """A step of 20 mm at column 62, inside of a square, and a hole of one pixel."""
    depth = np.where(np.arange(120) < 62, 1.0, 1.02) * np.ones((90, 1))
    depth[11, 11] = 0
    found = squares_of(depth.astype(np.float32), np.full(depth.shape, 1e-4, np.float32), CAMERA, SIDE)
    expected = np.ones((18, 24), dtype=bool)
    expected[:, 12] = expected[2, 2] = False
    assert ((found.depth > 0) == expected).all()
    assert ((found.sigma > 0) == expected).all()
