"""Meshes of measured depths: cut all around an object, though its edge pixels mix it with what lies behind."""

import numpy as np
import pytest

from service.asset.content.depth import depth_mesh
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps

CAMERA = Camera.model_validate({"projection": "perspective", "resolution": [120, 90], "focal_px": [288.0, 288.0]})
NEAR_M, FAR_M = 2.13, 2.31
"""A step of four pixels' footprints at 80°, as in real time-of-flight frames: mixed pixels make gentle slopes of it."""


def scene(inside):
    """A shape before a wall; each pixel is the mean of 8 × 8 places."""
    u, v = np.meshgrid((np.arange(120 * 8) + 0.5) / 8, (np.arange(90 * 8) + 0.5) / 8)
    share = inside(u, v).reshape(90, 8, 120, 8).mean(axis=(1, 3))
    rng = np.random.default_rng(7)
    depth = share * NEAR_M + (1 - share) * FAR_M + 0.002 * rng.standard_normal(share.shape)
    # readings of two surfaces disagree, so that edge pixels are unsure
    return DepthMaps(camera=CAMERA, mask=np.ones(share.shape, bool), depth=depth.astype(np.float32),
                     sigma=np.where((share > 0) & (share < 1), 0.03, 0.002).astype(np.float32)), share


def pieces(mesh):
    """The number of the piece of each vertex."""
    label = np.arange(len(mesh.points))
    faces = [*mesh.quads.T, *mesh.triangles.T]
    pairs = [(mesh.quads[:, i], mesh.quads[:, (i + 1) % 4]) for i in range(4)] + [(mesh.triangles[:, i], mesh.triangles[:, (i + 1) % 3])
                                                                                  for i in range(3)]
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    assert faces
    while True:
        least = np.minimum(label[first], label[second])
        before = label.copy()
        np.minimum.at(label, first, least)
        np.minimum.at(label, second, least)
        label = label[label]
        if (label == before).all():
            return label


@pytest.mark.parametrize("inside", [
    lambda u, v: np.hypot(u - 61.3, v - 44.2) < 27,
    lambda u, v: np.abs(0.8 * (u - 60) + 0.6 * (v - 45)) + np.abs(-0.6 * (u - 60) + 0.8 * (v - 45)) < 25,
    lambda u, v: (np.abs(u - 60.4 - 0.4 * (v - 45)) < 12) & (np.abs(v - 45) < 30),
], ids=["disc", "turned square", "slanted bar"])
def test_mixed_pixels_are_no_bridge(inside):
    maps, share = scene(inside)
    mesh = depth_mesh(maps)
    label = pieces(mesh)
    near, far = (np.unique(label[share[mesh.rows, mesh.cols] == part]) for part in (1.0, 0.0))
    assert len(near) == len(far) == 1 and near != far
    covered = np.zeros(share.shape, bool)
    covered[mesh.rows, mesh.cols] = True
    assert covered[(share == 0) | (share == 1)].mean() > 0.999
    for faces in (mesh.quads, mesh.triangles):
        assert np.ptp(mesh.points[faces, 2], axis=1).max() < 0.6 * (FAR_M - NEAR_M)
