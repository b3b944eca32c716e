"""The generalised bas-relief ambiguity of a factorised surface, resolved by its highlights, or by its albedo where it has none.

The normals of a height, and lights to them, are known up to b → (b₁ + μ b₃, b₂ + ν b₃, λ b₃). Highlights tell these three numbers: what
the surface reflects beyond Lambert's law is a function of the angle between the normal and the bisector of light and viewer, the same for
all pixels of a material, under the right lights alone. No shape of the lobe is assumed: the variance of these residuals is compared within
narrow ranges of the angle. A surface without highlights is taken for one of few albedos: the logarithms of |b| then lie closest together.

Sources: Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity", IJCV 35(1), 1999; Drbohlav and Šára, "Specularities reduce ambiguity
of uncalibrated photometric stereo", ECCV 2002, and Tan, Mallick, Quan, Kriegman and Zickler, "Isotropy, reciprocity and the generalized
bas-relief ambiguity", CVPR 2007, for what highlights and isotropy tell; Alldrin, Mallick and Kriegman, "Resolving the generalized
bas-relief ambiguity by entropy minimization", CVPR 2007, for few albedos.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from service.light_estimation.lambertian import SHADOW, bright_readings
from stage.errors import CalibrationError

SLOPES = (-0.8, -0.4, 0.0, 0.4, 0.8)
"""μ and ν that are tried first, in units of the middle slope of the surface."""
STRETCHES = (0.4, 0.6, 0.9, 1.3, 2.0, 3.0)
"""λ that are tried first: the middle slope of the surface is the inverse."""
STARTS = 4
"""The number of the best of these that are refined."""
SEARCH_PIXELS, PIXELS = 400, 1600
"""Pixels of the first search and of the refinement."""
STEPS = 120
"""Most steps of a refinement."""
BINS, WIDEST_DEGREES = 30, 60.0
"""Ranges of the angle between normal and bisector, and the largest angle: no lobe of gloss is wider."""
CLIP = 0.995
"""The quantile of the residuals above which they count as this large: single mirrored lights must not decide."""
LEAST_TOLD = 0.2
"""Least part of the variance of the residuals that the angle must explain for highlights to be believed: noise leaves less than 0.03."""
LEAST_COMPARED = 100
"""Least count of lit readings that are compared."""
ALBEDO_SCALE = 0.1
"""Difference of logarithms of albedo from which a pixel counts as one of another material."""


class Relief(NamedTuple):
    """The choice among the reliefs of a surface."""

    matrix: np.ndarray
    """[3, 3] M: M b are albedo × normal with z towards the viewer, and s M⁻¹ the lights."""
    by: str
    """highlights or albedo."""
    told: float
    """The part of the variance of the residuals that highlights explain."""


def resolve_relief(readings: np.ndarray, usable: np.ndarray, lights: np.ndarray, b: np.ndarray, near: Relief | None = None) -> Relief:
    """Choose the relief of a surface seen along -z by an orthographic camera; its inverse, with x and y negated, explains as much.

    Args:
        readings: [lights, pixels] scene-linear grey readings.
        usable: [lights, pixels] bool.
        lights: [lights, 3] direction × irradiance up to the ambiguity.
        b: [3, pixels] albedo × normal up to the ambiguity.
        near: a choice that is known to be near, to be refined by the same means; None: search all.

    Raises:
        CalibrationError: too few readings are lit.
    """
    base = _centred(b)
    lights, b = lights @ np.linalg.inv(base), base @ b
    model = lights @ b
    compared = usable & (model > SHADOW * bright_readings(readings, usable))
    if compared.sum() < LEAST_COMPARED or not np.isfinite(model).all():
        raise CalibrationError("hardly a reading is lit under the lights that explain the images: they show shadow, saturation or noise")
    pixels = _Pixels(readings - model, compared, lights, b)
    costs: dict[str, Callable[[_Pixels, np.ndarray], float]] = {"highlights": _untold_by_highlights, "albedo": _spread_of_albedo}
    if near is not None:
        point, _ = _minimise(partial(costs[near.by], pixels.thinned(PIXELS)), _point(near.matrix @ np.linalg.inv(base)))
        return Relief(_matrix(point) @ base, near.by, near.told)
    told = 0.0
    for by, cost in costs.items():
        search = partial(cost, pixels.thinned(SEARCH_PIXELS))
        grid = [np.array([mu, nu, np.log(stretch)]) for mu in SLOPES for nu in SLOPES for stretch in STRETCHES]
        ends = [_minimise(search, start) for start in sorted(grid, key=search)[:STARTS]]
        point, least = _minimise(partial(cost, pixels.thinned(PIXELS)), min(ends, key=lambda end: end[1])[0])
        if by == "highlights":
            told = 1 - least
            if told >= LEAST_TOLD:
                break
    return Relief(_matrix(point) @ base, by, told)


class _Pixels(NamedTuple):
    """Pixels with what Lambert's law leaves of their readings."""

    residual: np.ndarray  # [lights, pixels]
    compared: np.ndarray  # [lights, pixels] bool
    lights: np.ndarray  # [lights, 3]
    b: np.ndarray  # [3, pixels]

    def thinned(self, most: int) -> "_Pixels":
        count = self.b.shape[1]
        which = np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))
        return self._replace(residual=self.residual[:, which], compared=self.compared[:, which], b=self.b[:, which])


