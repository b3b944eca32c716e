"""A ball as a camera sees it: its place in the camera frame, and the normal and line of sight at every one of its pixels.

A far light needs no scale: a perspective camera sees a ball only up to distance, and an orthographic one not its distance at all.
"""

import math
from typing import NamedTuple

import numpy as np

from stage.camera import Camera
from stage.errors import CalibrationError

CIRCLE_POINTS = 360
"""Points of a typed circle that stand for the outline."""
CIRCLE_ERROR_PX = 0.5
"""How well a circle typed by hand lies on the outline."""


class Ball(NamedTuple):
    """A sphere in the camera frame."""

    centre: np.ndarray  # [3] float64; orthographic: its z is assumed, not seen
    radius: float
    metric: bool
    """Centre and radius are in metres; otherwise pixels (orthographic) or radii of the ball (perspective, radius 1)."""
    radius_px: float
    """Of the outline, on average."""
    outline_error_px: float
    """Standard error of the centre of the outline."""


class BallView(NamedTuple):
    """What the pixels of a ball show, over a box of the image."""

    box: tuple[slice, slice]
    """Rows and columns of the image that the box covers."""
    inside: np.ndarray  # [h, w] bool, the line of sight of the pixel's centre meets the ball
    normal: np.ndarray  # [h, w, 3] float64, unit, camera frame; 0 outside
    to_viewer: np.ndarray  # [h, w, 3] float64, unit, from the ball to the camera
    point: np.ndarray  # [h, w, 3] float64, on the ball, in its unit; 0 outside


