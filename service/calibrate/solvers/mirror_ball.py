"""The direction of a light from a mirror ball, and the position of a near light from two mirror balls or more.

The line of sight of the bright spot is reflected at the ball: the normal at the spot bisects the directions to the viewer and to the
light, it is not the direction of the light. A near light lies at the point nearest to the reflected lines of sight of all balls.

Source: the law of reflection, r = 2(n·v)n - v; Debevec, "Rendering synthetic objects into real scenes", SIGGRAPH 1998, for
    the mirror ball as a light probe; Powell, Sarkar and Goldgof, "A simple strategy for calibrating the geometry of light sources", TPAMI
    23(9), 2001, for the position.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import label

from service.light_estimation.ball import Ball, BallView
from service.light_estimation.lambertian import degrees_between
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

RIM_COSINE = 0.1
"""The least cosine between normal and line of sight of a pixel that is searched: pixels at the outline mix in background."""
MIN_COSINE = 0.2
"""The least such cosine of a spot, for a light 157° from the view axis: beyond it an error of 1 px is one of 10/radius_px rad."""
NEAR_RIM_COSINE = 0.35
"""The cosine below which a spot is flagged, for a light more than 139° from the view axis."""
MAX_SPOT_SHARE = 0.1
"""The largest part of the ball that a spot may cover, which a light of 37° half angle covers, or an overexposed ball."""
PROMINENCE = 8.0
"""The standard deviations of the other pixels of the ball by which the peak must exceed their median; noise reaches 4 or 5."""
MIN_CONTRAST = 2.0
"""The least ratio of the peak to that median."""
RIVAL_SHARE = 0.5
"""The light of another spot, relative to the light of the found spot, above which the spot is flagged."""
RIVAL_PEAK = 0.5
"""The peak of that other spot, relative to the peak, above which it may as well be the lamp."""
STILL_SHARE = 0.5
"""The part of the light of a spot which all frames show there, above which the spot is none of the lamp of the frame."""
BRIGHTER = 1.5
"""The least ratio of such a peak to all that stands still, where nothing else tells a spot: edges that move, as of a disc, are no brighter
than it."""
LEAST_MOVING = 0.05
"""The least peak of a spot beside one that stands still, relative to the peak of that: less is noise at its border."""
SMALL_SPOT = 4
"""The count of pixels below which a spot is flagged, because its centroid is inaccurate."""
LEAST_FRAMES = 3
"""The fewest frames of which something can be said to stand still."""
MIN_CONVERGENCE_DEGREES = 1.0
"""The least angle between two rays: below it an error of one pixel moves the light by as much as its distance."""
MISS_DEGREES = 1.0
"""The angle between a ray and the direction to the nearest point, seen from the ball, above which the light is flagged."""
MISSES = "rays miss"
"""The flag of a light whose rays do not meet."""


class Spot(NamedTuple):
    """The reflection of one light in a mirror ball."""

    uv: np.ndarray  # [2] float64, centroid, continuous image coordinates
    direction: np.ndarray  # [3] float64, unit, the reflected line of sight: from the ball to the light, camera frame
    point: np.ndarray  # [3] float64, on the ball at the centroid, in the ball's unit
    spot_degrees: float
    """The root mean square angle of the light of the spot from its mean: the apparent size of the light."""
    uncertainty_degrees: float
    """The standard error of the direction, from the pixel grid and the outline of the ball."""
    pixels: int
    flags: tuple[str, ...]


def find_spot(radiance: np.ndarray, saturated: np.ndarray | None, ball: Ball, view: BallView, *, level: float = 0.1,
              still: np.ndarray | None = None) -> Spot:
    """Find the bright spot on a mirror ball, and the direction of the light that it reflects.

    Each pixel of the spot measures the light from its own reflected direction. The result is the mean of these directions, weighted
    by the radiance above the level of the spot. In an orthographic image of a mirror ball equal areas are equal solid angles, so
    that the mean is the centroid of the light. Saturated pixels count as the brightest. `radiance`: [h, w, 3] scene-linear, the box of
    `view`. `saturated`: [h, w] bool, or None. `level`: relative to the peak: pixels of the spot are brighter than it and than the noise of
    the ball, and connected to the peak. It is low, because the faint border of a spot of few pixels determines its sub-pixel position best.
    `still`: [h, w] what all frames show there, as `still_light` returns it; a spot of it is none of the lamp. Where another spot is as
    bright, the direction is as unsure as both differ.
    Raises CalibrationError if there is no spot, it covers too much of the ball, or it is at the rim; the caller names the frame."""
    facing = (view.normal * view.to_viewer).sum(axis=-1)
    looked_at = view.inside & (facing > RIM_COSINE)
    value = np.where(looked_at, radiance.astype(np.float64).mean(axis=-1), 0)
    clipped = looked_at & saturated if saturated is not None else np.zeros_like(looked_at)
    if clipped.any():
        value[clipped] = value.max()
    rests = False
    try:
        regions = _regions(value, looked_at, level)
    except CalibrationError:  # half of a ball on a table may mirror the table: what stands still is as bright as the lamp
        moving = value if still is None else np.maximum(value - still, 0)
        other = None if still is None else _regions_of_another(moving, looked_at, level, least=LEAST_MOVING * float(value.max()))
        if other is None or still is None or value[other.spot].max() < BRIGHTER * still[looked_at].max():
            raise
        value, regions = moving, other
    else:
        rests = still is not None and float(np.minimum(still, value)[regions.spot].sum()) > STILL_SHARE * float(value[regions.spot].sum())
    most = max(MAX_SPOT_SHARE * int(view.inside.sum()), SMALL_SPOT)
    if still is not None and rests:
        moving, clipped = np.maximum(value - still, 0), clipped & np.isfinite(still)
        other = _regions_of_another(moving, looked_at, level, least=LEAST_MOVING * float(value.max()))
        if other is not None:
            value, regions = moving, other
        elif int(regions.spot.sum()) <= most:
            raise CalibrationError("the bright spot stands still in all frames, and there is no other: it is a light of the room, or "
                                   "the same lamp shone in every frame")
    count = int(regions.spot.sum())
    if count > most:
        raise CalibrationError(f"the bright spot covers {count / int(view.inside.sum()):.0%} of the ball: shorten the exposure or make the "
                               "light smaller")
    rows, cols = np.nonzero(regions.spot)
    weight = regions.rise[regions.spot] / regions.rise[regions.spot].sum()
    uv = np.array([weight @ cols + view.box[1].start + 0.5, weight @ rows + view.box[0].start + 0.5])
    cosine = float(weight @ facing[regions.spot])
    if cosine < MIN_COSINE:
        degrees = math.degrees(math.acos(cosine))
        raise CalibrationError(f"the bright spot is at the rim of the ball, its normal {degrees:.0f}° off the line of sight: "
                               "the light is behind the object, or the ball's outline is too large")
    direction, size = _seen_at(view, regions.spot, weight)
    point = weight @ view.point[regions.spot]
    outward = point - ball.centre
    # a pixel is uniform over its width; its shift rotates the normal by 1/(radius_px · cosine) radians, and the direction by twice that
    shift_px = math.sqrt(1 / (12 * count) + ball.outline_error_px**2)
    sure_to = math.degrees(2 * shift_px / (ball.radius_px * cosine))
    several = regions.share > RIVAL_SHARE
    if several and value[regions.rival].max() > RIVAL_PEAK * value.max():
        light = regions.rise[regions.rival]
        rival, _ = _seen_at(view, regions.rival, light / light.sum())
        sure_to = math.hypot(sure_to, float(degrees_between(direction, rival)) * math.sqrt(0.5))
    flags = [("near the rim", cosine < NEAR_RIM_COSINE), ("several spots", several), ("another spot stands still", rests),
             ("saturated", clipped[regions.spot].sum() > count / 2), ("small spot", count < SMALL_SPOT)]
    return Spot(uv, direction, ball.centre + outward * ball.radius / np.linalg.norm(outward), size, sure_to, count,
                tuple(name for name, raised in flags if raised))


def _seen_at(view: BallView, spot: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the mean direction, [3], in which the pixels of a spot see, and their root mean square angle from it in degrees."""
    reflected = reflect(view.to_viewer[spot], view.normal[spot])
    mean = weight @ reflected
    direction = mean / np.linalg.norm(mean)
    off = np.arctan2(np.linalg.norm(np.cross(reflected, direction), axis=-1), reflected @ direction)
    return direction, math.degrees(math.sqrt(float(weight @ off**2)))


