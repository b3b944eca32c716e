"""A ball in an image: its position in the camera frame, and the normal and the line of sight at each of its pixels.

The direction of a distant light needs no scale: a perspective camera determines a ball up to scale, and an orthographic camera does
not determine its distance.

The sub-pixel outline of a ball follows from its mask, without a stand that the mask may contain.

Source: Fischler and Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981, for the outline.
"""

import math
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.errors import CalibrationError

CIRCLE_POINTS = 360
"""The count of outline points that are taken from a circle which the user gives."""
CIRCLE_ERROR_PX = 0.5
"""The standard error of the centre of a circle which the user gives, in pixels."""
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


class Ball(NamedTuple):
    """A sphere in the camera frame."""

    centre: np.ndarray  # [3] float64; for an orthographic camera z is an assumption
    radius: float
    metric: bool
    """True when centre and radius are in metres; otherwise they are in pixels (orthographic) or in radii of the ball (perspective)."""
    radius_px: float
    """The mean radius of the outline in pixels."""
    outline_error_px: float
    """The standard error of the centre of the outline in pixels."""
    oval_px: float = 0.0
    """How much farther from the centre than the mean the ends of its outline are, where this is an ellipse and that of no ball."""
    off_axis_degrees: float = 0.0
    """How far off its axis a perspective camera saw the ball, whose outline says so while the camera is declared orthographic."""

    @property
    def bent_px(self) -> float:
        """The error of the centre that stands for what an ellipse, or a view from aside, does to directions."""
        return max(self.oval_px, math.radians(self.off_axis_degrees) / 2 * self.radius_px)


class BallView(NamedTuple):
    """The normals, lines of sight and points of a ball at the pixels of a box of the image."""

    box: tuple[slice, slice]
    """The rows and columns of the image that the box covers."""
    inside: np.ndarray  # [h, w] bool, True where the line of sight of the pixel centre meets the ball
    normal: np.ndarray  # [h, w, 3] float64, unit, camera frame; 0 outside
    to_viewer: np.ndarray  # [h, w, 3] float64, unit, from the ball to the camera
    point: np.ndarray  # [h, w, 3] float64, on the ball, in the unit of the ball; 0 outside


def ball_from_circle(camera: Camera, u: float, v: float, radius_px: float, *, radius_m: float | None = None,
                     z_m: float | None = None) -> Ball:
    """Return the ball whose outline is a given circle, which lies wholly inside the image.

    In a perspective image the outline of a ball off the axis is an ellipse, which the circle approximates.
    """
    if not (radius_px > 1 and radius_px <= u <= camera.width - radius_px and radius_px <= v <= camera.height - radius_px):
        raise CalibrationError(f"ball {u:g},{v:g},{radius_px:g}: is not wholly inside the {camera.width}x{camera.height} image")
    turn = np.linspace(0, 2 * np.pi, CIRCLE_POINTS, endpoint=False)
    outline = np.stack([u + radius_px * np.cos(turn), v + radius_px * np.sin(turn)], axis=-1)
    return ball_from_outline(camera, outline, error_px=CIRCLE_ERROR_PX, radius_m=radius_m, z_m=z_m)


def ball_from_outline(
    camera: Camera,
    outline: np.ndarray,  # [points, 2] u, v
    *,
    error_px: float,  # the standard error of the centre of the outline, which the result holds
    radius_m: float | None = None,  # the radius of the ball, which determines its distance from a perspective camera
    z_m: float | None = None,  # the camera-frame z of the centre of the ball, for an orthographic camera
) -> Ball:
    """Fit a ball to points of its outline by linear least squares.

    For an orthographic camera the outline is a circle in the image plane. For a perspective camera the unit rays r through the
    outline form a cone about the direction c of the centre, r·c = cos α, and a ball of radius R lies at distance R/sin α.
    Raises CalibrationError if the points lie on no circle."""
    origin, direction = camera.lines_of_sight(outline[:, 0], outline[:, 1])
    try:
        if camera.projection == "orthographic":
            centre, radius = fit_circle(origin[:, :2])
            return Ball(np.array([*centre, z_m or 0.0]), radius, camera.pixel_size_m is not None,
                        radius / (camera.pixel_size_m or 1.0), error_px)
        axis, half_angle = fit_cone(direction)
        _, radius_px = fit_circle(outline)  # of a part of it too
    except np.linalg.LinAlgError as error:
        raise CalibrationError("the outline of the ball lies on a line") from error
    radius = 1.0 if radius_m is None else radius_m
    return Ball(axis * radius / math.sin(half_angle), radius, radius_m is not None, radius_px, error_px)


