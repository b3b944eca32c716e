"""Squares of pixels, local planes and nearest points of scans."""

import numpy as np
import pytest

from service.light_estimation.lambertian import degrees_between
from service.scans.points.neighbours import NearestWithin, Neighbours
from service.scans.points.planes import local_planes, robust_scatter
from service.scans.points.rigid import applied, moved
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


MM = 1e-3


def sphere(count: int = 40_000, radius: float = 0.2, noise: float = 0.0, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Points on the half of a sphere that a camera at the origin sees, a metre away, and their true normals."""
    rng = np.random.default_rng(seed)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = np.abs(normals[:, 2])
    return normals * (radius + noise * rng.standard_normal((count, 1))) + [0, 0, -1], normals


def test_normals_of_a_sphere_point_out_of_it_towards_the_camera():
    points, normals = sphere()
    planes = local_planes(points, origin=np.zeros(3))
    inner = normals[:, 2] > 0.3  # at the rim cells are half empty
    assert np.percentile(degrees_between(planes.normals[inner].T, normals[inner].T), 99) < 3  # cells are 4 mm, 1.2 degrees of the sphere


@pytest.mark.parametrize("noise", [0.2 * MM, 1 * MM])
def test_the_scatter_is_the_noise_where_the_surface_is_flat(noise):
    rng = np.random.default_rng(3)
    points = np.concatenate([rng.uniform(-0.3, 0.3, (50_000, 2)), noise * rng.standard_normal((50_000, 1)) - 1], axis=1)
    assert robust_scatter(local_planes(points, origin=np.zeros(3))) == pytest.approx(noise, rel=0.05)  # 25 points a plane


def test_points_on_a_line_and_single_points_have_no_plane():
    line = np.linspace(0, 1, 100)[:, None] * np.array([[1.0, 2, -3]]) - [0, 0, 1]
    for points in (line, line[:1], line[:0]):
        planes = local_planes(points, origin=np.zeros(3))
        assert not planes.normals.any() and not np.isfinite(robust_scatter(planes))


@pytest.mark.parametrize("within", [0.02, 0.2, 3.0])
def test_moving_points_have_the_nearest_of_all(within):
    rng = np.random.default_rng(5)
    tree, points = Neighbours(rng.uniform(size=(2000, 3))), rng.uniform(-1, 2, size=(400, 3))
    search, pose = NearestWithin(tree, len(points)), np.eye(4)
    for step in range(12):
        pose = moved(rng.normal(scale=0.05 / (1 + step), size=6), np.full(3, 0.5), pose)
        rows = slice(None, None, 1 + step % 3)
        index, apart = search.search(applied(pose, points[rows]), rows, within)
        expected, distance = tree.nearest(applied(pose, points[rows]))
        near = distance[:, 0] < within
        assert (np.isfinite(apart) == near).all()
        assert (index[near] == expected[near, 0]).all() and (apart[near] == distance[near, 0]).all()
