"""Poses of scans of an object that a turntable turned before a camera."""

import numpy as np

from stage.sets.scan_set import Turntable
from stage.transforms import rotation_about


def turned_pose(table: Turntable, angle_deg: float) -> np.ndarray:
    """Return world_from_scan [4, 4] of a scan that was taken when the table had turned by an angle: it undoes the turn."""
    point = np.array(table.axis_point_m)
    pose = np.eye(4)
    pose[:3, :3] = rotation_about(table.axis, -angle_deg)
    pose[:3, 3] = point - pose[:3, :3] @ point
    return pose


def angle_of(table: Turntable, pose: np.ndarray) -> float:
    """Return the angle in degrees whose `turned_pose` has the rotation nearest to that of a pose."""
    rotation, axis = pose[:3, :3], np.array(table.axis)
    vector = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return -float(np.degrees(np.arctan2(axis @ vector, np.trace(rotation) - axis @ rotation @ axis)))


def freedom(table: Turntable) -> np.ndarray:
    """Return the motion about the axis by one radian, of small ones: [6, 1] rotation vector, and translation at the world's origin."""
    axis = np.array(table.axis)
    return np.concatenate([axis, np.cross(table.axis_point_m, axis)])[:, None]
