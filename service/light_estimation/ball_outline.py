"""A ball from its mask: the sub-pixel outline, without a stand that the mask may contain.

Source: Fischler and Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981.
"""

import numpy as np

from service.light_estimation.ball import Ball, ball_from_outline, lines_of_sight
from stage.capture.camera import Camera
from stage.errors import CalibrationError

LEVEL = 0.5
"""The coverage of the mask at its outline."""
RANSAC_ROUNDS = 300
"""The rounds of RANSAC: when half the outline is that of the ball, three points lie on it in one round of eight, and 300 rounds miss
with a probability of 1e-17."""
INLIER_PX = 1.0
"""The largest distance of an inlier from the circle: binary masks round the outline by half a pixel, a stand is farther away."""
MIN_SHARE = 0.4
"""The least part of the length of the circle that the outline of the mask must cover."""
POINTS_PER_PX = 1.27
"""The outline points for each pixel of the length of a circle: 4/π crossings of the rows and columns of the grid on average."""


def ball_from_mask(camera: Camera, coverage: np.ndarray, *, radius_m: float | None = None, z_m: float | None = None) -> Ball:
    """Fit a ball to the outline of a mask by RANSAC.

    Three random outline points propose a circle (a cone for a perspective camera). The circle with most points within a pixel is
    fitted to these points, so that a stand or a hole does not influence it.

    Args:
        coverage: [rows, cols], from 0 outside to 1 inside, binary or anti-aliased.

    Raises:
        CalibrationError: the mask is empty, or its outline is no circle.
    """
    outline = outline_points(coverage)
    if len(outline) < 12:
        raise CalibrationError(f"the mask of the ball has an outline of {len(outline)} points: a ball needs a few pixels")
    rng = np.random.default_rng(0)
    best, best_ball = np.zeros(len(outline), dtype=bool), None
    for _ in range(RANSAC_ROUNDS):
        try:
            ball = ball_from_outline(camera, outline[rng.choice(len(outline), 3, replace=False)], error_px=0.0)
        except CalibrationError:
            continue
        inliers = np.abs(_distance_px(ball, camera, outline)) < INLIER_PX
        if inliers.sum() > best.sum():
            best, best_ball = inliers, ball
    if best_ball is None:
        raise CalibrationError("the outline of the ball's mask lies on a line")
    best_ball, best, error_px = refine_outline(camera, outline, best)
    share = best.sum() / (POINTS_PER_PX * 2 * np.pi * best_ball.radius_px)
    if share < MIN_SHARE:
        raise CalibrationError(f"the mask of the ball is not round: {share:.0%} of the best circle's outline is in it")
    return ball_from_outline(camera, outline[best], error_px=error_px, radius_m=radius_m, z_m=z_m)


def refine_outline(camera: Camera, outline: np.ndarray, inside: np.ndarray) -> tuple[Ball, np.ndarray, float]:
    """Fit a ball to the points near its outline, and choose these points anew, in turn.

    Args:
        outline: [points, 2] u, v.
        inside: [points] bool, those that a proposal takes for points of the outline.

    Returns:
        The ball without a scale, which points lie within a pixel of its outline, and the standard error of its centre in pixels.
    """
    for _ in range(3):  # the points near the fitted circle are a few more than those near the proposal
        ball = ball_from_outline(camera, outline[inside], error_px=0.0)
        distance = _distance_px(ball, camera, outline)
        inside = np.abs(distance) < INLIER_PX
        if not inside.any():
            raise CalibrationError("no point of the outline lies on a circle")
    return ball, inside, float(np.sqrt((distance[inside] ** 2).mean() * 2 / inside.sum()))


def outline_points(coverage: np.ndarray) -> np.ndarray:
    """Return the points, [n, 2] u and v, at which a mask crosses one half between neighbouring pixel centres, by linear interpolation."""
    values = coverage.astype(np.float64)
    found = []
    for axis in (0, 1):
        first, second = (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])
        row, col = np.nonzero((first > LEVEL) != (second > LEVEL))
        a, b = first[row, col], second[row, col]
        part = (LEVEL - a) / (b - a)
        found.append(np.stack([col + 0.5 + (part if axis == 1 else 0), row + 0.5 + (part if axis == 0 else 0)], axis=-1))
    return np.concatenate(found)


def _distance_px(ball: Ball, camera: Camera, outline: np.ndarray) -> np.ndarray:
    """Return the distance of image points from the outline of a ball in pixels, positive outside."""
    origin, direction = lines_of_sight(camera, outline[:, 0], outline[:, 1])
    if camera.projection == "orthographic":
        distance = np.linalg.norm(origin[:, :2] - ball.centre[:2], axis=1) - ball.radius
        return distance / (camera.pixel_size_m or 1.0)
    to_centre = np.linalg.norm(ball.centre)
    axis = ball.centre / to_centre
    angle = np.arctan2(np.linalg.norm(np.cross(direction, axis), axis=1), direction @ axis)
    assert camera.focal_px is not None  # the camera's validator saw to it
    return (angle - np.arcsin(ball.radius / to_centre)) * sum(camera.focal_px) / 2
