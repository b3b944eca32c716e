"""Round outlines in the images of a capture, among which a chrome or grey ball is looked for.

Circles are proposed by the Hough transform on the mean and on the brightest of all frames, in both of which the ball stands still.
Then the sharpest steps of brightness along each of its radii are found to a fraction of a pixel, and the outline of a ball is fitted to
these points by RANSAC, so that objects that hide part of the ball, and what it shows near its rim, do not bend it.

Sources: Yuen, Princen, Illingworth and Kittler, "Comparative study of Hough transform methods for circle finding", Image and Vision
Computing 8(1), 1990; Fischler and Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d

from service.light_estimation.ball import Ball, ball_from_outline, distance_px, fit_circle, project, refine_outline
from stage.capture.camera import Camera
from stage.errors import CalibrationError

SEARCH_SIZE = 640
"""The longer side of the image on which circles are proposed."""
SMALLEST_PX = 8.0
"""The least radius of a circle on that image."""
LARGEST_PART = 0.6
"""The largest radius of a circle over the shorter side of the image."""
EDGE_STRENGTH, ROUNDNESS = 120.0, 0.45
"""The threshold of the edges, and the least perfectness of a circle, of OpenCV's HOUGH_GRADIENT_ALT: low, because what is proposed is
examined further."""
PROPOSALS = 24
"""The most circles that are examined for each image."""
RAYS = 360
"""The radii along which the outline is looked for."""
REACH = 0.12
"""The outline lies within this part of the radius of the proposed circle."""
SMOOTH_PART, SMOOTH_RAYS = 0.1, 2.0
"""The standard deviations of means: over this part of the radius across the outline, which is taken off before steps are looked for, and
over so many radii along it."""
STEP_PX = 0.25
"""The distance of samples along a radius."""
ERROR_PX = 1.0
"""The least standard error of the centre that is assumed where the whole outline is seen: the rim of a real mirror shows what stands around
it, and its outline lay 1.2 px from that of a mask drawn by hand."""
LEAST_SHARE = 0.45
"""The least part of the radii whose step of brightness lies on the outline: half of a ball may be hidden."""
STEPS, CLEAR = 3, 4.0
"""The most steps of brightness along a radius that may be the outline, and how much steeper they are than the median."""
TRIPLES, NEAR_PX = 1000, 1.5
"""Circles of RANSAC, of which one in a million misses where a quarter of the points lies on one, and the largest distance of a point near a
circle: a pixel, and what the ellipse of a perspective camera differs from one."""
LEAST_OVAL, LEAST_OVAL_PX, MOST_OVAL, MORE = 0.02, 1.0, 0.15, 0.1
"""The least part of the radius, and pixels, by which the ends of an ellipse are farther out, from which on it is none of a ball; the most
that is looked for; and the part of the radii by which it must have more than the circle has."""
RADIAL, RADIAL_PX, RADIAL_DEGREES, RADIAL_SHARE, SHORTEST = 0.01, 0.5, 15.0, 0.6, 0.6
"""The same two limits of an ellipse whose longer axis points to the image centre within this angle, as a perspective camera sees a ball,
with this part of the radii on it, and the least focal length over the width of the image: what stands around a mirror draws its outline out
by .35 px at most, mostly upright."""
LEAST_DETERMINANT = 1e-3
"""Five steps of brightness with a smaller determinant of their waves tell no ellipse."""
SAME = 0.08
"""Circles whose centres and radii differ by less than this part of the radius are one."""


class RoundOutline(NamedTuple):
    """An outline that a ball may have."""

    points: np.ndarray  # [points, 2] u, v on the outline
    ball: Ball
    share: float
    """The part of the radii with a point on the outline."""
    error_px: float
    """The standard error of the centre."""

    @property
    def middle(self) -> np.ndarray:
        """The centre, [2] u, v, of the circle through the points."""
        return fit_circle(self.points)[0]

    def place(self, camera: Camera, radius_m: float | None, z_m: float | None) -> Ball:
        """Return the ball with what is known of its size and place."""
        placed = ball_from_outline(camera, self.points, error_px=self.error_px, radius_m=radius_m, z_m=z_m)
        return placed._replace(oval_px=self.ball.oval_px, off_axis_degrees=self.ball.off_axis_degrees)


def find_outlines(camera: Camera, pictures: list[np.ndarray]) -> list[RoundOutline]:
    """Find round outlines, the most complete and largest first.
    `pictures`: [rows, cols] each, 0 to 1, in which outlines stand still: the mean and the brightest of all frames."""
    found: list[RoundOutline] = []
    blurred = _blurred(pictures)
    for picture in pictures:
        for u, v, radius in _proposals(picture):
            if any(_near(camera, other.ball, u, v, radius) for other in found):
                continue
            outline = _examine(camera, blurred, u, v, radius)
            if outline is not None:
                found.append(outline)
    found.sort(key=lambda one: one.share * one.ball.radius_px, reverse=True)
    distinct: list[RoundOutline] = []
    for one in found:
        if not any(_near(camera, other.ball, *project(camera, one.ball.centre), one.ball.radius_px) for other in distinct):
            distinct.append(one)
    return distinct


def outline_near(camera: Camera, pictures: list[np.ndarray], ball: Ball) -> RoundOutline | None:
    """Return the outline that images show near a ball that was named, None where they show none."""
    return _examine(camera, _blurred(pictures), *project(camera, ball.centre), ball.radius_px)


def _blurred(pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Return pictures, [rows, cols] float32 each, blurred by a pixel, so that noise has few steps."""
    return [np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0)) for picture in pictures]


