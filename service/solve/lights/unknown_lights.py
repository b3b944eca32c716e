"""Distant lights that are found from the images of the object alone, and how unsure the normals are for it."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from kernels.photometric.model.samples import evenly
from service.errors import RequestError
from service.light_estimation.lambertian import SHADOW, bright_readings
from service.light_estimation.light_axes import CLEAR, INVERSE, Grid
from service.light_estimation.object_outline import outline
from service.solve.base.solution import PIXELS_AT_ONCE, SolveInput
from service.solve.lights.factorisation import factorise, fit_surface, integrable
from service.solve.lights.orientation import is_upright
from stage.capture.point_lights import DistantLights
from stage.colour.colour import GREY_WEIGHTS
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


class _Pixels(NamedTuple):
    """Pixels with what Lambert's law leaves of their readings."""

    residual: np.ndarray  # [lights, pixels]
    compared: np.ndarray  # [lights, pixels] bool
    lights: np.ndarray  # [lights, 3]
    b: np.ndarray  # [3, pixels]

    def thinned(self, most: int) -> "_Pixels":
        which = evenly(self.b.shape[1], most)
        return self._replace(residual=self.residual[:, which], compared=self.compared[:, which], b=self.b[:, which])


LEAST_LIGHTS = 8
"""Fewer lights leave too few readings to spare beside three unknowns for each light and pixel."""
PLACES = 2000
"""Places, spread over the object, from which the lights are found."""
STEP = 50.0
"""Slopes of the surface are differences over a fiftieth of the object on either side: noise decides over single pixels."""
QUARTERS = 4
"""Parts of the object, each of which is left out once to find the uncertainty."""
HIGHLIGHT_DEGREES, ALBEDO_DEGREES = 2.0, 20.0
"""Standard error of the normals beside that of left-out quarters: where highlights resolve the relief, the first number over the part of
the residuals that they explain; where albedo does, the second. On the DiLiGenT ball and cat the errors were 0.6 and 5 degrees where the
first rule says 2.5 and 8, by albedo 4 and 21; by albedo, the cat of the University of Washington is 8 degrees off, its grey sphere 29."""


class UnknownLights(NamedTuple):
    """The lights that explain the images."""

    lights: DistantLights
    """Mean irradiance 1, the same for all channels."""
    turns: tuple[np.ndarray, ...]
    """[3, 3] each: from the normals to those without one quarter of the object, up to their length."""
    least_degrees: float
    """Standard error of every normal that the quarters do not show."""
    two_ways: bool
    """Whether nothing tells bumps from hollows."""
    facts: dict[str, Any]
    """Facts for the report."""
    warnings: tuple[str, ...]

    def doubt(self, normal: np.ndarray) -> np.ndarray:
        """Return the standard error of normals [3, pixels] for not knowing the lights, [pixels] degrees."""
        squares = np.full(normal.shape[1], self.least_degrees**2)
        for first in range(0, len(squares), PIXELS_AT_ONCE):
            part = normal[:, first : first + PIXELS_AT_ONCE]
            for turn in self.turns:
                turned = turn @ part
                cosine = (part * turned).sum(axis=0) / np.maximum(np.linalg.norm(turned, axis=0), 1e-12)
                angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
                squares[first : first + PIXELS_AT_ONCE] += (QUARTERS - 1) / QUARTERS * angle**2
        if self.two_ways:  # half of the times it is the inverse, twice the tilt away
            squares += 2 * np.degrees(np.arccos(np.clip(normal[2], -1, 1))) ** 2
        return np.sqrt(squares)


def find_lights(given: SolveInput) -> UnknownLights:
    """Find the lights of a capture from its images, which an orthographic camera took."""
    count = given.stack.light_count
    if given.camera.projection != "orthographic":
        raise RequestError("--lights unknown: needs an orthographic camera: declare one if the object is far away against its size")
    if count < LEAST_LIGHTS:
        raise RequestError(f"--lights unknown: {count} lit frames: {LEAST_LIGHTS} or more are needed")
    step = max(1, round(_extent(given.mask) / STEP))
    places = _with_neighbours(given.mask, step)
    if not len(places):
        raise CalibrationError("--lights unknown: the mask has no pixel with neighbours on all sides")
    places = places[evenly(len(places), PLACES)]
    readings, usable = _read(given, places)
    try:
        factors = factorise(readings, usable)
        b = fit_surface(readings, usable, factors.lights)
        left, right, above, below = (fit_surface(*_read(given, places + offset), factors.lights)
                                     for offset in (-step, step, -step * given.camera.width, step * given.camera.width))
        told = np.isfinite([b, left, right, above, below]).all(axis=(0, 1)) & (np.linalg.norm(b, axis=0) > 0)
        if not told.all():  # shadow and saturation alone fit no surface
            places, readings, usable = places[told], readings[:, told], usable[:, told]
            b, left, right, above, below = (each[:, told] for each in (b, left, right, above, below))

        def choose(which: np.ndarray, near: Relief | None = None) -> tuple[Relief, np.ndarray]:
            matrix = integrable(b[:, which], (right - left)[:, which], (above - below)[:, which])
            if near is not None:
                turn = near.matrix @ np.linalg.inv(matrix)
                if turn[0, 0] * turn[2, 2] < 0:  # integrability tells a surface from its inverse as little as the images do
                    matrix, turn = INVERSE @ matrix, turn @ INVERSE
                near = near._replace(matrix=turn)
            lights = factors.lights @ np.linalg.inv(matrix)
            relief = resolve_relief(readings[:, which], usable[:, which], lights, matrix @ b[:, which], near)
            return relief._replace(matrix=relief.matrix @ matrix), relief.matrix @ matrix

        relief, matrix = choose(np.ones(len(places), dtype=bool))
        row, col = np.divmod(places, given.camera.width)
        quarter = 2 * (row > np.median(row)) + (col > np.median(col))
        others = [choose(quarter != number, relief)[1] for number in range(QUARTERS)]
    except CalibrationError as error:
        raise CalibrationError(f"--lights unknown: {error}") from error
    except np.linalg.LinAlgError as error:  # equations of shadow and saturation alone
        raise CalibrationError("--lights unknown: the images do not determine the lights: too much of the object is dark, saturated or "
                               "flat; photograph a chrome ball, or give directions") from error
    outward = _outward(given, factors.lights, matrix)
    upright: bool | None = outward > 0
    if abs(outward) < CLEAR:
        upright = is_upright(given, _lights_of(factors.lights @ np.linalg.inv(matrix)),
                             lambda pixels: _unit(matrix @ fit_surface(*_read(given, pixels), factors.lights)))
    two_ways = upright is None
    if outward < 0 if two_ways else not upright:
        matrix, others = INVERSE @ matrix, [INVERSE @ other for other in others]
    back = np.linalg.inv(matrix)
    found = _lights_of(factors.lights @ back)
    least = HIGHLIGHT_DEGREES / relief.told if relief.by == "highlights" else ALBEDO_DEGREES
    result = UnknownLights(found, tuple(other @ back for other in others), least, two_ways, {}, _warnings(relief, two_ways))
    sigma = float(np.median(result.doubt(_unit(matrix @ b))))
    facts = {"resolved_by": relief.by, "told_by_highlights": round(relief.told, 4), "outward": round(abs(outward), 3),
             "misfit": round(factors.misfit, 4), "sigma_degrees": round(sigma, 2), "directions": found.direction.round(5).tolist(),
             "irradiance": found.irradiance[:, 0].round(5).tolist()}
    return result._replace(facts={"unknown_lights": facts})


