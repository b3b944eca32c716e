"""Pose graphs of random poses with known noise: what comes out, how sure it says it is, and pairs that are wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.scans.points.rigid import inverse, logarithm, moved, step_between
from service.scans.registration.pose_graph import REFUSED, Edge, solve

MM = 1e-3


def random_pose(rng: np.random.Generator, size: float = 1.0) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.standard_normal(3)).as_matrix()
    pose[:3, 3] = size * rng.standard_normal(3)
    return pose


def chain(rng: np.random.Generator, count: int, reach: int, sigma: np.ndarray) -> tuple[list[np.ndarray], list[Edge]]:
    """Poses in a ring, and pairs with neighbours up to `reach` away, each with noise of σ [6] about its pivot."""
    poses = [random_pose(rng) for _ in range(count)]
    edges = []
    for a in range(count):
        for step in range(1, reach + 1):
            b = (a + step) % count
            pivot = rng.standard_normal(3)
            truth = inverse(poses[a]) @ poses[b]
            edges.append(Edge(a, b, moved(sigma * rng.standard_normal(6), pivot, truth), pivot, np.diag(1 / sigma**2)))
    return poses, edges


@pytest.mark.parametrize("vector", [(0, 0, 0), (1e-10, 0, 0), (0.3, -0.2, 1.0), (np.pi - 1e-9, 0, 0), (0, np.pi, 0)])
def test_logarithm_undoes_exponential(vector):
    matrix = Rotation.from_rotvec(vector).as_matrix()
    found = logarithm(matrix)
    np.testing.assert_allclose(Rotation.from_rotvec(found).as_matrix(), matrix, atol=1e-7)
    assert np.linalg.norm(found) == pytest.approx(np.linalg.norm(vector), abs=1e-7)


def test_a_step_is_what_moved_makes():
    rng = np.random.default_rng(1)
    pivot, step, pose = rng.standard_normal(3), 0.3 * rng.standard_normal(6), random_pose(rng)
    np.testing.assert_allclose(step_between(moved(step, pivot, pose) @ inverse(pose), pivot), step, atol=1e-12)


@pytest.mark.long
def test_errors_of_poses_are_those_that_the_hessian_says():
    """20 graphs of 6 scans: the squared errors in units of their covariance are χ² with 30 degrees of freedom, mean 30 ± 1.7."""
    sigma = np.array([1e-4, 2e-4, 1e-4, 1 * MM, 0.5 * MM, 2 * MM])
    squares = []
    for seed in range(20):
        poses, edges = chain(np.random.default_rng(seed), 6, 2, sigma)
        start = {k: pose if k == 0 else moved(np.full(6, 0.02), np.zeros(3), pose) for k, pose in enumerate(poses)}
        solved = solve(edges, start, fixed=0)
        off = np.concatenate([step_between(solved.poses[k] @ inverse(poses[k]), solved.centre) for k in range(6)])[6:]
        squares.append(off @ solved.hessian[6:, 6:] @ off)
        np.testing.assert_array_equal(solved.poses[0], poses[0])
    assert np.mean(squares) == pytest.approx(30, rel=0.15)  # robust weights of 0.9 and more lower the information by as much


def test_a_wrong_pair_loses_its_weight():
    rng = np.random.default_rng(3)
    poses, edges = chain(rng, 8, 2, np.full(6, 1 * MM))
    for wrong in (0, 5, 9):
        edges[wrong] = edges[wrong]._replace(pose=moved(np.full(6, 0.1), edges[wrong].pivot, edges[wrong].pose))
    solved = solve(edges, {k: moved(np.full(6, 0.03 * (k > 0)), np.zeros(3), pose) for k, pose in enumerate(poses)}, fixed=0)
    assert {k for k, weight in enumerate(solved.weights) if weight <= REFUSED} == {0, 5, 9}
    off = [np.linalg.norm(step_between(solved.poses[k] @ inverse(poses[k]), poses[k][:3, 3])) for k in range(8)]
    assert max(off) < 10 * MM  # each rotates by about a milliradian


def test_poses_move_only_in_the_ways_that_are_left_to_them():
    poses, edges = chain(np.random.default_rng(4), 4, 1, np.full(6, 1 * MM))
    point, axis = np.array([0.3, 0.1, -2.0]), np.array([0.0, 1.0, 0.0])
    way = np.concatenate([axis, np.cross(point, axis)])[:, None]
    start = {k: moved(np.concatenate([0.01 * k * axis, np.zeros(3)]), point, pose) for k, pose in enumerate(poses)}
    solved = solve(edges, start, fixed=0, freedoms=dict.fromkeys(range(4), way))
    for k in range(1, 4):
        turn = step_between(solved.poses[k] @ inverse(poses[k]), point)
        np.testing.assert_allclose(np.delete(turn, 1), 0, atol=1e-9)
        assert abs(turn[1]) < 5 * MM  # a milliradian a pair
    held = solve(edges, start, fixed=0, freedoms=dict.fromkeys(range(4), way), priors={k: np.array([[1e14]]) for k in range(4)})
    for k in range(4):
        np.testing.assert_allclose(held.poses[k], start[k], atol=1e-6)
