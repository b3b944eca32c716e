"""Small rigid motions and the rigid transform between matched points."""

import numpy as np
from scipy.spatial.transform import Rotation

from stage.transforms import cross_matrix


def logarithm(rotation: np.ndarray) -> np.ndarray:
    """Return the rotation vector [3], of at most π, of a rotation matrix [3, 3], in a small part of the time that SciPy takes for one."""
    vector = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]) / 2
    sine, cosine = float(np.linalg.norm(vector)), (float(np.trace(rotation)) - 1) / 2
    angle = np.arctan2(sine, cosine)
    if sine > 1e-6:
        return vector * (angle / sine)
    if cosine > 0:
        return vector
    axes = (rotation + np.eye(3)) / 2  # a half turn: a aᵀ
    column = axes[:, int(np.argmax(np.diag(axes)))]
    return np.pi * column / np.linalg.norm(column)


def moved(step: np.ndarray, pivot: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return a pose [4, 4] after a small motion [6]: a rotation vector about a pivot [3], radians, then a translation, metres."""
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    motion[:3, 3] = step[3:] + pivot - motion[:3, :3] @ pivot
    return motion @ pose


def screwed(twist: np.ndarray, pivot: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Return a pose [4, 4] after a screw motion, so that a turn about any axis stays one.

    Args:
        twist: [6] rotation vector in radians, and the motion of the pivot per such turn, metres.
        pivot: [3].
        pose: [4, 4] to whose left the motion is applied.

    Source:
        Murray, Li and Sastry, A Mathematical Introduction to Robotic Manipulation, CRC 1994, equation 2.36.
    """
    angle = float(np.linalg.norm(twist[:3]))
    cross = cross_matrix(twist[:3])
    if angle < 1e-6:
        along = np.eye(3) + cross / 2
    else:
        along = np.eye(3) + (1 - np.cos(angle)) / angle**2 * cross + (angle - np.sin(angle)) / angle**3 * cross @ cross
    return moved(np.concatenate([twist[:3], along @ twist[3:]]), pivot, pose)


def step_between(motion: np.ndarray, pivot: np.ndarray) -> np.ndarray:
    """Return the rotation vector about a pivot and the translation [6] of a rigid motion [4, 4]: the inverse of `moved`."""
    return np.concatenate([logarithm(motion[:3, :3]), motion[:3, :3] @ pivot + motion[:3, 3] - pivot])


def about(offset: np.ndarray) -> np.ndarray:
    """Return what takes a small motion [6] (rotation vector, translation) about one pivot to that about another, at an offset: [6, 6]."""
    out = np.eye(6)
    out[3:, :3] = -cross_matrix(offset)
    return out


def inverse(pose: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid transform [4, 4]."""
    out = np.eye(4)
    out[:3, :3] = pose[:3, :3].T
    out[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return out


def applied(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points [n, 3] under a rigid transform [4, 4]."""
    return points @ pose[:3, :3].T + pose[:3, 3]


def nearest_rigid(pose: np.ndarray) -> np.ndarray:
    """Return the rigid transform [4, 4] nearest to one whose rotation was typed with few digits."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    rigid = pose.copy()
    rigid[:3, :3] = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return rigid


def rigid_between(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the rigid transforms [m, 4, 4] that take [m, n, 3] weighted source points of m problems nearest to their targets.

    Source:
        Kabsch, "A solution for the best rotation to relate two sets of vectors", Acta Crystallographica A32, 1976.
    """
    share = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)
    of_source, of_target = ((share[:, None] @ points)[:, 0] for points in (source, target))
    spread = (share[..., None] * (target - of_target[:, None])).transpose(0, 2, 1) @ (source - of_source[:, None])
    u, _, vt = np.linalg.svd(spread)
    sign = np.ones((len(source), 3))
    sign[:, 2] = np.linalg.det(u @ vt)
    out = np.zeros((len(source), 4, 4))
    out[:, 3, 3] = 1
    out[:, :3, :3] = (u * sign[:, None, :]) @ vt
    out[:, :3, 3] = of_target - (out[:, :3, :3] @ of_source[..., None])[..., 0]
    return out
