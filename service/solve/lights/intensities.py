"""Intensities of distant lights: those of the manifest, or those that the images ask for, whichever explains left-out pixels better.

Directions of lights are often known and their intensities not: RTI data declare none, and published ones are off by some per cent. The
images determine them, up to one factor. Those that one half of the object asks for are judged on the other half, by the spread of its
readings about a robust Lambertian fit.

The lights of a rig do not change between the steps of a sequence, and intensities that each step finds for itself would make its surface
flicker: the first step's are shared unless the images of a step contradict.

Sources: lights of unknown intensity and known directions, Cho, Matsushita, Tai and Kweon, "Semi-calibrated photometric stereo", TPAMI
2020; choice by left-out data, Stone, "Cross-validatory choice and assessment of statistical predictions", JRSS B 1974.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.model.samples import some_of
from kernels.photometric.search.light_factors import untold
from service.light_estimation.brightness_step import find_step
from service.light_estimation.explanations import grey_readings
from service.light_estimation.lambertian import LEAST_APART, Fit, fit_lambertian
from service.light_estimation.semi_calibrated import ROUND, fit_grey_intensities, told_by_relief
from service.light_estimation.steady_light import fit_steady_light
from service.solve.base.solution import SolveInput
from stage.capture.point_lights import DistantLights
from stage.errors import CalibrationError

PIXELS = 400
"""Pixels, spread over the object, from which the intensities are found."""
TRIAL_ROUNDS, ROUNDS = 20, 60
"""Most rounds for each half, which show whether other intensities explain anything, and for the whole object."""
SQUARES = 8
"""Number of squares along the longer side of the object; intensities found in one half of them must explain the other half."""
LEAST_LIGHTS = 8
"""Fewer lights leave too few readings to spare: intensities fit whatever the object is made of."""
LEAST_GAIN = 0.4
"""Least part of the cost of left-out pixels that other intensities must take away: where the declared ones are right, up to 0.3 goes on
real objects, which are not quite Lambertian; errors of 5 % take away 0.5 to 0.8, and 0.26 on a glossy object."""
LEAST_GAIN_APART = 0.2
"""Least part of the cost of pixels that face otherwise than most (`Fit.apart`) that goes: of balls before glossy planes with right
lights, none goes, while .4 to .8 of the cost of all pixels does."""
UNEXPLAINED_APART = "others do not explain what faces otherwise than most of the object"
TIMES_APART = 1.5
"""Most that they may leave of pixels that face otherwise than most, over what they leave of all: 1.1 on ten objects under wrong lights,
and 2 to 6 of a ball before a glossy wall."""
LARGEST_LEFT = 0.05
"""Largest misfit that other intensities may leave, relative to |b|: bare metal leaves more under any intensities."""
LARGEST_FALL = 0.1
"""Largest standard deviation of the part of the logarithms that follows the angle to the viewer which may be the object's reflectance:
rough dielectrics, which return light towards the lamp, ask for up to 0.05."""
FALL_DEGREE = 2
"""Degree of the polynomial of the cosine to the viewer that this part is taken for."""
LINEAR_GAIN = 0.8
"""Intensities without the part that the object tells only weakly are taken if they have this part of the gain of the others."""
SURE = 2.5
"""Least ratio to its standard error of that gain, over squares of pixels, and of the part that follows the angle to the viewer."""
NOISE = 0.02
"""Residual, relative to |b|, from which the cost of a reading grows only with its logarithm."""
LEAST_LIT = 5
"""Least count of lit readings of a pixel that is judged: three fit any intensities."""


class ChosenIntensities(NamedTuple):
    """Intensities of the lights after comparison with the images."""

    lights: DistantLights
    """The lights, with the intensities that explain the images better."""
    facts: dict[str, Any]
    """Facts for the report."""


def choose_intensities(given: SolveInput, lights: DistantLights) -> ChosenIntensities:
    """Return the lights with the declared intensities, or with those that the images ask for. Where all images from one on are brighter
    or darker, they ask for that first: two numbers, of which surfaces that are not Lambertian spoil little."""
    if len(lights.direction) < LEAST_LIGHTS:
        return _declared(lights, f"fewer than {LEAST_LIGHTS} lights")
    pixels = some_of(given.mask, PIXELS)
    radiance, usable = given.stack.pick_radiance(pixels)
    readings = grey_readings(radiance, lights.irradiance)
    declared = fit_lambertian(readings, usable, lights.direction)
    if fit_steady_light(readings, usable, lights.direction, lights.irradiance)[2]:
        return _declared(lights, "the images share light that is not that of their lamps")
    step = find_step(readings, usable, lights.direction, declared)
    if step is None:
        return _chosen(given, lights, pixels, readings, usable, declared)
    factors = step.factors(len(readings))
    stepped, readings = lights._replace(irradiance=lights.irradiance * factors[:, None]), readings / factors[:, None]
    chosen = _chosen(given, stepped, pixels, readings, usable, fit_lambertian(readings, usable, lights.direction))
    found = chosen.facts["light_intensities"]
    return ChosenIntensities(chosen.lights, {"light_intensities": {
        **found, "used": "estimated", "factors": (factors * np.array(found.get("factors", 1.0))).round(4).tolist(),
        "step": {"first": given.stack.frames[step.first], "factor": round(step.factor, 4)}}})


def _chosen(given: SolveInput, lights: DistantLights, pixels: np.ndarray, readings: np.ndarray, usable: np.ndarray,
            declared: Fit) -> ChosenIntensities:
    """Return the lights with the intensities that readings [lights, pixels] of some pixels ask for, or as they are. `declared`: the fit of
    these readings."""
    place = np.stack(np.divmod(pixels, given.mask.shape[1])).astype(np.float64)
    place -= place.min(axis=1, keepdims=True)
    row, col = np.floor(place * SQUARES / (place.max() + 1)).astype(int)
    half = (row + col) % 2 == 0
    square = row * SQUARES + col
    # of no change, of all that half the pixels ask for, and of what they can tell
    cost = np.zeros((3, len(pixels)))
    gain = 0.0
    apart = declared.apart
    judged_apart = apart.sum() >= LEAST_APART
    try:
        for fitted in (half, ~half):
            free, told = _factors(readings[:, fitted], usable[:, fitted], lights.direction, TRIAL_ROUNDS)
            for one, factor in zip(cost, (np.ones_like(free), free, told), strict=True):
                one[~fitted] = _cost(readings[:, ~fitted] / factor[:, None], usable[:, ~fitted], lights.direction)
            gains = 1 - cost[1:].sum(axis=1) / max(cost[0].sum(), 1e-12)
            chosen = 1 if gains[1] >= LINEAR_GAIN * gains[0] else 0
            gain = float(gains[chosen])
            less = np.bincount(square, weights=cost[0] - cost[1 + chosen])
            if gain < LEAST_GAIN or less.sum() < SURE * np.sqrt((less**2).sum()):
                return _declared(lights, "others explain left-out pixels hardly better", gain)
            if judged_apart and cost[1 + chosen, apart].sum() > (1 - LEAST_GAIN_APART) * cost[0, apart].sum():
                return _declared(lights, UNEXPLAINED_APART, gain)
        factor = _factors(readings, usable, lights.direction, ROUNDS)[chosen]
    except CalibrationError as error:
        return _declared(lights, str(error))
    estimated = fit_lambertian(readings / factor[:, None], usable, lights.direction)
    after = estimated.misfit()
    if not after <= LARGEST_LEFT:
        return _declared(lights, "no intensities explain the images by diffuse reflection", gain)
    if judged_apart and estimated.misfit(apart) > max(TIMES_APART * after, NOISE):
        return _declared(lights, UNEXPLAINED_APART, gain)
    if estimated.apart.mean() < ROUND and not told_by_relief(readings, usable, lights.direction, factor, estimated, declared):
        return _declared(lights, "most of the object faces one way, where highlights look like lights of other strengths", gain)
    facts = {"used": "estimated", "left_out_gain": round(gain, 4), "misfit_declared": round(declared.misfit(), 4),
             "misfit_estimated": round(after, 4), "spread": round(float(np.log(factor).std()), 4), "factors": factor.round(4).tolist()}
    return ChosenIntensities(lights._replace(irradiance=lights.irradiance * factor[:, None]), {"light_intensities": facts})


def lambertian_misfit(given: SolveInput, lights: DistantLights) -> float:
    """Return how far diffuse reflection under these lights is from the readings of pixels spread over the object."""
    radiance, usable = given.stack.pick_radiance(some_of(given.mask, PIXELS))
    return fit_lambertian(grey_readings(radiance, lights.irradiance), usable, lights.direction).misfit()


def _declared(lights: DistantLights, why: str, gain: float | None = None) -> ChosenIntensities:
    found = {} if gain is None else {"left_out_gain": round(gain, 4)}
    return ChosenIntensities(lights, {"light_intensities": {"used": "declared", "why": why, **found}})


def _factors(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, rounds: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [lights] intensities over the declared ones, of geometric mean 1; 1 for lights that too few pixels show.

    They are without a small part that follows the angle to the viewer, as diffuse reflection other than Lambert's asks for. The second
    are without the part that is linear in the direction, beyond what independent errors of the lights would have of it.
    """
    found = fit_grey_intensities(readings, usable, directions, rounds=rounds)
    seen = np.isfinite(found)
    free, told = np.ones(len(found)), np.ones(len(found))
    logarithm = np.log(found[seen])
    powers = np.vander(directions[seen, 2], FALL_DEGREE + 1)
    if len(powers) > powers.shape[1]:
        fall = powers @ np.linalg.lstsq(powers, logarithm)[0]
        independent = SURE * (logarithm - fall).std() * np.sqrt(FALL_DEGREE / (len(powers) - powers.shape[1]))  # errors of single lights
        if independent < fall.std() <= LARGEST_FALL:
            logarithm = logarithm - fall
    free[seen] = np.exp(logarithm - logarithm.mean())
    told[seen] = np.exp(logarithm - untold(logarithm, directions[seen], falling=False))
    return free, told