def still_light(radiances: Sequence[np.ndarray], saturated: Sequence[np.ndarray | None]) -> np.ndarray | None:
    """Return what all frames show on a ball, [h, w], infinite where all are saturated; None for two frames or fewer.
    `radiances`: [h, w, 3] each. `saturated`: [h, w] bool each, or None."""
    if len(radiances) < LEAST_FRAMES:
        return None
    least = np.min([radiance.mean(axis=-1, dtype=np.float64) for radiance in radiances], axis=0)
    masks = [mask for mask in saturated if mask is not None]
    return np.where(np.all(masks, axis=0), np.inf, least) if len(masks) == len(radiances) else least


def reflect(to_viewer: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Return the mirror direction 2(n·v)n - v, [..., 3]: from the ball to the object that the mirror shows at the viewer."""
    return 2 * (normal * to_viewer).sum(axis=-1, keepdims=True) * normal - to_viewer


def _noise_ceiling(values: np.ndarray) -> float:
    """Return a level above the noise of the ball, and raise CalibrationError when no pixel is brighter."""
    peak, median = float(values.max()), float(np.median(values))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - median)))  # the standard deviation, were it noise alone
    if peak <= 0 or peak <= median + PROMINENCE * spread or peak < MIN_CONTRAST * median:
        raise CalibrationError("there is no bright spot on the ball")
    return median + PROMINENCE * spread


class _Regions(NamedTuple):
    """What is bright on a ball."""

    rise: np.ndarray  # [h, w] above the level of the spot
    spot: np.ndarray  # [h, w] bool, the brightest connected region with a peak
    rival: np.ndarray  # [h, w] bool, the next region
    share: float
    """The light of the next region relative to that of the spot."""


def _regions(value: np.ndarray, looked_at: np.ndarray, level: float) -> _Regions:
    """Return the two brightest connected regions above `level` × the peak and the noise of the ball."""
    peak = float(value.max())
    rise = np.where(looked_at, np.maximum(value - max(level * peak, _noise_ceiling(value[looked_at])), 0), 0)
    parts, count = label(rise > 0, np.ones((3, 3)))
    light = np.bincount(parts.ravel(), rise.ravel(), minlength=count + 1)
    best = int(max(np.unique(parts[value == peak]), key=lambda part: light[part]))
    others = light.copy()
    others[best] = 0
    return _Regions(rise, parts == best, (parts == others.argmax()) & (rise > 0), float(others.max()) / float(light[best]))


def _regions_of_another(moving: np.ndarray, looked_at: np.ndarray, level: float, least: float) -> _Regions | None:
    """Return what is bright on a ball beside what stands still, None where no peak of at least `least` is."""
    try:
        return _regions(moving, looked_at, level) if moving.max() >= least else None
    except CalibrationError:
        return None


class Position(NamedTuple):
    """The measured position of a near light."""

    position: np.ndarray  # [3] float64, in the unit of the balls
    residual: float
    """The root mean square distance from the rays, in the unit of the balls."""
    uncertainty: float
    """The standard error of the position in the unit of the balls, propagated from the uncertainty of the rays."""
    excess: float
    """The squares by which the rays miss each other, relative to what their uncertainty explains: 1 but for chance."""
    flags: tuple[str, ...]


def nearest_point(
    points: np.ndarray,  # [balls, 3] the point at which each ray leaves its ball
    directions: np.ndarray,  # [balls, 3] unit directions of the rays
    uncertainty_degrees: np.ndarray,  # [balls] the standard error of each direction
) -> Position:
    """Return the point with the least sum of squared distances from rays: Σ (I - d dᵀ)(x - p) = 0.
    Raises CalibrationError if the rays are nearly parallel, or meet behind a ball."""
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
    excess = float(((miss / spread) ** 2).sum()) / (2 * len(points) - 3)
    flags = (MISSES,) if np.degrees(np.arctan2(miss, distance)).max() > MISS_DEGREES else ()
    return Position(position, float(np.sqrt((miss**2).mean())), math.sqrt(float(np.trace(covariance))), excess, flags)
