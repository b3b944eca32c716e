"""Coordinate frames: pixel centres, rigid transforms that are named a_from_b, rotations, and even directions on the sphere.

Camera frame: right-handed, +x right, +y up, +z towards the viewer; the camera looks along -z. Image coordinates (u, v) are
continuous from the top-left corner of the image, u right and v down: the centre of pixel (row r, column c) is (c + 0.5, r + 0.5).
"""

import math
from collections.abc import Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator

RIGID_TOLERANCE = 1e-4
"""The largest difference between R Rᵀ and the identity: matrices are typed and printed with four digits or more."""
ROTATION_ROUNDING = 1e-6
"""The largest such difference that single precision alone makes; beyond it a rotation is said to be off."""

OPENCV_FROM_CAMERA = np.diag([1.0, -1.0, -1.0])
"""The rotation from the camera frame to the axes of OpenCV, x right, y down, z forward; it is its own inverse."""


def pixel_centres(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the continuous image coordinates of every pixel centre. Returns u [height, width] and v [height, width], float64, pixels."""
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return u, v


def off_rotation(matrix: np.ndarray) -> float:
    """Return how far the upper left [3, 3] of a matrix is from a rotation or a mirror: the largest difference of R Rᵀ and the identity."""
    return float(np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max())


def scaled_rotation(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion [4] (x, y, z, w) times the square of its length, which is 1 unless it was rounded."""
    axis, w = quaternion[:3], quaternion[3]  # Euler and Rodrigues
    return (w * w - axis @ axis) * np.eye(3) + 2 * np.outer(axis, axis) + 2 * w * np.cross(np.eye(3), axis)


def rigid_fault(matrix: np.ndarray, tolerance: float = RIGID_TOLERANCE) -> str | None:
    """Return why a 4×4 matrix is not a rotation and a translation within a tolerance of R Rᵀ, or None when it is."""
    if not np.isfinite(matrix).all():
        return "holds a value that is not finite"
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        return "has a last row other than 0 0 0 1"
    if off_rotation(matrix) > tolerance:
        return "is not a rotation and a translation"
    if np.linalg.det(matrix[:3, :3]) < 0:
        return "mirrors (its rotation has determinant -1)"
    return None


def _rigid(rows: tuple[tuple[float, float, float, float], ...]) -> tuple[tuple[float, float, float, float], ...]:
    fault = rigid_fault(np.array(rows, dtype=np.float64))
    if fault:
        raise ValueError(fault)
    return rows


Row = tuple[float, float, float, float]
Transform = Annotated[tuple[Row, Row, Row, Row], AfterValidator(_rigid)]
"""The rows of a 4×4 `a_from_b` matrix in a manifest: a rotation and a translation."""


def rotation_about_y(degrees: float) -> np.ndarray:
    """Return the rotation about +y by an angle, positive from +z towards +x.
    Returns [3, 3] float64 for column vectors: rotated = rotation @ direction."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def cross_matrix(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the matrix [3, 3] whose product with a vector is the cross product of the given one [3] with it."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_about(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    """Return the rotation about an axis through the origin by an angle, positive by the right-hand rule.
    `axis`: a unit vector. Returns [3, 3] float64 for column vectors: rotated = rotation @ direction.

    Source: Rodrigues' formula.
    """
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return c * np.eye(3) + s * cross_matrix(axis) + (1 - c) * np.outer(axis, axis)


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return directions that are spread evenly over the sphere, a Fibonacci grid. Returns [count, 3] float64 unit vectors.

    Source: Swinbank and Purser, "Fibonacci grids", Quarterly Journal of the Royal Meteorological Society 132, 2006.
    """
    z = 1 - (2 * np.arange(count) + 1) / count
    ring, azimuth = np.sqrt(1 - z * z), np.pi * (1 + 5**0.5) * np.arange(count)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)
