"""Distant lights whose directions are known roughly, refined by the images of the object before it is solved.

The images of a Lambertian object have rank three, which gives the lights up to a 3×3 matrix that all share (`factorisation`). The matrix
is that with which they lie closest to the given directions. So the errors that each light has of its own go, and what all have in common
stays: n lights determine 2n numbers of which nine are taken from the table, and of independent errors √(9/2n) is left. A turn that they
have in common is told by the surface and its highlights (`turn`), before the others and after.

Sources: Hayakawa, JOSA A 11(11), 1994, for the factorisation; Huber and Ronchetti, "Robust Statistics", 2009, for the re-weighting.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.model.samples import some_of
from service.light_estimation.explanations import grey_readings
from service.solve.base.solution import SolveInput
from service.solve.lights.factorisation import factorise
from service.solve.lights.turn import turn_of
from stage.capture.point_lights import DistantLights
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

PIXELS = 1000
"""Pixels, spread over the object, from which the directions are refined."""
GROSS_TIMES, GROSS_DEGREES = 4.0, 3.0
"""A light is named that moved by more than this many times the median, and by more than this angle."""
LEAST_LIGHTS = 12
"""Fewer lights leave more than 0.6 of independent errors."""
ROUNDS = 40
"""Rounds of re-weighting."""
OUTLIER = 2.0
"""Standard deviations from which a direction of the table counts less."""
RIGHT_STRENGTH = 0.1
"""Largest standard deviation of the logarithm of the strengths at which the given strengths are right, and help to find the matrix."""
LEAST_SIGMA = np.radians(0.1)
"""Least standard deviation of the directions that the weights assume."""
SHARED = 9
"""Numbers that all lights share."""
MODEL_DEGREES = 0.5
"""Error of directions that Lambert's law itself causes: right ones of real objects move by 0.3 to 0.8 degrees."""


class RefinedDirections(NamedTuple):
    """Lights that explain the images, closest to those that were given."""

    direction: np.ndarray  # [lights, 3] unit
    factor: np.ndarray  # [lights] their irradiance over that given, geometric mean 1
    moved_degrees: np.ndarray  # [lights] angle from the given direction
    left_degrees: float
    """Standard error of all directions together, from that of the table: normals turn with it."""
    misfit: float
    """Robust standard deviation of the readings, relative to the bright readings of their pixel."""


class RefinedLights(NamedTuple):
    """The lights that explain the images, closest to those of the manifest."""

    lights: DistantLights
    left_degrees: float
    facts: dict[str, Any]
    """Facts for the report."""
    warnings: tuple[str, ...]

    def doubt(self, normal: np.ndarray) -> np.ndarray:
        """Return the standard error of normals [3, pixels] for what all directions have wrong together, [pixels] degrees."""
        return np.full(normal.shape[1], self.left_degrees)


def refine_lights(given: SolveInput, lights: DistantLights) -> RefinedLights:
    """Refine the lights of a capture: the turn that all have in common, what each has wrong of its own, and the turn that this had hidden;
    only their directions where a solve keeps the declared intensities. Raises CalibrationError: there are too few lights, or they do not
    explain the images."""
    first = turn_of(given, lights)
    turned = lights if first is None else first.of(lights)
    few = first is not None and len(lights.direction) < LEAST_LIGHTS
    found = RefinedLights(turned, MODEL_DEGREES, {}, ()) if few else _one_by_one(given, turned)
    second = None if few else turn_of(given, found.lights)
    turn = first if second is None else second.after(first)
    if turn is None:
        return found
    lights = found.lights if second is None else second.of(found.lights)
    left = float(np.hypot(found.left_degrees, turn.sigma_degrees))
    told = found.facts.get("refined_lights", {}) | {"left_degrees": round(left, 3), "directions": lights.direction.round(5).tolist()}
    return RefinedLights(lights, left, {"refined_lights": told, "light_turn": turn.facts()}, (
        f"frames[].light.direction: {turn.undone()}", *found.warnings))


