"""The irradiance and the direction of a light from the shading of a grey, Lambertian ball.

The model is Lambert's law I = ρ/π E max(0, n·l) over lit and unsaturated pixels; robust weights exclude highlights.

Source: Lambert's law as in Woodham, "Photometric method for determining surface orientation from multiple images", Optical
    Engineering 19(1), 1980, eq. 8, here for known n and unknown l; weights: Holland and Welsch, "Robust regression using
    iteratively reweighted least-squares", Communications in Statistics A6(9), 1977.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from service.light_estimation.ball import BallView
from service.light_estimation.lambertian import least_squares
from stage.capture.light import DistantLight, PointLight
from stage.colour.colour import convert, linearise
from stage.colour.colour_spaces import is_linear, linear_space
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

MIN_COSINE = 0.15
"""The least cosine between light and normal: near the attached shadow a small error of direction is a large error of shading."""
MIN_FACING = 0.25
"""The least cosine between viewer and normal: pixels near the outline mix in background, and their normals are inaccurate."""
MIN_PIXELS = 50
"""The least count of pixels from which a light is measured."""
WEIGHT_SCALE = 2.385
"""The scale of the Cauchy weights 1/(1 + (r/(2.385 σ))²), which are 95 % efficient for normal noise (Holland and Welsch 1977)."""
LEAST_MISFIT, TIMES = 0.05, 2.5
"""Least residual of the shading as declared at which another encoding is tried, which good grey balls stay below; and how many times less
an encoding must leave, which has no free parameter."""
DARK_COSINE, DARK_PIXELS = -0.1, 20
"""The cosine between light and normal below which a ball is dark, also where its direction is some degrees wrong, and the least count of
such pixels that tell of the light there."""
ROUNDS = 20
"""The iterations of the re-weighted least squares."""
ENCODINGS = {"srgb_texture": "sRGB", "g22_rec709_scene": "a power of 2.2"}
"""Display encodings that images declared linear may have, in words; both have the primaries of Rec.709, which do not matter for the
curve."""
MOST_ENCODED = 1.001
"""The largest value of display-encoded images, but for rounding."""
PARTS, IN_COMMON = 4, 0.5
"""Parts of the lit side of a ball, by how they face the light, and what they have in common over what they differ by."""


class Brightness(NamedTuple):
    """The brightness of one light on a grey ball."""

    scale: np.ndarray  # [3] float64, irradiance or intensity, multiplied by ρ/π of the ball
    residual: float
    """The weighted root mean square of reading / model - 1, over the three channels."""
    pixels: int
    """The count of pixels that were used."""


class Shading(NamedTuple):
    """The direction of a distant light from shading."""

    direction: np.ndarray  # [3] float64, unit
    uncertainty_degrees: float
    """The standard error, from the scatter of the readings and from what parts of the ball differ by in the direction that they ask for."""


def received(light: DistantLight | PointLight, view: BallView) -> np.ndarray:
    """Return the irradiance at every pixel of a ball, [h, w], under a light whose own irradiance or intensity is taken as 1.

    It is 0 in the attached shadow and outside the ball. A point light needs a view in metres.
    """
    cosine = np.maximum(_cosine(light, view), 0)
    if isinstance(light, DistantLight):
        return cosine
    way = np.array(light.position_m) - view.point
    distance = np.linalg.norm(way, axis=-1)
    if light.axis is not None and light.anisotropy is not None:
        lobe = np.maximum(-(way @ np.array(light.axis)) / distance, 0)
        cosine = cosine * lobe**light.anisotropy
    return cosine / distance**2


def fit_brightness(
    radiance: np.ndarray,  # [h, w, 3] scene-linear, the box of `view`
    saturated: np.ndarray | None,  # [h, w] bool, or None
    light: DistantLight | PointLight,  # gives direction or position
    view: BallView,
) -> Brightness:
    """Measure the brightness of a light of known position, in each channel by re-weighted least squares of reading = scale · shading.
    Raises CalibrationError if fewer than MIN_PIXELS readings are lit and unsaturated; the message does not name the frame."""
    shading = received(light, view)
    usable = _usable(saturated, view) & (_cosine(light, view) > MIN_COSINE)
    _check_count(int(usable.sum()))
    model, readings = shading[usable], radiance[usable].astype(np.float64)
    scale = np.median(readings / model[:, None], axis=0)
    weight = np.ones_like(readings)
    for _ in range(ROUNDS):
        relative = readings / model[:, None] - scale
        weight = _cauchy(relative)
        scale = (weight * readings * model[:, None]).sum(axis=0) / (weight * model[:, None] ** 2).sum(axis=0)
    if not (scale > 0).any():
        raise CalibrationError("the ball is dark: no channel has light")
    lit = scale > 0
    relative = (readings / model[:, None])[:, lit] / scale[lit] - 1
    residual = math.sqrt(float((weight[:, lit] * relative**2).sum() / weight[:, lit].sum()))
    return Brightness(np.maximum(scale, 0), residual, int(usable.sum()))


def dark_side(radiance: np.ndarray, saturated: np.ndarray | None, light: DistantLight | PointLight, view: BallView, scale: np.ndarray
              ) -> float | None:
    """Return the light on the dark side of the ball, as a part of that where it faces the light; None if that side is not seen.
    `radiance`, `saturated`, `light`, `view`: as of fit_brightness. `scale`: what fit_brightness found."""
    dark = _usable(saturated, view) & (_cosine(light, view) < DARK_COSINE)
    if dark.sum() < DARK_PIXELS:
        return None
    return float(np.median(radiance[dark].mean(axis=-1)) / (scale.mean() * received(light, view)[view.inside].max()))


def better_encoding(radiance: np.ndarray, saturated: np.ndarray | None, light: DistantLight | PointLight, view: BallView, *,
                    exposure: float, declared: str, residual: float, ambient: np.ndarray | None = None) -> tuple[str, float] | None:
    """Return another encoding under which the shading of the ball is much more Lambertian, or None.
    `radiance`, `saturated`, `light`, `view`: as of fit_brightness. `exposure`: recorded values over radiance. `residual`: of
    `fit_brightness` as declared. `ambient`: what is seen without the light, as `radiance`; None: nothing. Returns the colour space that
    declares the encoding, and the residual under it."""
    if residual < LEAST_MISFIT:
        return None
    without = np.zeros_like(radiance) if ambient is None else ambient
    dark = dict(other_readings(without, exposure, declared))
    others = [(space, fit_brightness(values - dark[space], saturated, light, view).residual)
              for space, values in other_readings(radiance, exposure, declared) if space in dark]
    better = [(space, left) for space, left in others if residual >= TIMES * left]
    return min(better, key=lambda one: one[1], default=None)


def fit_direction(radiance: np.ndarray, saturated: np.ndarray | None, view: BallView) -> Shading:
    """Measure the direction of a distant light by re-weighted least squares of b·n = reading, b = ρ/π E l, over the lit pixels.

    The fit starts from the brighter pixels and then decides from its own result which pixels are lit, so that noise does not decide.
    Parameters are as of fit_brightness. Raises CalibrationError if fewer than MIN_PIXELS readings are lit and unsaturated, or they do not
    determine a direction."""
    usable = _usable(saturated, view)
    _check_count(int(usable.sum()))
    normal, reading = view.normal[usable], radiance[usable].astype(np.float64).mean(axis=-1)
    chosen = reading > 0.3 * np.percentile(reading, 95)
    weight = np.ones_like(reading)
    for _ in range(ROUNDS):
        _check_count(int(chosen.sum()))
        n, y, w = normal[chosen], reading[chosen], weight[chosen]
        gram = (n * w[:, None]).T @ n
        if np.linalg.cond(gram) > 1e8:
            raise CalibrationError("the lit part of the ball is too small to tell a direction")
        b = np.linalg.solve(gram, (n * w[:, None]).T @ y)
        length = float(np.linalg.norm(b))
        residual = reading - normal @ b
        weight = _cauchy(residual, residual[chosen])
        chosen = normal @ b > MIN_COSINE * length
    direction = b / length
    across = np.eye(3) - np.outer(direction, direction)
    variance = float((w * (y - n @ b) ** 2).sum() / w.sum())
    scatter = math.degrees(math.sqrt(variance * np.trace(across @ np.linalg.inv(gram) @ across)) / length)
    apart = [_angle(direction, least_squares(y[part, None], w[part, None], n[part])[:, 0])
             for part in np.array_split(np.argsort(n @ direction), PARTS)]
    return Shading(direction, math.hypot(scatter, IN_COMMON * math.sqrt(np.mean(np.square(apart)))))


def _angle(one: np.ndarray, other: np.ndarray) -> float:
    return math.degrees(math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other)))


def _usable(saturated: np.ndarray | None, view: BallView) -> np.ndarray:
    usable = view.inside & ((view.normal * view.to_viewer).sum(axis=-1) > MIN_FACING)
    return usable if saturated is None else usable & ~saturated


def _cosine(light: DistantLight | PointLight, view: BallView) -> np.ndarray:
    if isinstance(light, DistantLight):
        return np.asarray(view.normal @ np.array(light.direction))
    way = np.array(light.position_m) - view.point
    return (view.normal * way).sum(axis=-1) / np.linalg.norm(way, axis=-1)


def _check_count(count: int) -> None:
    if count < MIN_PIXELS:
        raise CalibrationError(f"{count} pixels of the ball are in light and unsaturated: {MIN_PIXELS} are needed")


def _cauchy(residual: np.ndarray, sample: np.ndarray | None = None) -> np.ndarray:
    """Return the Cauchy weights of residuals [n] or [n, channels], scaled by the median absolute value of `sample` or the residuals."""
    spread = MAD_TO_SIGMA * np.median(np.abs(residual if sample is None else sample), axis=0)
    floor = 1e-12 * np.abs(residual).max(axis=0) + 1e-300  # exact readings have no scatter
    return 1 / (1 + (residual / (WEIGHT_SCALE * spread + floor)) ** 2)


def other_readings(radiance: np.ndarray, exposure: np.ndarray | float, declared: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the radiance that the same recorded values stand for under other encodings, with the colour space that declares each.
    `radiance`: [..., rows, cols, 3], scene-linear as declared; if it is declared linear, other encodings need values up to 1. `exposure`:
    recorded values over radiance; has the dimensions of `radiance` or fewer."""
    recorded = (radiance * exposure).astype(np.float32)
    if not is_linear(declared):
        yield linear_space(declared), convert(recorded, linear_space(declared), declared).astype(np.float64) / exposure
    elif recorded.max(initial=0) <= MOST_ENCODED:
        for space in ENCODINGS:
            yield space, linearise(recorded, space).astype(np.float64) / exposure
