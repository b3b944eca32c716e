"""Whether all images from one on are brighter or darker by one factor: exposure, gain or lamps that changed while the capture was taken.

The brightness that the images ask for (service.light_estimation.semi_calibrated) then has a step in their order, beside a smooth part that
follows the angle to the viewer, as surfaces ask for that are not Lambertian. A step has two numbers, where a brightness of its
own has one for each light: so surfaces that are not Lambertian, which ask for wrong lights too, spoil it little.
"""

from typing import NamedTuple

import numpy as np

from service.light_estimation.lambertian import SHADOW, Fit, fit_lambertian, median_of
from service.light_estimation.semi_calibrated import TINY, fit_grey_intensities
from stage.errors import CalibrationError

MIN_LIGHTS = 8
"""Fewer lights leave nothing beside a step and a smooth part."""
LEAST_LIGHTS, LEAST_PART = 3, 8
"""Least count of images before and after a step, and the part of all, one in so many: fewer are single lights."""
FALL_DEGREE = 2
"""Degree of the polynomial of the cosine to the viewer that is no step."""
LEAST_STEP, TIMES, LARGEST_LEFT = 0.15, 5.0, 0.1
"""Least step of the logarithm of the brightness, how many times the standard deviation of what it leaves that is, and the most that it may
leave. Of 131 right captures of matt, glossy and metal objects, each in three orders of its lights, none has one; of these with half of the
images, or the last quarter, at half the brightness 75 %, and 95 % of the places are right."""
MOST_WORSE = 1.1
"""The most that the readings may be off with a step, over what they are without it. Brightness of glossy planes follows the rings of a
dome, and such a step, taken out, leaves 1.4 to 10 times as much; of 48 true steps 1.03 at most, but for one at a wrong place (1.3)."""
LEAST_OFF = 0.1
"""A step is looked for where a light reads otherwise by this part than a fit under the declared ones says."""


class BrightnessStep(NamedTuple):
    """A change of brightness between two images."""

    first: int
    """The first image after it."""
    factor: float
    """How bright that one and those after it are, beside what they would be without it."""

    def factors(self, count: int) -> np.ndarray:
        """Return the brightness of `count` lights over the declared one, of geometric mean 1, [count]."""
        step = np.where(np.arange(count) < self.first, 0.0, np.log(self.factor))
        return np.exp(step - step.mean())


def find_step(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, fit: Fit) -> BrightnessStep | None:
    """Return the step of brightness that readings ask for, or None.

    Args:
        readings: [lights, pixels] radiance over irradiance, in the order in which the images were taken.
        usable: [lights, pixels] bool, True for unsaturated readings.
        directions: [lights, 3] unit vectors to the lights.
        fit: the Lambertian fit of these readings.
    """
    if len(readings) < MIN_LIGHTS:
        return None
    model = directions @ fit.vector
    seen = fit.lit & (model > SHADOW * np.linalg.norm(fit.vector, axis=0))
    off = median_of((readings / np.where(seen, np.maximum(model, TINY), 1)).T, seen.T)
    if np.abs(off[seen.any(axis=1)] - 1).max(initial=0) < LEAST_OFF:
        return None
    try:
        brightness = fit_grey_intensities(readings, usable, directions)
    except CalibrationError:
        return None
    told = np.flatnonzero(np.isfinite(brightness))
    count, least = len(told), max(LEAST_LIGHTS, len(told) // LEAST_PART)
    if count < MIN_LIGHTS:
        return None
    logarithm, powers = np.log(brightness[told]), np.vander(directions[told, 2], FALL_DEGREE + 1)
    best, left = None, np.inf
    for first in range(least, count - least + 1):
        model = np.column_stack([powers, np.arange(count) >= first])
        found = np.linalg.lstsq(model, logarithm)[0]
        spread = float(np.sqrt(((logarithm - model @ found) ** 2).sum() / (count - model.shape[1])))
        if spread < left:
            best, left = (first, float(found[-1])), spread
    if best is None or left > LARGEST_LEFT or abs(best[1]) < max(LEAST_STEP, TIMES * left):
        return None
    step = BrightnessStep(int(told[best[0]]), float(np.exp(best[1])))
    without = fit_lambertian(readings / step.factors(len(readings))[:, None], usable, directions)
    return step if without.misfit() <= MOST_WORSE * fit.misfit() else None
