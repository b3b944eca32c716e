"""The position of a near light from two mirror balls or more: the point nearest to the reflected lines of sight.

Source: Powell, Sarkar and Goldgof, "A simple strategy for calibrating the geometry of light sources", TPAMI 23(9), 2001.
"""

import math
from typing import NamedTuple

import numpy as np

from stage.errors import CalibrationError

MIN_CONVERGENCE_DEGREES = 1.0
"""The least angle between two rays: below it an error of one pixel moves the light by as much as its distance."""
MISS_DEGREES = 1.0
"""The angle between a ray and the direction to the nearest point, seen from the ball, above which the light is flagged."""
MISSES = "rays miss"
"""The flag of a light whose rays do not meet."""


class Position(NamedTuple):
    """The measured position of a near light."""

    position: np.ndarray  # [3] float64, in the unit of the balls
    residual: float
    """The root mean square distance from the rays, in the unit of the balls."""
    uncertainty: float
    """The standard error of the position in the unit of the balls, propagated from the uncertainty of the rays."""
    flags: tuple[str, ...]


def nearest_point(points: np.ndarray, directions: np.ndarray, uncertainty_degrees: np.ndarray) -> Position:
    """Return the point with the least sum of squared distances from rays: Σ (I - d dᵀ)(x - p) = 0.

    Args:
        points: [balls, 3] the point at which each ray leaves its ball.
        directions: [balls, 3] unit directions of the rays.
        uncertainty_degrees: [balls] the standard error of each direction.

    Raises:
        CalibrationError: the rays are nearly parallel, or meet behind a ball.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = across.sum(axis=0)
    # for two rays at an angle γ the eigenvalues are 1 - cos γ, 1 + cos γ and 2
    least = float(np.linalg.eigvalsh(normal)[0])
    angle = math.degrees(math.acos(np.clip(1 - 2 * least / len(points), -1, 1)))
    if angle < MIN_CONVERGENCE_DEGREES:
        raise CalibrationError(f"the rays from the balls are {angle:.2f}° from parallel: the light is too far to be placed: "
                               "move the balls apart, or take it as distant with mirror-ball")
    position = np.linalg.solve(normal, (across @ points[:, :, None]).sum(axis=0))[:, 0]
    way = position - points
    distance = np.linalg.norm(way, axis=1)
    if ((way * directions).sum(axis=1) <= 0).any():
        raise CalibrationError("the rays from the balls meet behind them: the balls are given in the wrong place or order, or of "
                               "the wrong radius")
    miss = np.linalg.norm((across @ way[:, :, None])[:, :, 0], axis=1)
    spread = np.radians(uncertainty_degrees) * distance
    inverse = np.linalg.inv(normal)
    covariance = inverse @ (across * (spread**2)[:, None, None]).sum(axis=0) @ inverse
    flags = (MISSES,) if np.degrees(np.arctan2(miss, distance)).max() > MISS_DEGREES else ()
    return Position(position, float(np.sqrt((miss**2).mean())), math.sqrt(float(np.trace(covariance))), flags)