def _centred(b: np.ndarray) -> np.ndarray:
    """Return the relief in which the middle normal faces the viewer, and the middle slope is 1."""
    sign = 1.0 if (b[2] > 0).mean() >= 0.5 else -1.0
    b = sign * b
    facing = b[2] > 0.1 * np.median(np.linalg.norm(b, axis=0))
    if facing.sum() < 3:
        facing = np.ones(b.shape[1], dtype=bool)
    slope = b[:2, facing] / b[2, facing]
    middle = np.median(slope, axis=1)
    size = float(np.median(np.linalg.norm(slope - middle[:, None], axis=0)))
    return sign * np.array([[1, 0, -middle[0]], [0, 1, -middle[1]], [0, 0, max(size, 1e-9)]])


def _matrix(point: np.ndarray) -> np.ndarray:
    return np.array([[1, 0, point[0]], [0, 1, point[1]], [0, 0, np.exp(point[2])]])


def _point(matrix: np.ndarray) -> np.ndarray:
    """Return μ, ν and ln λ of a matrix that is nearly a relief."""
    matrix = matrix / matrix[0, 0]
    return np.array([matrix[0, 2], matrix[1, 2], np.log(max(float(matrix[2, 2]), 1e-6))])


def _untold_by_highlights(pixels: _Pixels, point: np.ndarray) -> float:
    """Return the part of the variance of the residuals that the angle between normal and bisector does not explain."""
    matrix = _matrix(np.clip(point, -5, 5))
    lights = pixels.lights @ np.linalg.inv(matrix)
    strength = np.linalg.norm(lights, axis=1, keepdims=True)
    normal = matrix @ pixels.b
    normal = normal / np.maximum(np.linalg.norm(normal, axis=0), 1e-300)
    half = lights / strength + np.array([0.0, 0.0, 1.0])
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip(half @ normal, -1, 1)))[pixels.compared]
    residual = (pixels.residual / strength)[pixels.compared]
    top = float(np.quantile(residual, CLIP))
    residual = np.clip(residual, -top, top)
    place = np.minimum(angle / WIDEST_DEGREES * BINS, BINS).astype(int)
    count = np.maximum(np.bincount(place, minlength=BINS + 1), 1)
    total, squares = np.bincount(place, residual, BINS + 1), float((residual**2).sum())
    variance = squares - float(residual.sum()) ** 2 / len(residual)
    return (squares - float((total**2 / count).sum())) / max(variance, 1e-300)


def _spread_of_albedo(pixels: _Pixels, point: np.ndarray) -> float:
    """Return how far the logarithms of albedo lie from their median, robustly."""
    size = np.linalg.norm(_matrix(np.clip(point, -5, 5)) @ pixels.b, axis=0)
    logarithm = np.log(np.maximum(size, 1e-300))
    return float(np.log1p(((logarithm - np.median(logarithm)) / ALBEDO_SCALE) ** 2).mean())


def _minimise(cost: Callable[[np.ndarray], float], start: np.ndarray) -> tuple[np.ndarray, float]:
    """Return where Nelder and Mead's simplex ends, and the cost there."""
    simplex = np.stack([start, *(start + 0.15 * np.eye(len(start)))])
    found = minimize(cost, start, method="Nelder-Mead",
                     options={"initial_simplex": simplex, "maxiter": STEPS, "xatol": 1e-4, "fatol": np.inf})
    return found.x, float(found.fun)
