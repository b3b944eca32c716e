"""Distant lights whose directions are known roughly, refined by the images of the object before it is solved."""

from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.model.samples import evenly
from service.light_estimation.explanations import grey_readings
from service.light_estimation.refined_directions import refine_directions
from service.solve.sharing.solution import SolveInput
from stage.capture.point_lights import DistantLights
from stage.errors import CalibrationError

PIXELS = 1000
"""Pixels, spread over the object, from which the directions are refined."""
GROSS_TIMES, GROSS_DEGREES = 4.0, 3.0
"""A light is named that moved by more than this many times the median, and by more than this angle."""


class RefinedLights(NamedTuple):
    """The lights that explain the images, closest to those of the manifest."""

    lights: DistantLights
    left_degrees: float
    facts: dict[str, Any]
    """Facts for the report."""
    warnings: tuple[str, ...]

    def doubt(self, normal: np.ndarray) -> np.ndarray:
        """Return the standard error of normals for what all directions have wrong together, [pixels] degrees.

        Args:
            normal: [3, pixels] unit.
        """
        return np.full(normal.shape[1], self.left_degrees)


def refine_lights(given: SolveInput, lights: DistantLights) -> RefinedLights:
    """Refine the directions of the lights of a capture.

    Args:
        given: the images; where it keeps the declared intensities, only the directions change.

    Raises:
        CalibrationError: the images do not determine the directions.
    """
    inside = np.flatnonzero(given.mask)
    radiance, usable = given.stack.pick_radiance(inside[evenly(len(inside), PIXELS)])
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