def lines_of_sight(camera: Camera, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the line of sight of each image point begins and goes.

    Returns:
        origin [..., 3] and direction [..., 3] unit, away from the camera; camera frame, float64. Orthographic: on z = 0.
    """
    x, y = camera.plane_at(np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64))
    zero = np.zeros_like(x)
    if camera.projection == "orthographic":
        return np.stack([x, y, zero], axis=-1), np.stack([zero, zero, zero - 1], axis=-1)
    toward = np.stack([x, y, zero - 1], axis=-1)
    return np.zeros_like(toward), toward / np.linalg.norm(toward, axis=-1, keepdims=True)


def ball_from_circle(camera: Camera, u: float, v: float, radius_px: float, *, radius_m: float | None = None,
                     z_m: float | None = None) -> Ball:
    """The ball whose outline is a typed circle.

    A perspective camera sees a ball off its axis as an ellipse; the circle is then taken as an approximation to it.

    Args:
        u, v: centre, continuous image coordinates.
        radius_px: in pixels.
        radius_m, z_m: as `ball_from_outline` takes them.

    Raises:
        CalibrationError: the circle is not wholly in the image.
    """
    if not (radius_px > 1 and radius_px <= u <= camera.width - radius_px and radius_px <= v <= camera.height - radius_px):
        raise CalibrationError(f"ball {u:g},{v:g},{radius_px:g}: is not wholly inside the {camera.width}x{camera.height} image")
    turn = np.linspace(0, 2 * np.pi, CIRCLE_POINTS, endpoint=False)
    outline = np.stack([u + radius_px * np.cos(turn), v + radius_px * np.sin(turn)], axis=-1)
    return ball_from_outline(camera, outline, error_px=CIRCLE_ERROR_PX, radius_m=radius_m, z_m=z_m)


def ball_from_outline(camera: Camera, outline: np.ndarray, *, error_px: float, radius_m: float | None = None,
                      z_m: float | None = None) -> Ball:
    """The ball whose outline runs through image points, by linear least squares.

    Orthographic: a circle in the plane. Perspective: the unit rays r through the outline make a cone about the centre's
    direction c, r·c = cos α: r·g = 1 with g = c/cos α, and the ball of radius R lies at distance R/sin α.

    Args:
        outline: [points, 2] u, v.
        error_px: standard error of the outline's centre, kept in the result.
        radius_m: of the ball; gives a perspective camera its distance.
        z_m: camera-frame z of the ball's centre for an orthographic camera.

    Raises:
        CalibrationError: the points lie on no circle.
    """
    origin, direction = lines_of_sight(camera, outline[:, 0], outline[:, 1])
    span = np.linalg.norm(outline - outline.mean(axis=0), axis=1)
    radius_px = float(span.mean())
    try:
        if camera.projection == "orthographic":
            centre, radius = fit_circle(origin[:, :2])
            return Ball(np.array([*centre, z_m or 0.0]), radius, camera.pixel_size_m is not None,
                        radius / (camera.pixel_size_m or 1.0), error_px)
        axis, half_angle = fit_cone(direction)
    except np.linalg.LinAlgError as error:
        raise CalibrationError("the outline of the ball lies on a line") from error
    radius = 1.0 if radius_m is None else radius_m
    return Ball(axis * radius / math.sin(half_angle), radius, radius_m is not None, radius_px, error_px)


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the circle x² + y² = 2ax + 2by + c by linear least squares (Kåsa 1976).

    Args:
        points: [points, 2], three or more.

    Raises:
        numpy.linalg.LinAlgError: the points lie on a line.
    """
    middle = points.mean(axis=0)
    shifted = points - middle
    scale = np.abs(shifted).max() or 1.0
    unit = shifted / scale  # so that the equations do not depend on where the circle lies or in which unit
    a, b, c = _solve(np.column_stack([2 * unit, np.ones(len(unit))]), (unit**2).sum(axis=1))
    return middle + scale * np.array([a, b]), scale * math.sqrt(max(c + a * a + b * b, 0.0))


def fit_cone(rays: np.ndarray) -> tuple[np.ndarray, float]:
    """Axis and half angle of the cone through unit rays, r·g = 1 by linear least squares.

    Args:
        rays: [rays, 3] unit, three or more.

    Returns:
        axis [3] unit, half angle in radians.

    Raises:
        numpy.linalg.LinAlgError: the rays lie in one plane.
    """
    middle = rays.mean(axis=0)
    middle = middle / np.linalg.norm(middle)
    basis = np.linalg.svd(np.eye(3) - np.outer(middle, middle))[0]  # two directions across the mean ray, then the ray itself
    basis[:, 2] = middle
    across, along = rays @ basis[:, :2], rays @ basis[:, 2]
    width = np.abs(across).max() or 1.0  # so that a narrow cone is as well posed as a wide one
    # with c along (p, q, 1) in this basis, r·c = cos α reads along = k - across·(p, q)
    p, q, _ = _solve(np.column_stack([-across / width, np.ones(len(rays))]), along)
    axis = basis @ np.array([p / width, q / width, 1.0])
    axis /= np.linalg.norm(axis)
    # atan2 keeps the digits that the cosine of a narrow cone has lost
    return axis, float(np.arctan2(np.linalg.norm(np.cross(rays, axis), axis=1), rays @ axis).mean())


def view_ball(ball: Ball, camera: Camera) -> BallView:
    """Normals, lines of sight and surface points of a ball's pixels.

    Raises:
        CalibrationError: no pixel of the image shows the ball.
    """
    rows, cols = _box(ball, camera)
    u, v = np.meshgrid(np.arange(cols.start, cols.stop) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    inside, point, direction = meet(ball, camera, u, v)
    if not inside.any():
        raise CalibrationError(f"the ball has no pixel in the {camera.width}x{camera.height} image")
    normal = np.where(inside[..., None], (point - ball.centre) / ball.radius, 0)
    return BallView((rows, cols), inside, normal, -direction, point)


def meet(ball: Ball, camera: Camera, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where lines of sight meet a ball first.

    Returns:
        inside [...] bool, point [..., 3] on the ball (0 where it is missed), direction [..., 3] of the line, unit.
    """
    origin, direction = lines_of_sight(camera, u, v)
    to_centre = ball.centre - origin
    along = (to_centre * direction).sum(axis=-1)
    across = np.linalg.norm(to_centre - along[..., None] * direction, axis=-1)
    inside = across < ball.radius
    near = along - np.sqrt(np.where(inside, ball.radius**2 - across**2, 0))
    return inside, np.where(inside[..., None], origin + near[..., None] * direction, 0), direction


def project(camera: Camera, point: np.ndarray) -> tuple[float, float]:
    """Image coordinates of a camera-frame point, in the camera's unit."""
    cu, cv = camera.principal_px or (camera.width / 2, camera.height / 2)
    if camera.projection == "orthographic":
        pixel = camera.pixel_size_m or 1.0
        return float(cu + point[0] / pixel), float(cv - point[1] / pixel)
    assert camera.focal_px is not None  # the camera's validator saw to it
    x, down = point[0] / -point[2], point[1] / point[2]
    if camera.distortion is not None:
        x, down = camera.distortion.apply(x, down)
    return float(cu + camera.focal_px[0] * x), float(cv + camera.focal_px[1] * down)


def _box(ball: Ball, camera: Camera) -> tuple[slice, slice]:
    """Rows and columns around the outline, inside the image."""
    u, v = project(camera, ball.centre)
    # the outline of a ball off the axis is an ellipse, stretched by no more than 1/cos² of its angle from the axis
    reach = ball.radius_px * 1.1 + 2
    if camera.projection == "perspective":
        reach *= float(ball.centre @ ball.centre) / float(ball.centre[2] ** 2)
    rows = slice(max(0, math.floor(v - reach)), min(camera.height, math.ceil(v + reach)))
    cols = slice(max(0, math.floor(u - reach)), min(camera.width, math.ceil(u + reach)))
    return rows, cols


def _solve(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    solution, _, rank, _ = np.linalg.lstsq(matrix, values, rcond=1e-9)
    if rank < matrix.shape[1]:
        raise np.linalg.LinAlgError("the points do not determine a circle")
    return solution
