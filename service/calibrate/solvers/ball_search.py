"""Round outlines in the images of a capture, among which a chrome or grey ball is looked for.

Circles are proposed by the Hough transform on the mean and on the brightest of all frames, in both of which the ball stands still.
Then the strongest step of brightness along each of its radii is found to a fraction of a pixel, and the outline of a ball is fitted to
these points by RANSAC, so that objects that hide part of the ball do not bend it.

Sources: Yuen, Princen, Illingworth and Kittler, "Comparative study of Hough transform methods for circle finding", Image and Vision
Computing 8(1), 1990; Fischler and Bolles, "Random sample consensus", Communications of the ACM 24(6), 1981.
"""

import math
from typing import NamedTuple

import cv2
import numpy as np

from service.light_estimation.ball import Ball, ball_from_outline, project, refine_outline
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
STEP_PX = 0.25
"""The distance of samples along a radius."""
ERROR_PX = 0.5
"""The least standard error of the centre that is assumed: the rim of a real mirror shows what stands around it, and its outline lay 1.2 px
from that of a mask drawn by hand."""
LEAST_SHARE = 0.45
"""The least part of the radii whose step of brightness lies on the outline: half of a ball may be hidden."""
TRIPLES, NEAR_PX = 200, 1.5
"""Circles of RANSAC, of which 1e-11 miss where half the points lie on one, and the largest distance of a point near a circle: a pixel, and
what the ellipse of a perspective camera differs from one."""
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

    def place(self, camera: Camera, radius_m: float | None, z_m: float | None) -> Ball:
        """Return the ball with what is known of its size and place."""
        return ball_from_outline(camera, self.points, error_px=self.error_px, radius_m=radius_m, z_m=z_m)


def find_outlines(camera: Camera, pictures: list[np.ndarray]) -> list[RoundOutline]:
    """Find round outlines, the most complete and largest first.
    `pictures`: [rows, cols] each, 0 to 1, in which outlines stand still: the mean and the brightest of all frames."""
    found: list[RoundOutline] = []
    for picture in pictures:
        for u, v, radius in _proposals(picture):
            if any(_near(camera, other.ball, u, v, radius) for other in found):
                continue
            outline = _examine(camera, pictures, u, v, radius)
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
    return _examine(camera, pictures, *project(camera, ball.centre), ball.radius_px)


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


def _examine(camera: Camera, pictures: list[np.ndarray], u: float, v: float, radius: float) -> RoundOutline | None:
    """Return the outline of a ball near a circle, or None where too few steps of brightness lie on one."""
    turn = np.linspace(0, 2 * math.pi, RAYS, endpoint=False)[:, None]
    along = np.arange(radius * (1 - REACH) - 2, radius * (1 + REACH) + 2, STEP_PX)
    at_u, at_v = u + along * np.cos(turn), v + along * np.sin(turn)
    best: RoundOutline | None = None
    for picture in pictures:
        rows, cols = picture.shape
        blurred = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), 1.0)
        values = cv2.remap(blurred, (at_u - 0.5).astype(np.float32), (at_v - 0.5).astype(np.float32), cv2.INTER_LINEAR,
                           borderMode=cv2.BORDER_REPLICATE)
        slope = np.abs(np.gradient(values.astype(np.float64), axis=1))
        slope[(at_u < 1) | (at_u > cols - 1) | (at_v < 1) | (at_v > rows - 1)] = 0
        top = slope[:, 1:-1].argmax(axis=1) + 1
        ray = np.arange(RAYS)
        left, peak, right = slope[ray, top - 1], slope[ray, top], slope[ray, top + 1]
        bend = left - 2 * peak + right
        shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0).clip(-1, 1)
        clear = peak > max(1e-4, 0.1 * float(np.median(peak)))
        distance = along[top] + shift * STEP_PX
        points = np.stack([u + distance * np.cos(turn[:, 0]), v + distance * np.sin(turn[:, 0])], axis=1)[clear]
        if len(points) < LEAST_SHARE * RAYS:
            continue
        inside = _on_a_circle(points)
        if inside.sum() < LEAST_SHARE * RAYS:
            continue
        try:
            ball, inside, error_px = refine_outline(camera, points, inside)
        except CalibrationError:
            continue
        share = float(inside.sum()) / RAYS
        if share >= LEAST_SHARE and (best is None or share > best.share):
            best = RoundOutline(points[inside], ball, share, max(error_px, ERROR_PX))
    return best


def _on_a_circle(points: np.ndarray) -> np.ndarray:
    """Return which points lie near the circle through three of them that has most points near it."""
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
    return np.asarray(near[near.sum(axis=1).argmax()])


def _near(camera: Camera, ball: Ball, u: float, v: float, radius: float) -> bool:
    ball_u, ball_v = project(camera, ball.centre)
    size = SAME * max(ball.radius_px, radius)
    return math.hypot(u - ball_u, v - ball_v) < size and abs(ball.radius_px - radius) < size
