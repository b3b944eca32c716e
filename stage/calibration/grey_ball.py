"""Grey (Lambertian) ball → the irradiance of each light, and from its shading alone the direction too.

I = ρ/π E max(0, n·l), over pixels in light, unsaturated, and without those that a robust weight takes for highlights.
"""

import math
from typing import NamedTuple

import numpy as np

from stage.calibration.ball import BallView
from stage.errors import CalibrationError
from stage.light import DistantLight, PointLight

MIN_COSINE = 0.15
"""Of the light on the surface: below it, at the attached shadow's edge, a small error of direction is a large one of shading."""
MIN_FACING = 0.25
"""Of the surface to the viewer: below it pixels mix ball and background, and the outline's error becomes the normal's."""
MIN_PIXELS = 50
"""Fewer pixels than this measure nothing."""
WEIGHT_SCALE = 2.385
"""Cauchy weights 1/(1 + (r/(2.385 σ))²): 95 % efficient on normal noise (Holland and Welsch 1977)."""
ROUNDS = 20


class Brightness(NamedTuple):
    """What one light does to a grey ball."""

    scale: np.ndarray  # [3] float64, irradiance or intensity, times ρ/π of the ball
    residual: float
    """Weighted root mean square of reading/model - 1, over the three channels."""
    pixels: int


class Shading(NamedTuple):
    """A distant light from shading alone."""

    direction: np.ndarray  # [3] float64, unit
    uncertainty_degrees: float
    """Standard error from the scatter of the readings; a ball that is not Lambertian shifts the direction by more."""


def received(light: DistantLight | PointLight, view: BallView) -> np.ndarray:
    """Irradiance at every pixel of the ball for a light of irradiance or intensity 1.

    Args:
        light: a point light needs a view whose points are in metres.

    Returns:
        [h, w] float64; 0 in the attached shadow and outside the ball.
    """
    if isinstance(light, DistantLight):
        return np.maximum(view.normal @ np.array(light.direction), 0)
    way = np.array(light.position_m) - view.point
    distance = np.linalg.norm(way, axis=-1)
    cosine = np.maximum((view.normal * way).sum(axis=-1) / distance, 0)
    if light.axis is not None and light.anisotropy is not None:
        lobe = np.maximum(-(way @ np.array(light.axis)) / distance, 0)
        cosine = cosine * lobe**light.anisotropy
    return cosine / distance**2


def fit_brightness(radiance: np.ndarray, saturated: np.ndarray | None, light: DistantLight | PointLight,
                   view: BallView) -> Brightness:
    """The brightness of one light, per channel by re-weighted least squares of reading = scale · shading.

    Args:
        radiance: [h, w, 3] scene-linear, the box of `view`.
        saturated: [h, w] bool, or None.
        light: where it is.
        view: the ball.

    Raises:
        CalibrationError: fewer than MIN_PIXELS lit, unsaturated readings; the message does not name the frame.
    """
    shading = received(light, view)
    incidence = view.normal @ np.array(light.direction) if isinstance(light, DistantLight) else _cosine(light, view)
    usable = _usable(saturated, view) & (incidence > MIN_COSINE)
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


def fit_direction(radiance: np.ndarray, saturated: np.ndarray | None, view: BallView) -> Shading:
    """Direction of one distant light by re-weighted least squares of b·n = reading, b = ρ/π E l, on the grey ball's lit pixels.

    Which pixels are lit follows from the fit itself, starting from the brighter ones, so that noise does not choose them.

    Args:
        radiance: [h, w, 3] scene-linear, the box of `view`.
        saturated: [h, w] bool, or None.
        view: the ball.

    Raises:
        CalibrationError: fewer than MIN_PIXELS lit, unsaturated readings.
    """
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
    return Shading(direction, math.degrees(math.sqrt(variance * np.trace(across @ np.linalg.inv(gram) @ across)) / length))


def _usable(saturated: np.ndarray | None, view: BallView) -> np.ndarray:
    usable = view.inside & ((view.normal * view.to_viewer).sum(axis=-1) > MIN_FACING)
    return usable if saturated is None else usable & ~saturated


def _cosine(light: PointLight, view: BallView) -> np.ndarray:
    way = np.array(light.position_m) - view.point
    return (view.normal * way).sum(axis=-1) / np.linalg.norm(way, axis=-1)


def _check_count(count: int) -> None:
    if count < MIN_PIXELS:
        raise CalibrationError(f"{count} pixels of the ball are in light and unsaturated: {MIN_PIXELS} are needed")


def _cauchy(residual: np.ndarray, sample: np.ndarray | None = None) -> np.ndarray:
    """Weights of residuals [n] or [n, channels]; their scale is the median absolute one of `sample` (of themselves)."""
    spread = 1.4826 * np.median(np.abs(residual if sample is None else sample), axis=0)
    floor = 1e-12 * np.abs(residual).max(axis=0) + 1e-300  # exact readings have no scatter
    return 1 / (1 + (residual / (WEIGHT_SCALE * spread + floor)) ** 2)
