"""Normals of depth maps: exact on planes, close on a sphere, none across a break."""

import numpy as np
import pytest

from stage.capture.camera import Camera
from stage.results.depth_normals import depth_normals
from tests.reference import projector as reference
from tests.scenes.captures import angles_degrees

SHAPE = reference.Device(60, 44, 90.0, (-0.1, 0.02, 0.0), (0.001, -0.001))
CAMERA = Camera.model_validate({
    "projection": "perspective", "resolution": [60, 44], "focal_px": [90.0, 90.0], "principal_px": SHAPE.principal.tolist(),
    "distortion": {"model": "brown_conrady", "k": SHAPE.k, "p": SHAPE.p}})
RAYS = reference.pixel_rays(SHAPE)
ALL = np.ones((44, 60), bool)


@pytest.mark.parametrize("radius", [1, 2])
@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.5, -0.4, 1.0), (-1.2, 0.3, 0.9)])
def test_a_plane_has_its_normal_everywhere(normal, radius):
    depth = reference.plane_depth(RAYS, (0.0, 0.0, -2.0), normal)
    found = depth_normals(depth, ALL, CAMERA, radius=radius)
    # corners have only three neighbours
    assert angles_degrees(found[1:-1, 1:-1], normal / np.linalg.norm(normal)).max() < 1e-3  # float32


def test_a_sphere(monkeypatch):
    depth = reference.sphere_depth(RAYS, (0.1, 0.0, -2.0), 0.6)
    mask = np.isfinite(depth)
    found = depth_normals(np.nan_to_num(depth, nan=0.0), mask, CAMERA)
    truth = (RAYS * np.nan_to_num(depth)[..., None] - (0.1, 0.0, -2.0)) / 0.6
    middle = mask & (truth[..., 2] > 0.8)
    assert angles_degrees(found[middle], truth[middle]).max() < 1.5  # a pixel spans two degrees of the sphere
    assert not found[~mask].any()
    monkeypatch.setattr("stage.results.depth_normals.ROWS", 7)  # bands change nothing
    assert (depth_normals(np.nan_to_num(depth, nan=0.0), mask, CAMERA) == found).all()


def test_nothing_is_fitted_across_a_break():
    depth = np.where(np.arange(60) < 30, 1.0, 2.0) * np.ones((44, 60))
    assert np.abs(depth_normals(depth, ALL, CAMERA)[1:-1, 1:-1] - (0, 0, 1)).max() < 1e-6


def test_pixels_without_neighbours_have_none():
    mask = np.zeros((44, 60), bool)
    mask[10, 10], mask[20] = True, True  # one alone; one row, which spans no plane
    assert not depth_normals(np.ones((44, 60)), mask, CAMERA).any()


def test_a_floor_has_normals_up_to_the_horizon():
    with np.errstate(divide="ignore"):
        depth = reference.plane_depth(RAYS, (0.0, -0.3, 0.0), (0.0, 1.0, 0.0))
    mask = (depth > 0) & (depth < 20)
    grazing = mask & (depth > 0.3 * 8)  # steeper than 80°
    assert grazing.sum() > 60
    found = depth_normals(np.where(mask, depth, 0), mask, CAMERA)
    assert angles_degrees(found[grazing], np.array([0.0, 1.0, 0.0])).max() < 0.05  # float32


def test_noise_takes_no_normal_away():
    depth = reference.plane_depth(RAYS, (0.0, 0.0, -3.0), (0.2, 0.1, 1.0))
    sigma = np.full(depth.shape, 0.15)  # a step to a neighbour is often steeper than 80°
    noisy = depth + sigma * np.random.default_rng(5).standard_normal(depth.shape)
    missing, blind = (int((~depth_normals(noisy, ALL, CAMERA, sigma=given).any(axis=-1)).sum()) for given in (sigma, None))
    assert missing == 0 and blind > 10