def fit_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a circle x² + y² = 2ax + 2by + c to three points or more by linear least squares (Kåsa 1976), and return centre and radius.
    Raises numpy.linalg.LinAlgError if the points lie on a line."""
    middle = points.mean(axis=0)
    shifted = points - middle
    scale = np.abs(shifted).max() or 1.0
    unit = shifted / scale  # so that the equations do not depend on where the circle lies or in which unit
    a, b, c = _solve(np.column_stack([2 * unit, np.ones(len(unit))]), (unit**2).sum(axis=1))
    return middle + scale * np.array([a, b]), scale * math.sqrt(max(c + a * a + b * b, 0.0))


def fit_cone(rays: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit a cone to three unit rays or more by linear least squares of r·g = 1, with g the axis over the cosine of the half angle.
    Returns axis [3], a unit vector, and the half angle in radians. Raises numpy.linalg.LinAlgError if the rays lie in one plane."""
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
    """Return the normals, lines of sight and surface points of the pixels of a ball, of which the image must show one."""
    rows, cols = _box(ball, camera)
    u, v = np.meshgrid(np.arange(cols.start, cols.stop) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    inside, point, direction = intersect(ball, camera, u, v)
    if not inside.any():
        raise CalibrationError(f"the ball has no pixel in the {camera.width}x{camera.height} image")
    normal = np.where(inside[..., None], (point - ball.centre) / ball.radius, 0)
    return BallView((rows, cols), inside, normal, -direction, point)


def intersect(ball: Ball, camera: Camera, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Intersect the lines of sight of image points with a ball.
    Returns inside [...] bool, True where the line meets the ball; point [..., 3], the intersection nearer to the camera, 0 where there is
    none; direction [..., 3], the unit direction of the line."""
    origin, direction = camera.lines_of_sight(u, v)
    to_centre = ball.centre - origin
    along = (to_centre * direction).sum(axis=-1)
    across = np.linalg.norm(to_centre - along[..., None] * direction, axis=-1)
    inside = across < ball.radius
    first = along - np.sqrt(np.where(inside, ball.radius**2 - across**2, 0))
    return inside, np.where(inside[..., None], origin + first[..., None] * direction, 0), direction


def project(camera: Camera, point: np.ndarray) -> tuple[float, float]:
    """Return the image coordinates u and v of a camera-frame point, which is in the unit of the camera."""
    u, v = camera.image_coordinates(point)
    return float(u), float(v)


def _box(ball: Ball, camera: Camera) -> tuple[slice, slice]:
    """Return the rows and columns of the image that contain the outline of a ball."""
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


def ball_from_mask(camera: Camera, coverage: np.ndarray, *, radius_m: float | None = None, z_m: float | None = None) -> Ball:
    """Fit a ball to the outline of a mask by RANSAC.

    Three random outline points propose a circle (a cone for a perspective camera). The circle with most points within a pixel is
    fitted to these points, so that a stand or a hole does not influence it. `coverage`: [rows, cols], from 0 outside to 1 inside, binary or
    anti-aliased. Raises CalibrationError if the mask is empty, or its outline is no circle."""
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
        inliers = np.abs(distance_px(ball, camera, outline)) < INLIER_PX
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
    `outline`: [points, 2] u, v. `inside`: [points] bool, those that a proposal takes for points of the outline. Returns the ball without a
    scale, which points lie within a pixel of its outline, and the standard error of its centre in pixels."""
    for _ in range(3):  # the points near the fitted circle are a few more than those near the proposal
        ball = ball_from_outline(camera, outline[inside], error_px=0.0)
        distance = distance_px(ball, camera, outline)
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


def distance_px(ball: Ball, camera: Camera, outline: np.ndarray) -> np.ndarray:
    """Return the distance of image points from the outline of a ball in pixels, positive outside."""
    origin, direction = camera.lines_of_sight(outline[:, 0], outline[:, 1])
    if camera.projection == "orthographic":
        distance = np.linalg.norm(origin[:, :2] - ball.centre[:2], axis=1) - ball.radius
        return distance / (camera.pixel_size_m or 1.0)
    to_centre = np.linalg.norm(ball.centre)
    axis = ball.centre / to_centre
    angle = np.arctan2(np.linalg.norm(np.cross(direction, axis), axis=1), direction @ axis)
    assert camera.focal_px is not None  # the camera's validator saw to it
    return (angle - np.arcsin(ball.radius / to_centre)) * sum(camera.focal_px) / 2
