"""The track of a moving platform: its poses at known times, and the interpolation between them."""

from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from stage.errors import CalibrationError
from stage.frames import Transform
from stage.model import Strict


class Pose(Strict):
    """The pose of the platform at one time."""

    time_s: float
    world_from_platform: Transform


def _ascending(poses: tuple[Pose, ...]) -> tuple[Pose, ...]:
    for index in range(1, len(poses)):
        if not poses[index].time_s > poses[index - 1].time_s:
            raise ValueError(f"is out of order: pose {index} is not after pose {index - 1}")
    return poses


Track = Annotated[tuple[Pose, ...], Field(min_length=1), AfterValidator(_ascending)]
"""Poses in order of time; a single pose means a platform that stands still."""


def poses_at(track: tuple[Pose, ...], times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Interpolate the poses of a track at given times: positions linearly, rotations by slerp.

    Args:
        track: the poses in order of time.
        times_s: [n] seconds, on the clock of the track.

    Returns:
        rotation [n, 3, 3] and translation [n, 3] of world_from_platform, and covered [n] bool, which is False before the first and after
        the last pose. The nearest pose is returned there; a single pose covers all times.

    Raises:
        CalibrationError: a time is not finite.

    Source:
        Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985.
    """
    if not np.isfinite(times_s).all():
        raise CalibrationError("a shot has a time that is not finite")
    known = np.array([pose.time_s for pose in track])
    matrices = np.array([pose.world_from_platform for pose in track], dtype=np.float64)
    turns = np.array([_quaternion(matrix[:3, :3]) for matrix in matrices])
    if len(track) == 1:
        return (np.broadcast_to(matrices[0, :3, :3], (len(times_s), 3, 3)), np.broadcast_to(matrices[0, :3, 3], (len(times_s), 3)),
                np.ones(len(times_s), dtype=bool))
    after = np.clip(np.searchsorted(known, times_s, side="right"), 1, len(known) - 1)
    part = np.clip((times_s - known[after - 1]) / (known[after] - known[after - 1]), 0, 1)[:, None]
    translation = matrices[after - 1, :3, 3] * (1 - part) + matrices[after, :3, 3] * part
    one, two = turns[after - 1], turns[after]
    cosine = (one * two).sum(axis=1, keepdims=True)
    two, cosine = np.where(cosine < 0, -two, two), np.clip(np.abs(cosine), 0, 1)
    angle = np.arccos(cosine)
    tiny = angle < 1e-6  # interpolated linearly, because the sines vanish
    sine = np.where(tiny, 1.0, np.sin(angle))
    first = np.where(tiny, 1 - part, np.sin((1 - part) * angle) / sine)
    second = np.where(tiny, part, np.sin(part * angle) / sine)
    return _matrix(first * one + second * two), translation, (times_s >= known[0]) & (times_s <= known[-1])


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion [4] w x y z of a rotation: an eigenvector of Bar-Itzhack's matrix, which is stable at all angles."""
    m = rotation
    k = np.array([[m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
                  [m[2, 1] - m[1, 2], m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
                  [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
                  [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1]]])
    return np.linalg.eigh(k)[1][:, -1]


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotations [n, 3, 3] of quaternions [n, 4] w x y z of any length."""
    w, x, y, z = (quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)).T
    return np.stack([
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
        np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
        np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)], axis=1)
