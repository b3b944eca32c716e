"""Lights and surface of a mostly Lambertian object from its images alone, up to the ambiguities that such images leave.

The images of a Lambertian object under distant lights have rank three: y_lp = s_l·b_p, with the light s (direction times irradiance)
and b = albedo × normal. Any invertible 3×3 matrix A gives other ones, s A⁻¹ and A b. The surface is smooth, so that b must be the normals
of a height: this leaves the generalised bas-relief ambiguity of three numbers, b → (b₁ + μ b₃, b₂ + ν b₃, λ b₃).

Sources: Hayakawa, "Photometric stereo under a light source with arbitrary motion", JOSA A 11(11), 1994 (factorisation); Yuille and Snow,
"Shape and albedo from multiple images using integrability", CVPR 1997; Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity", IJCV
35(1), 1999. Re-weighting against shadows and highlights is that of `service.light_estimation.lambertian`.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.lambertian import CAUCHY, SHADOW, bright_readings, fit_lambertian, least_squares
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

ROUNDS = 40
"""Rounds of alternating least squares; the lights move by less than a thousandth after them."""
START_PART, START_PIXELS = 0.25, 60
"""The part of the pixels, and the least count, that the singular vectors of the start come from: those that most lights reach."""
LEAST_SPREAD = 0.005
"""Least standard deviation that the weights assume, relative to the bright readings of a pixel: half rounding is below it."""
BEHIND, BEHIND_WEIGHT = 0.05, 0.02
"""A reading whose prediction is below the first part of the bright readings of its pixel is in shadow, and keeps the second part of its
weight, so that a wrong start cannot lose it for ever."""
LEAST_SHOWN = 30
"""Least count of pixels that must show a light."""
LEAST_SITES = 100
"""Least count of places at which integrability is compared: it has six unknowns, and half the places may lie on edges."""
INTEGRABLE_ROUNDS = 20
"""Rounds of re-weighting of the equations for integrability."""
LARGEST_MISFIT = 0.08
"""Largest robust standard deviation of the readings about rank three, relative to the bright readings of a pixel: matt and glossy objects
leave up to 0.02, an object of which half is in cast shadow 0.2."""
CLEAR = 2.0
"""Least ratio of the second smallest to the smallest singular value of these equations: below it no surface is told from others."""


class Factorisation(NamedTuple):
    """The lights of rank-three images."""

    lights: np.ndarray  # [lights, 3] float64, direction × irradiance up to a 3×3 matrix that all share
    misfit: float
    """Robust standard deviation of the readings, relative to the bright readings of their pixel."""


def factorise(readings: np.ndarray, usable: np.ndarray, start: np.ndarray | None = None) -> Factorisation:
    """Return the lights under which the images have rank three.

    Args:
        readings: [lights, pixels] scene-linear grey readings of pixels that are spread over the object.
        usable: [lights, pixels] bool, True for unsaturated readings.
        start: [lights, 3] to begin from; None: the singular vectors of the pixels that most lights reach.

    Raises:
        CalibrationError: a light is shown by too few pixels, or no lights explain the images.
    """
    strength = np.maximum(readings.mean(axis=1, keepdims=True), 1e-300)
    scaled = readings / strength
    scaled = scaled / np.maximum(bright_readings(scaled, usable), 1e-300)
    lit = usable & (scaled > SHADOW)
    few = np.flatnonzero(lit.sum(axis=1) < LEAST_SHOWN)
    if len(few):
        raise CalibrationError(f"light {few[0] + 1} of {len(lit)}: {lit[few[0]].sum()} of {lit.shape[1]} pixels of the object are lit: "
                               f"{LEAST_SHOWN} are needed to tell a light")
    if start is None:
        best = np.argsort(-lit.sum(axis=0), kind="stable")[: max(START_PIXELS, int(START_PART * lit.shape[1]))]
        left, values, _ = np.linalg.svd(scaled[:, best], full_matrices=False)
        lights = left[:, :3] * values[:3]
    else:
        lights = start / strength
    weight = lit.astype(np.float64)
    for _ in range(ROUNDS):
        surface = least_squares(scaled, weight, lights)
        lights = least_squares(scaled.T, weight.T, surface.T).T
        model = lights @ surface
        residual = np.where(lit, scaled - model, 0)
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual[lit]))) + LEAST_SPREAD
        weight = lit / (1 + (residual / (CAUCHY * spread)) ** 2)
        weight = np.where(model > BEHIND, weight, BEHIND_WEIGHT * weight)
    if spread - LEAST_SPREAD > LARGEST_MISFIT:
        raise CalibrationError("no distant lights explain the images by diffuse reflection: they miss the readings by "
                               f"{100 * spread:.0f} % (shadows, metal and light that the object throws on itself do that)")
    return Factorisation(lights * strength, spread - LEAST_SPREAD)


def fit_surface(readings: np.ndarray, usable: np.ndarray, lights: np.ndarray) -> np.ndarray:
    """Return b of each pixel, [3, pixels] float64, by a robust fit under the lights of `factorise` times any 3×3 matrix."""
    strength = np.linalg.norm(lights, axis=1, keepdims=True)
    return fit_lambertian(readings / strength, usable, lights / strength).vector


def integrable(b: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return the matrix A [3, 3] with which A b are the normals of a height, up to the generalised bas-relief ambiguity.

    The slopes of A b, with rows a₁ a₂ a₃, are integrable where ∂/∂y (a₁·b/a₃·b) = ∂/∂x (a₂·b/a₃·b). With w = b × ∂b this is
    (a₃ × a₁)·w_y = (a₃ × a₂)·w_x, linear in six numbers.
    `b`: [3, places] at some places of the image. `right, up`: [3, places] differences of b along +x and +y, in one unit. Raises
    CalibrationError: there are too few places, or no matrix is told from others, as on a plane."""
    if b.shape[1] < LEAST_SITES:
        raise CalibrationError(f"{b.shape[1]} pixels of the object have neighbours on all sides: unknown lights need {LEAST_SITES}")
    scale = np.maximum((b**2).sum(axis=0), 1e-300)
    equations = np.concatenate([np.cross(b.T, up.T), -np.cross(b.T, right.T)], axis=1) / scale[:, None]
    weight = np.ones(len(equations))
    for _ in range(INTEGRABLE_ROUNDS):
        _, values, vectors = np.linalg.svd(equations * weight[:, None], full_matrices=False)
        residual = equations @ vectors[-1]
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-12
        weight = 1 / np.sqrt(1 + (residual / (2 * spread)) ** 2)
    if values[4] < CLEAR * values[5]:
        raise CalibrationError("the surface is too flat, or its images too noisy: many lights explain them alike")
    first, second = vectors[-1][:3], vectors[-1][3:]
    third = np.cross(first, second)
    if np.linalg.norm(third) < 1e-9:
        raise CalibrationError("the surface curves in one direction only: many lights explain its images alike")
    third /= np.linalg.norm(third)
    return np.stack([np.cross(first, third), np.cross(second, third), third])
