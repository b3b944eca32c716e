"""Nearest points of a mesh, against all of its faces in float64."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.surface.nearest import NearestOnMesh


def octahedron() -> tuple[np.ndarray, np.ndarray]:
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    upper = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4]])
    return points, np.concatenate([upper, np.where(upper[:, ::-1] == 4, 5, upper[:, ::-1])])


def nearest_of(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """The distance of each point [n] to the nearest of [f, 3, 3] triangles: within its plane, along its sides, or at its corners."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    from_a = points[:, None] - a
    height = (from_a * normal).sum(-1)
    foot = points[:, None] - height[..., None] * normal
    within = np.ones(height.shape, bool)
    least = np.full(height.shape, np.inf)
    for start, end in ((a, b), (b, c), (c, a)):
        side = end - start
        within &= (np.cross(side, foot - start) * normal).sum(-1) >= 0
        along = np.clip(((points[:, None] - start) * side).sum(-1) / (side**2).sum(-1), 0, 1)
        least = np.minimum(least, np.linalg.norm(points[:, None] - start - along[..., None] * side, axis=-1))
    return np.where(within, np.abs(height), least).min(axis=1)


@pytest.mark.parametrize(("scale", "at"), [(1.0, 0.0), (1e-3, 0.5)])
def test_distances_and_sides_of_an_octahedron(device, scale, at):
    corners, faces = octahedron()
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (500, 3))
    found = NearestOnMesh(scale * corners + at, faces, device=device).search(scale * points + at, 10 * scale)
    place = np.einsum("nk,nki->ni", found.share, corners[faces[found.face]])
    assert np.abs(np.linalg.norm(points - place, axis=1) - nearest_of(points, corners[faces])).max() < 2e-6  # float32 of sizes of 3
    assert (found.outside == (np.abs(points).sum(axis=1) > 1)).all()
    assert found.share.min() > -1e-6 and np.allclose(found.share.sum(axis=1), 1)


def test_what_is_too_far_has_no_face(device):
    corners, faces = octahedron()
    found = NearestOnMesh(corners, faces, device=device).search(np.array([[0.0, 0, 3.0], [0, 0, 1.05]]), 0.1)
    assert found.face[0] == -1 and found.face[1] >= 0
    assert len(NearestOnMesh(corners, faces, device=device).search(np.zeros((0, 3)), 1.0).face) == 0


def test_faces_need_their_points(device):
    corners, faces = octahedron()
    for wrong in (faces[:0], faces + 1):
        with pytest.raises(ArrayError, match="points"):
            NearestOnMesh(corners, wrong, device=device)
