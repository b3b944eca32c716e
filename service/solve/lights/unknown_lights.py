"""Distant lights that are found from the images of the object alone, and how unsure the normals are for it."""

from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.errors import RequestError
from service.solve.base.solution import PIXELS_AT_ONCE, SolveInput
from service.solve.lights.bas_relief import Relief, resolve_relief
from service.solve.lights.factorisation import factorise, fit_surface, integrable
from service.solve.lights.object_outline import outline
from service.solve.lights.orientation import INVERSE
from stage.capture.point_lights import DistantLights
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import CalibrationError

LEAST_LIGHTS = 8
"""Fewer lights leave too few readings to spare beside three unknowns for each light and pixel."""
PLACES = 2000
"""Places, spread over the object, from which the lights are found."""
STEP = 50.0
"""Slopes of the surface are differences over a fiftieth of the object on either side: noise decides over single pixels."""
MAP_SIZE = 64
"""Pixels across the small map whose outline is looked at."""
CLEAR = 0.4
"""Least mean outward component of the normals along the outline of an object that stands free, as in `orientation`."""
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
    if outward < 0:
        matrix, others = INVERSE @ matrix, [INVERSE @ other for other in others]
    lights = factors.lights @ np.linalg.inv(matrix)
    strength = np.linalg.norm(lights, axis=1)
    found = DistantLights(lights / strength[:, None], np.repeat((strength / strength.mean())[:, None], 3, axis=1))
    back = np.linalg.inv(matrix)
    least = HIGHLIGHT_DEGREES / relief.told if relief.by == "highlights" else ALBEDO_DEGREES
    result = UnknownLights(found, tuple(other @ back for other in others), least, {}, _warnings(relief, abs(outward)))
    sigma = float(np.median(result.doubt(_unit(matrix @ b))))
    facts = {"resolved_by": relief.by, "told_by_highlights": round(relief.told, 4), "outward": round(abs(outward), 3),
             "misfit": round(factors.misfit, 4), "sigma_degrees": round(sigma, 2), "directions": found.direction.round(5).tolist(),
             "irradiance": found.irradiance[:, 0].round(5).tolist()}
    return result._replace(facts={"unknown_lights": facts})


def _warnings(relief: Relief, outward: float) -> tuple[str, ...]:
    found = ["frames[].light: the lights of the manifest were not used: relight, view and export need those that found.unknown_lights of "
             "the report has"]
    if relief.by == "albedo":
        found.append("--lights unknown: the object has no highlights that tell its relief: it was taken for one of few albedos, and may be "
                     "flatter, deeper or tilted; photograph a chrome ball, or give directions")
    if outward < CLEAR:
        found.append("--lights unknown: the outline does not tell bumps from hollows: x and y of all normals may be negated")
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
    every = max(1, int(np.ceil(_extent(given.mask) / MAP_SIZE)))
    mask = given.mask[::every, ::every]
    pixels = np.arange(given.mask.size).reshape(given.mask.shape)[::every, ::every][mask]
    normal = np.zeros((3, *mask.shape))
    normal[:, mask] = _unit(matrix @ fit_surface(*_read(given, pixels), lights))
    return outline(normal, mask).outward
