"""Holes of meshes of known form, closed."""

import numpy as np
import pytest

from service.scans.fusion.closing import Closed, close_holes, close_pinholes
from service.scans.fusion.holes import area_vectors, find_holes
from tests.service.scans.fusion.test_holes import SIDE, sheet


def ball(rows: int, missing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A ball of radius 1 of squares of two triangles each, without those that are `missing` [rows, 2 rows] and without its poles."""
    theta, phi = np.meshgrid(np.linspace(0.2, np.pi - 0.2, rows + 1), np.arange(2 * rows) * np.pi / rows, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    row, col = np.nonzero(~missing)
    a, b = row * 2 * rows + col, row * 2 * rows + (col + 1) % (2 * rows)
    return points, np.concatenate([np.stack([a, a + 2 * rows, b + 2 * rows], axis=1),
                                   np.stack([a, b + 2 * rows, b], axis=1)]).astype(np.int32)


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    return float(np.einsum("fi,fi->", points[faces[:, 0]], area_vectors(points, faces)) / 6)


def whole(points: np.ndarray, faces: np.ndarray, closed: Closed) -> tuple[np.ndarray, np.ndarray]:
    return closed.extended(points), np.concatenate([faces, closed.faces])


@pytest.mark.parametrize("seed", range(4))
def test_a_ball_with_holes_of_any_form_becomes_watertight(seed):
    random = np.random.default_rng(seed)
    coarse = random.random((10, 20)) < 0.15
    missing = np.kron(coarse, np.ones((4, 4), dtype=bool)) | (random.random((40, 80)) < 0.01)  # wide ones that meet, and specks
    points, faces = ball(40, missing)
    closed = close_holes(points, faces, 0.08)
    after, all_faces = whole(points, faces, closed)
    found = find_holes(after, all_faces)
    assert (found.open_edges, found.shared_edges) == (0, 0) and closed.holes > 20
    assert np.array_equal(after[:len(points)], points)
    full = volume(*whole(*ball(40, np.zeros_like(missing)), close_holes(*ball(40, np.zeros_like(missing)), 0.08)))
    assert 0.8 * full < volume(after, all_faces) < full  # membranes lie within the ball, the widest .3 deep
    assert np.linalg.norm(after, axis=1).max() <= 1 + 1e-12


def test_a_membrane_is_flat_where_its_rim_is_and_carries_values():
    points, faces = sheet(30, 40, {(r, c) for r in range(6, 24) for c in range(5, 33) if (r + c) % 9})
    points = points.astype(np.float64)
    closed = close_holes(points, faces, 2 * SIDE)
    after = closed.extended(points)
    assert len(after) > len(points) + 50
    np.testing.assert_allclose(after[:, 2], 0, atol=1e-15)
    ramp = points @ [3.0, -2.0, 0.0] + 1
    assert closed.extended(ramp).min() >= ramp.min() and closed.extended(ramp).max() <= ramp.max()  # a mean of neighbours is no extreme
    np.testing.assert_allclose(closed.extended(ramp), after @ [3.0, -2.0, 0.0] + 1, atol=1e-12)


def test_pinholes_are_closed_and_specks_and_wide_holes_stay():
    points, faces = sheet(20, 20, {(3, 3), (8, 8), (8, 9), (15, 4), (15, 5), (15, 6), (16, 5)})
    speck, speck_faces = sheet(1, 1)
    points, faces = np.concatenate([points, speck + [0, 0, 1]]), np.concatenate([faces, speck_faces + len(points)]).astype(np.int32)
    closed = close_pinholes(points, faces, 2.5 * SIDE)
    after, all_faces = whole(points, faces, closed)
    assert closed.holes == 2 and len(after) == len(points) + 2
    assert sorted(hole.edges for hole in find_holes(after, all_faces).holes) == [4, 10, 80]  # the speck, the wide hole, the border
    assert (area_vectors(after, closed.faces)[:, 2] > 0).all()  # as the sheet


def test_a_chain_of_three_edges_is_one_face():
    points, faces = sheet(4, 4)
    inner = np.flatnonzero((faces > 5).all(axis=1) & (faces < 19).all(axis=1))[1]
    closed = close_pinholes(points, np.delete(faces, inner, axis=0), 2.5 * SIDE)
    assert closed.system.shape == (0, 0) and set(closed.faces[0]) == set(faces[inner])
    assert area_vectors(closed.extended(points), closed.faces)[0] == pytest.approx(area_vectors(points, faces)[inner], abs=1e-12)