def _proposals(picture: np.ndarray) -> list[tuple[float, float, float]]:
    """Return centres and radii of circles, in pixels of the picture."""
    scale = min(1.0, SEARCH_SIZE / max(picture.shape))
    small = cv2.resize(picture.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    grey = np.clip(cv2.GaussianBlur(small, (0, 0), 1.0) * 255, 0, 255).astype(np.uint8)
    circles = cv2.HoughCircles(grey, cv2.HOUGH_GRADIENT_ALT, 1.5, SMALLEST_PX / 2, param1=EDGE_STRENGTH, param2=ROUNDNESS,
                               minRadius=int(SMALLEST_PX), maxRadius=int(LARGEST_PART * min(small.shape)))
    if circles is None:
        return []
    best = circles.reshape(-1, circles.shape[-1])[:PROPOSALS, :3]
    return [((u + 0.5) / scale, (v + 0.5) / scale, radius / scale) for u, v, radius in best]


def _examine(camera: Camera, blurred: list[np.ndarray], u: float, v: float, radius: float) -> RoundOutline | None:
    """Return the outline of a ball near a circle, or None where too few steps of brightness lie on one.
    `blurred`: the pictures, by a pixel."""
    first = _outline_about(camera, blurred, u, v, radius)
    if first is None:
        return None
    # radii of the outline itself cross it at a right angle, so that means along it are sharp
    (u, v), radius = fit_circle(first.points)
    return _outline_about(camera, blurred, u, v, radius) or first


def _outline_about(camera: Camera, blurred: list[np.ndarray], u: float, v: float, radius: float) -> RoundOutline | None:
    """Return the outline with most of the radii of a circle."""
    turn = np.linspace(0, 2 * math.pi, RAYS, endpoint=False)[:, None]
    along = np.arange(radius * (1 - REACH) - 2, radius * (1 + REACH) + 2, STEP_PX)
    at_u, at_v = u + along * np.cos(turn), v + along * np.sin(turn)
    best: RoundOutline | None = None
    for picture in blurred:
        rows, cols = picture.shape
        values = cv2.remap(picture, (at_u - 0.5).astype(np.float32), (at_v - 0.5).astype(np.float32), cv2.INTER_LINEAR,
                           borderMode=cv2.BORDER_REPLICATE)
        along_it = gaussian_filter1d(values.astype(np.float64), SMOOTH_RAYS, axis=0, mode="wrap")
        # what changes over many pixels is what the ball shows, and no outline
        sharp = along_it - gaussian_filter1d(along_it, SMOOTH_PART * radius / STEP_PX, axis=1, mode="nearest")
        slope = np.abs(np.gradient(sharp, axis=1))
        slope[(at_u < 1) | (at_u > cols - 1) | (at_v < 1) | (at_v > rows - 1)] = 0
        ray, distance = _steps(slope, along)
        if len(np.unique(ray)) < LEAST_SHARE * RAYS:
            continue
        points = np.stack([u + distance * np.cos(turn[ray, 0]), v + distance * np.sin(turn[ray, 0])], axis=1)
        try:
            ball, inside, error_px = refine_outline(camera, points, _on_a_circle(points, ray))
            waves = np.stack([np.ones(len(ray)), *(wave(times * turn[ray, 0]) for times in (1, 2) for wave in (np.cos, np.sin))], axis=1)
            oval, near = _ellipse(distance_px(ball, camera, points), waves, ray, ball.radius_px)
            radial = _off_axis(camera, ball, oval, len(np.unique(ray[near])) / RAYS)
            more = len(np.unique(ray[near])) - len(np.unique(ray[inside])) >= MORE * RAYS
            oval_px = float(np.hypot(*oval)) if radial or more else 0.0
            if oval_px >= max(LEAST_OVAL_PX, LEAST_OVAL * ball.radius_px):
                ball, inside = ball_from_outline(camera, points[near], error_px=error_px), near
            elif not radial:
                oval_px = 0.0
        except CalibrationError:
            continue
        share = len(np.unique(ray[inside])) / RAYS
        if share >= LEAST_SHARE and (best is None or share > best.share):
            ball = ball._replace(oval_px=oval_px, off_axis_degrees=radial)
            best = RoundOutline(points[inside], ball, share, math.hypot(max(error_px, ERROR_PX / share), ball.bent_px))
    return best


def _ellipse(away: np.ndarray, waves: np.ndarray, ray: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the ellipse near a circle on which steps of brightness of most radii lie: the waves by which it is farther out, [2] cosine and
    sine of twice the angle, and which steps lie on it, [steps] bool.
    `away`: [steps] their distances from the circle. `waves`: [steps, 5] 1, and cosines and sines of their angle and of twice it."""
    chosen = np.random.default_rng(0).integers(0, len(away), (TRIPLES, 5))
    chosen = chosen[np.abs(np.linalg.det(waves[chosen])) > LEAST_DETERMINANT]
    fits = np.linalg.solve(waves[chosen], away[chosen][..., None])[..., 0]
    near = np.abs(away - fits @ waves.T) < NEAR_PX
    rays = np.logical_or.reduceat(near, np.flatnonzero(np.diff(ray, prepend=-1)), axis=1).sum(axis=1)
    best = near[(rays * (np.hypot(*fits[:, 3:].T) < MOST_OVAL * radius)).argmax()]
    fit = np.linalg.lstsq(waves[best], away[best])[0]
    return fit[3:], best


def _off_axis(camera: Camera, ball: Ball, oval: np.ndarray, share: float) -> float:
    """Return how many degrees off its axis a perspective camera saw a ball whose outline is longer towards the image centre, as one that is
    declared orthographic does not; else 0. `oval`: as `_ellipse` returns it. `share`: of the radii with a point on it."""
    size = float(np.hypot(*oval))
    way = np.subtract(project(camera, ball.centre), camera.principal_point)
    turned = abs(math.remainder(math.atan2(oval[1], oval[0]) / 2 - math.atan2(way[1], way[0]), math.pi))
    off_axis = math.acos((ball.radius_px - size) / (ball.radius_px + size))
    seen = (camera.projection == "orthographic" and share >= RADIAL_SHARE and turned <= math.radians(RADIAL_DEGREES)
            and size >= max(RADIAL_PX, RADIAL * ball.radius_px)
            and float(np.hypot(*way)) >= SHORTEST * camera.width * math.tan(off_axis))
    return math.degrees(off_axis) if seen else 0.0


def _steps(slope: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the clear steps of brightness along radii, at most STEPS each: the radius [steps], and the distance [steps] to a fraction of a
    sample. `slope`: [radii, samples]. `along`: [samples] their distances."""
    left, middle, right = slope[:, :-2], slope[:, 1:-1], slope[:, 2:]
    top = np.where((middle >= left) & (middle > right), middle, 0)
    clear = max(1e-4, CLEAR * float(np.median(middle)))
    order = np.argsort(top, axis=1)[:, -STEPS:]
    ray, rank = np.nonzero(np.take_along_axis(top, order, axis=1) > clear)
    sample = order[ray, rank]
    bend = left[ray, sample] - 2 * middle[ray, sample] + right[ray, sample]
    shift = np.where(bend < 0, 0.5 * (left[ray, sample] - right[ray, sample]) / np.where(bend < 0, bend, -1), 0).clip(-1, 1)
    return ray, along[sample + 1] + shift * (along[1] - along[0])


def _on_a_circle(points: np.ndarray, ray: np.ndarray) -> np.ndarray:
    """Return which points lie near the circle through three of them that has points of most rays near it."""
    chosen = np.random.default_rng(0).integers(0, len(points), (TRIPLES, 3))
    a, b, c = (points[chosen[:, corner]] for corner in range(3))
    first, second = b - a, c - a
    twice = 2 * (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0])
    usable = np.abs(twice) > 1e-6
    squares = (first**2).sum(axis=1), (second**2).sum(axis=1)
    divided = np.where(usable, twice, 1)
    offset = np.stack([second[:, 1] * squares[0] - first[:, 1] * squares[1], first[:, 0] * squares[1] - second[:, 0] * squares[0]],
                      axis=1) / divided[:, None]
    away = np.linalg.norm(points - (a + offset)[:, None], axis=2) - np.linalg.norm(offset, axis=1)[:, None]
    near = (np.abs(away) < NEAR_PX) & usable[:, None]
    starts = np.flatnonzero(np.diff(ray, prepend=-1))
    rays = np.logical_or.reduceat(near, starts, axis=1).sum(axis=1)
    return np.asarray(near[rays.argmax()])


def _near(camera: Camera, ball: Ball, u: float, v: float, radius: float) -> bool:
    ball_u, ball_v = project(camera, ball.centre)
    size = SAME * max(ball.radius_px, radius)
    return math.hypot(u - ball_u, v - ball_v) < size and abs(ball.radius_px - radius) < size
