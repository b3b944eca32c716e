"""Local planes of point sets: normals and scatter of surfaces that are known in closed form."""

import numpy as np
import pytest

from service.scans.points.planes import local_planes, robust_scatter
from tests.scenes.joined import degrees_between

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