def _lights_of(lights: np.ndarray) -> DistantLights:
    """Return lights of [lights, 3] direction × irradiance, of mean irradiance 1."""
    strength = np.linalg.norm(lights, axis=1)
    return DistantLights(lights / strength[:, None], np.repeat((strength / strength.mean())[:, None], 3, axis=1))


def _warnings(relief: Relief, two_ways: bool) -> tuple[str, ...]:
    found = ["frames[].light: the lights of the manifest were not used: relight, view and export need those that found.unknown_lights of "
             "the report has"]
    if relief.by == "albedo":
        found.append("--lights unknown: the object has no highlights that tell its relief: it was taken for one of few albedos, and may be "
                     "flatter, deeper or tilted; photograph a chrome ball, or give directions")
    if two_ways:
        found.append("--lights unknown: neither the outline nor shadows tell bumps from hollows: x and y of all normals may be negated, "
                     "which sigma holds")
    return tuple(found)


def _extent(mask: np.ndarray) -> float:
    return float(max(np.ptp(axis) + 1 for axis in np.nonzero(mask)))


def _with_neighbours(mask: np.ndarray, step: int) -> np.ndarray:
    """Return the positions of the pixels whose four neighbours at a distance are in the mask too."""
    inside = np.zeros_like(mask)
    if min(mask.shape) > 2 * step:
        middle = slice(step, -step)
        inside[middle, middle] = (mask[middle, middle] & mask[2 * step :, middle] & mask[: -2 * step, middle]
                                  & mask[middle, 2 * step :] & mask[middle, : -2 * step])
    return np.flatnonzero(inside)


def _read(given: SolveInput, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey readings [lights, pixels] and whether each is usable."""
    radiance, usable = given.stack.pick_radiance(pixels)
    return np.einsum("lpc,c->lp", radiance.astype(np.float64), np.asarray(GREY_WEIGHTS)), usable


def _unit(b: np.ndarray) -> np.ndarray:
    return b / np.maximum(np.linalg.norm(b, axis=0), 1e-300)


def _outward(given: SolveInput, lights: np.ndarray, matrix: np.ndarray) -> float:
    """Return the mean outward component of the normals along the outline of the mask."""
    grid = Grid.of(given.mask)
    normal = np.zeros((3, *grid.inside.shape))
    normal[:, grid.inside] = _unit(matrix @ fit_surface(*_read(given, grid.chosen), lights))
    return outline(normal, grid.inside).outward


# The generalised bas-relief ambiguity of a factorised surface, resolved by its highlights, or by its albedo where it has none.
#
# The normals of a height, and lights to them, are known up to b → (b₁ + μ b₃, b₂ + ν b₃, λ b₃). Highlights tell these three numbers: what
# the surface reflects beyond Lambert's law is a function of the angle between the normal and the bisector of light and viewer, the same for
# all pixels of a material, under the right lights alone. No shape of the lobe is assumed: the variance of these residuals is compared
# within narrow ranges of the angle. A surface without highlights is taken for one of few albedos: the logarithms of |b| then lie closest
# together.
#
# Sources: Belhumeur, Kriegman and Yuille, "The bas-relief ambiguity", IJCV 35(1), 1999; Drbohlav and Šára, "Specularities reduce ambiguity
# of uncalibrated photometric stereo", ECCV 2002, and Tan, Mallick, Quan, Kriegman and Zickler, "Isotropy, reciprocity and the generalized
# bas-relief ambiguity", CVPR 2007, for what highlights and isotropy tell; Alldrin, Mallick and Kriegman, "Resolving the generalized bas-
# relief ambiguity by entropy minimization", CVPR 2007, for few albedos.

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
    normal = _unit(matrix @ pixels.b)
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