def _cost(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the cost of each pixel: mean over its lit readings of ln(1 + (residual / noise)²)."""
    fit = fit_lambertian(readings, usable, directions)
    count = fit.lit.sum(axis=0)
    total = np.where(fit.lit, np.log1p((fit.residual / NOISE) ** 2), 0).sum(axis=0)
    return np.where(count >= LEAST_LIT, total / np.maximum(count, 1), 0.0)


CONTRADICTED = 0.8
"""Misfit under a step's own intensities, over that under the shared ones, below which the step takes its own."""


class LightsOverTime:
    """The intensities of the first step, for those after it."""

    def __init__(self, *, shared: bool) -> None:
        """Share intensities if they are chosen at all; else every step has those of its manifest."""
        self._shared = shared
        self._first: dict[str, Any] | None = None
        self._albedo_scale: float | None = None

    def choose(self, given: SolveInput, lights: DistantLights) -> ChosenIntensities:
        """Return the lights of a step with the shared intensities, or its own where its images contradict them."""
        own = choose_intensities(given, lights)
        declared = {"direction": lights.direction.tolist(), "irradiance": lights.irradiance.tolist()}
        if self._first is None:
            factor = np.divide(own.lights.irradiance, lights.irradiance, out=np.ones_like(lights.irradiance), where=lights.irradiance > 0)
            self._first = declared | {"factor": factor.max(axis=1).tolist()}
            return own
        if any(declared[name] != self._first[name] for name in declared):
            return _said(own, "its own: the lights of the manifest are not those of the first step")
        factor = np.array(self._first["factor"])
        if (factor == 1).all() and own.lights is lights:
            return own
        common = lights._replace(irradiance=lights.irradiance * factor[:, None])
        if lambertian_misfit(given, own.lights) < CONTRADICTED * lambertian_misfit(given, common):
            return _said(own, "its own: the images contradict those of the first step")
        return ChosenIntensities(common, {"light_intensities": {"used": "those of the first step"}})

    def share_albedo_scale(self, own: float) -> float:
        """Return the factor of the albedo of the first step, which is a step's own where it is the first."""
        self._albedo_scale = own if self._albedo_scale is None else self._albedo_scale
        return self._albedo_scale

    def left(self) -> dict[str, Any]:
        """Return what a step leaves for those after it."""
        return {"lights": self._first, "albedo_scale": self._albedo_scale}

    def take(self, left: dict[str, Any]) -> None:
        """Take what a step has left, which was perhaps done before."""
        if self._first is None and isinstance(left.get("lights"), dict):
            self._first = left["lights"]
        if self._albedo_scale is None and isinstance(left.get("albedo_scale"), float):
            self._albedo_scale = left["albedo_scale"]

    def plain(self) -> Any:
        """Return what a step follows from beside its capture, as plain data."""
        return self._first if self._albedo_scale is None else {"lights": self._first, "albedo_scale": self._albedo_scale}


def _said(own: ChosenIntensities, why: str) -> ChosenIntensities:
    return own._replace(facts={"light_intensities": {**own.facts.get("light_intensities", {}), "over_time": why}})
