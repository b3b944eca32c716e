"""Range images of orthographic cameras, fused and measured against closed forms, alone and beside those of perspective cameras."""

import numpy as np

from kernels.fusion.views import RangeImage
from tests.kernels.fusion.scene import fuse, range_image
from tests.kernels.fusion.test_fusion import sphere
from tests.marks import first_short
from tests.scenes.statue import place, shoot, shoot_parallel

SIDE, PIXEL, VOXEL = 96, 2.5e-3, 2.5e-3
START = 1.0
"""Metres by which the frame lies before the place that a pose has, so that depths are above 0."""


def orthographic(depth: np.ndarray, mask: np.ndarray, normal: np.ndarray, pose: np.ndarray, sigma: float) -> RangeImage:
    """A range image whose pixels show one surface wherever four of them have a depth."""
    cell = np.zeros(mask.shape, dtype=bool)
    cell[:-1, :-1] = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    camera_from_world = np.linalg.inv(pose)
    camera_from_world[2, 3] -= START
    return RangeImage(np.where(mask, depth + START, 0), np.full(mask.shape, sigma), normal, cell, np.zeros(mask.shape), camera_from_world,
                      (1 / PIXEL, 1 / PIXEL), (mask.shape[1] / 2, mask.shape[0] / 2), orthographic=True)


def test_a_tilted_plane_is_exact(device):
    """The depth of a plane is linear in the image, so that every vertex lies on it: rounding is all that is left."""
    normal = np.array([0.3, -0.2, 0.9]) / np.linalg.norm([0.3, -0.2, 0.9])
    pose = place(0.7, 0.4, 0.9)
    u, v = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
    depth = (normal[0] * u - normal[1] * v) * PIXEL / normal[2]  # n·p = 0 at p = (u, −v, −depth)
    image = orthographic(depth, np.ones((SIDE, SIDE), dtype=bool), np.tile(normal, (SIDE, SIDE, 1)), pose, 1e-4)
    points, sigma, _ = fuse([image], VOXEL, pose[:3, 3] - 0.25, pose[:3, 3] + 0.25, device=device)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    assert len(points) > 5000 and np.abs(local @ normal).max() < 2e-6  # float32 at 1 m: 6e-8 m, some tens of operations
    assert np.ptp(local[:, 0]) > 0.95 * (SIDE - 2) * PIXEL and np.ptp(local[:, 1]) > 0.95 * (SIDE - 2) * PIXEL
    # σ along the normal of a reading that one to four pixels share, and a tenth of a pixel across
    across = 0.1 * PIXEL * np.sqrt(1 - normal[2] ** 2)
    assert np.hypot(1e-4 * normal[2] / 2, across) * 0.99 < sigma.min() and sigma.max() < np.hypot(1e-4 * normal[2], across) * 1.01


RADIUS, SIGMA = 0.1, 5e-4


def parallel_shots(count: int):
    for k in range(count):
        pose = place(2 * np.pi * k / count, 0.45 * (-1) ** k, 0.8)
        pose[:3, 3] = 0  # the plane z = 0 of the camera goes through the middle: depths have both signs
        shot = shoot_parallel(pose, (SIDE, SIDE), PIXEL, sigma=SIGMA, seed=k, scene=sphere)
        u, v = np.meshgrid(np.arange(SIDE) + 0.5 - SIDE / 2, np.arange(SIDE) + 0.5 - SIDE / 2)
        local = np.stack([u * PIXEL, -v * PIXEL, -shot.true], axis=-1) / RADIUS  # the closed form of its normal
        yield orthographic(shot.depth, shot.mask, np.where(shot.mask[..., None], local, 0), pose, SIGMA)


@first_short("perspective_too", [False, True])
def test_a_sphere_from_all_sides_has_its_place(device, perspective_too):
    images = list(parallel_shots(8))
    if perspective_too:
        images += [range_image(shoot(place(a, 0.1, 0.8), (SIDE, SIDE), SIDE * 0.8 / 0.3, sigma=SIGMA, seed=20, scene=sphere), SIGMA)
                   for a in (0.3, 2.4, 4.5)]
    points, sigma, _ = fuse(images, VOXEL, (-0.14,) * 3, (0.14,) * 3, device=device)
    error = sphere(points)
    assert np.median(np.abs(error)) < 0.6745 * SIGMA / np.sqrt(2)  # each point is seen by two views or more
    assert abs(np.mean(error)) < 0.1 * SIGMA
    assert 0.5 < np.sqrt(np.mean((error / sigma) ** 2)) < 1.2