def _one_by_one(given: SolveInput, lights: DistantLights) -> RefinedLights:
    """Refine what each light has wrong of its own."""
    radiance, usable = given.stack.pick_radiance(some_of(given.mask, PIXELS))
    try:
        found = refine_directions(grey_readings(radiance, lights.irradiance), usable, lights.direction)
    except CalibrationError as error:
        raise CalibrationError(f"--lights refined: {error}") from error
    factor = found.factor if given.refine_intensities else np.ones_like(found.factor)
    moved = found.moved_degrees
    middle = float(np.median(moved))
    gross = np.flatnonzero(moved > max(GROSS_TIMES * middle, GROSS_DEGREES))
    warnings = tuple(f"{given.stack.frames[index]}: its light moved by {moved[index]:.0f}°, the middle one by {middle:.1f}°: check its "
                     "direction" for index in gross)
    facts = {"median_moved_degrees": round(middle, 3), "largest_moved_degrees": round(float(moved.max()), 3),
             "left_degrees": round(found.left_degrees, 3), "misfit": round(found.misfit, 4),
             "directions": found.direction.round(5).tolist(), "factors": factor.round(4).tolist()}
    return RefinedLights(DistantLights(found.direction, lights.irradiance * factor[:, None]), found.left_degrees, {"refined_lights": facts},
                         warnings)


def refine_directions(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray) -> RefinedDirections:
    """Refine the directions of lights, which are known roughly.

    Args:
        readings: [lights, pixels] grey radiance over the given irradiance, of pixels that are spread over the object.
        usable: [lights, pixels] bool, True for unsaturated readings.
        directions: [lights, 3] unit.

    Raises:
        CalibrationError: there are too few lights, a light is shown by too few pixels, or no lights explain the images.
    """
    count = len(directions)
    if count < LEAST_LIGHTS:
        raise CalibrationError(f"{count} distant lights, which nothing says are all turned alike: to refine each, {LEAST_LIGHTS} or more "
                               "are needed")
    found = factorise(readings, usable, directions)
    lights = _closest(found.lights, directions, with_strength=False)
    strength = np.log(np.linalg.norm(lights, axis=1))
    if MAD_TO_SIGMA * float(np.median(np.abs(strength - np.median(strength)))) < RIGHT_STRENGTH:
        lights = _closest(found.lights, directions, with_strength=True)
    length = np.linalg.norm(lights, axis=1)
    direction = lights / length[:, None]
    moved = np.degrees(2 * np.arctan2(np.linalg.norm(direction - directions, axis=1), np.linalg.norm(direction + directions, axis=1)))
    # the residuals of the table have lost the part that the nine numbers follow
    typical = float(np.median(moved)) / np.sqrt(max(1 - SHARED / (2 * count), 0.1))
    left = float(np.hypot(typical * np.sqrt(SHARED / (2 * count)), MODEL_DEGREES))
    return RefinedDirections(direction, length / np.exp(np.log(length).mean()), moved, left, found.misfit)


def _closest(lights: np.ndarray, directions: np.ndarray, *, with_strength: bool) -> np.ndarray:
    """Return the lights times the 3×3 matrix that brings them closest to the given unit directions, robustly; `with_strength` their
    lengths come close to one too."""
    length, weight = np.linalg.norm(lights, axis=1, keepdims=True), np.ones((len(lights), 1))
    for _ in range(ROUNDS):
        matrix = np.linalg.lstsq(lights / length * weight, directions * weight, rcond=None)[0]
        turned = lights @ matrix
        norm = np.linalg.norm(turned, axis=1, keepdims=True)
        length = np.full_like(length, np.median(norm)) if with_strength else norm
        residual = np.linalg.norm(turned / norm - directions, axis=1)
        sigma = max(MAD_TO_SIGMA * float(np.median(residual)), LEAST_SIGMA)
        weight = 1 / np.sqrt(1 + (residual / (OUTLIER * sigma)) ** 2)[:, None]
    return lights @ matrix
