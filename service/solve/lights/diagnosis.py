"""Faults of the manifest of a capture, found from what was solved with it: encoding, brightness, order and axes of the lights.

A wrong manifest seldom stops a solver: it finds normals that are wrong everywhere, and as sure as right ones. Every finding here is a
sentence that names the field, and raises the standard error of every normal by the angle that the finding asks for.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.lambertian.readings import pad_lights
from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED
from service.light_estimation.declared_lights import explanation_sentence, sample_of, sampled
from service.light_estimation.explanations import Cause, Sample, better_explanation, fit_manifest, grey_readings
from service.light_estimation.lambertian import SHADOW, degrees_between, median_of, normal_equations
from service.light_estimation.light_axes import LightAxes
from service.solve.base.solution import PIXELS_AT_ONCE, Solution, SolveInput, at_all_pixels, raise_error, suspect_lights
from service.solve.height.distance import SQUARES, SURE, Lamps, NearFit, cost_of, fit_near
from service.solve.lights.adapted import find_adapted
from service.solve.lights.intensities import LEAST_GAIN as LEAST_ASKED
from service.solve.lights.orientation import find_axes, find_inversion
from service.solve.lights.placement import find_placement
from service.solve.lights.turn import find_turn
from stage.capture.capture import Capture
from stage.capture.gradients import GradientFrames
from stage.capture.lighting import ExtendedLights
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.colour.colour_spaces import is_linear

TRIED_PIXELS = 600
"""Pixels, spread over the object, that are compared."""
DISTANCES = tuple(np.geomspace(0.8, 16, 14).tolist())
"""Distances from the middle of the object that are tried, in its half widths, 26 % apart."""
EVERY = 3
"""Every so many of these distances is tried first; then those on both sides of the best one are."""
LEAST_LIGHTS, LEAST_LIT = 5, 5
"""Least count of lights, and of lit readings of a pixel that is compared: two to spare."""
LEAST_PIXELS = 60
LEAST_SLANT = 0.2
"""Least z of a direction to a lamp on a plane in front of the object."""
LEAST_GAIN, LEAST_GAIN_NEAR, NEAR = 0.3, 0.1, 8.0
"""Least part of the cost that other lights take away: where the declared ones are right, at most 0.02 goes in scenes, of bare metal, and
0.05 of real objects; lights within so many half widths take 0.14 away of a glossy object, and 0.7 to 0.9 of matt ones, and the right
strength 0.5 to 0.99. The lights of a real rig 12 to 16 half widths away, which is far enough, take 0.08 to 0.15."""
EXPLAINED = 2.5
"""Largest cost of half of the pixels under other lights, that of a residual of three times the noise: on bare metal, which no
Lambertian fit explains, it is 3.2 and more, and near lights then take up to a quarter away of what they do not explain; on glossy objects
at most 2."""
LEAST_FACTOR = 1.2
"""Least factor of the strength of one light: less turns normals by a few degrees."""
STRENGTH_ROUNDS = 4
"""Fits with the strength of one light, each found from the one before."""
MOST_STRENGTHS = 4
"""The most lights whose strength is fitted: those of which the readings are farthest from what the other lights predict."""
MOST_LEVERAGE = 0.9
"""A reading with more leverage is not predicted by the others."""


class OtherLights(NamedTuple):
    """Lights that explain the readings much better than those that are declared."""

    sentence: str
    gain: float
    """The part of the cost of the readings that they take away."""
    degrees: np.ndarray  # [pixels of the image] float32, angle between the normals under these and under the declared; 0 outside the mask


class _Sample(NamedTuple):
    readings: np.ndarray  # [lights, pixels] float64, radiance over irradiance
    usable: np.ndarray  # [lights, pixels] bool
    points: np.ndarray  # [pixels, 3] from the middle of the object, in its half widths


class _Trial(NamedTuple):
    fit: NearFit
    sentence: str
    least_gain: float = LEAST_GAIN


UNORDERED = (Cause.REVERSED, Cause.TEXT, Cause.SHIFTED, Cause.DIRECTIONS)
"""Causes after which the normals say nothing about the axes."""
REPAIRED = "; the solve has used the brightness that the images ask for (found.light_intensities)"
FIELDS = {DistantLights: "frames[].light.direction", PlacedLights: "frames[].light.position_m",
          ExtendedLights: "frames[].light.directions", GradientFrames: "frames[].light.axis and sign"}
"""The field that holds the axes of each kind of lights; else they come from the reference ball."""


def diagnose(given: SolveInput, capture: Capture, lights: Any, declared: Any, solution: Solution) -> None:
    """Add a warning for everything that is wrong with the lights or the encoding, and make the normals less sure by it.
    `lights`: the lights with which the normals were solved; readings are examined under distant ones. `declared`: the lights of the
    manifest, which may have other intensities."""
    field = FIELDS.get(type(lights), "the capture of the reference ball")
    fit = other = None
    if isinstance(lights, DistantLights):
        assert isinstance(declared, DistantLights)
        solution.suspects = suspect_lights(solution, given.stack, pad_lights(declared.direction, declared.irradiance, given.stack.scale))
        sample = sample_of(given.stack, capture, declared, given.mask)
        fit = fit_manifest(sample)
        found = better_explanation(sample, fit)
        estimated = lights is not declared
        if found is not None:
            repaired = estimated and found.cause in (Cause.IRRADIANCE, Cause.STEP, Cause.NORMALISED)
            solution.warnings.append(explanation_sentence(found, sample) + (REPAIRED if repaired else ""))
            if found.normal is not None:
                _raise_to(given, solution, found.normal)
            elif not repaired:
                raise_error(solution, found.degrees)
            if found.cause in UNORDERED:
                return
        asked = estimated or solution.facts.get("light_intensities", {}).get("left_out_gain", 0.0) >= LEAST_ASKED
        if asked and not is_linear(capture.manifest.color_space):
            _hold_adapted(given, sample, solution)
        other = find_other_lights(given, lights) if found is None or found.cause in (Cause.IRRADIANCE, Cause.STEP) else None
        if other is not None:
            solution.warnings.append(other.sentence)
            raise_error(solution, other.degrees)
        if estimated:
            fit = fit_manifest(sample._replace(irradiance=lights.irradiance))
    moved = find_placement(given, lights) if isinstance(lights, PlacedLights) else None
    if moved is not None:
        solution.warnings.append(moved.sentence)
        solution.facts["light_placement"] = moved.facts
        raise_error(solution, moved.degrees)
    axes = find_axes(given, solution, lights if isinstance(lights, DistantLights) else None, fit)
    if axes is None:
        axes = find_inversion(given, solution, lights if isinstance(lights, DistantLights) else None)
    if axes is not None:
        solution.warnings.append(f"{field}: {axes.sentence}")
        if axes.degrees is not None:
            raise_error(solution, axes.degrees)
        elif axes.matrices:
            raise_error(solution, _turned_by(solution.normal, axes))
        return
    if isinstance(lights, DistantLights | PlacedLights) and other is None and moved is None:
        turn = find_turn(given, lights, solution)
        if turn is not None:
            solution.warnings.append(
                f"{field}: all lights look turned {turn.words()}: turned back, slopes or highlights fit what the images show; check that "
                "the camera looks along the axis of the table, and that no light of the room is in the images, or take them as found "
                "(--lights refined); sigma holds the error that this makes")
            solution.facts["light_turn"] = turn.facts()
            raise_error(solution, turn.error(solution.normal))


def _hold_adapted(given: SolveInput, sample: Sample, solution: Solution) -> None:
    """Make normals less sure by what they would be if the images were adapted in brightness from place to place."""
    adapted = find_adapted(sample, np.stack(np.divmod(sampled(given.mask), given.mask.shape[1]), axis=1))
    if adapted is None:
        return
    turned = _raise_to(given, solution, adapted.fit.normal)
    solution.warnings.append("images: they may be adapted in brightness from place to place, as by HDR or local contrast of a phone, in "
                             f"place of lights of other strengths, which turns normals by {turned:.2g}°: give images without; "
                             "sigma holds that")


def _raise_to(given: SolveInput, solution: Solution, normal: np.ndarray) -> float:
    """Add to σ how far normals are from what they may be, [3, pixels] at those of the sample, and return the median of these angles."""
    chosen = sampled(given.mask)
    told = np.isin(solution.status[chosen], ESTIMATED)
    if not told.any():
        return 0.0
    turned = degrees_between(solution.normal[:, chosen], normal)[told]
    raise_error(solution, at_all_pixels(given.mask, chosen[told], turned))
    return float(np.median(turned))


def _turned_by(normal: np.ndarray, axes: LightAxes) -> np.ndarray:
    """Return the angle between each normal and its correction, degrees; of two possible corrections the root mean square."""
    squares = np.zeros(normal.shape[1], dtype=np.float32)
    for first in range(0, len(squares), PIXELS_AT_ONCE):
        part = normal[:, first : first + PIXELS_AT_ONCE]
        for matrix in axes.matrices:
            cosine = np.clip((part * (matrix.astype(np.float32) @ part)).sum(axis=0), -1, 1)
            squares[first : first + PIXELS_AT_ONCE] += np.degrees(np.arccos(cosine)) ** 2 / len(axes.matrices)
    return np.sqrt(squares)


# Tell distant lights that are declared wrongly in a way that few numbers mend: all of them stand near, or one is of another strength.
#
# A light at distance d lights the near side of an object of extent s more by some 3 s / d, and from another direction. The normals of a fit
# under distant lights take up a part of that, and the rest is left at every pixel. The declared directions are kept, and places along them
# are tried, on a sphere about the object and on a plane in front of it, as domes and frames of lamps have them: one number is free. One
# light of another strength is found by the readings that the others predict, also where they are too few to measure the strength of every
# light.

def find_other_lights(given: SolveInput, lights: DistantLights) -> OtherLights | None:
    """Return lights that explain the images much better than these, or None where nothing speaks against them."""
    row, col = np.nonzero(given.mask)
    if len(lights.direction) < LEAST_LIGHTS or len(row) < LEAST_PIXELS:
        return None
    half = max(float(np.ptp(row)), float(np.ptp(col)), 1.0) / 2
    place = np.stack([col - col.mean(), row.mean() - row], axis=1) / half
    chosen = evenly(len(row), TRIED_PIXELS)
    radiance, usable = given.stack.pick_radiance(np.flatnonzero(given.mask)[chosen])
    readings = grey_readings(radiance, lights.irradiance)
    told = (usable & (readings > 0)).sum(axis=0) >= LEAST_LIT
    if told.sum() < LEAST_PIXELS:
        return None
    at = place[chosen][told]
    sample = _Sample(readings[:, told], usable[:, told], np.concatenate([at, np.zeros((len(at), 1))], axis=1))
    far = _fit(sample, _at_infinity(lights.direction))
    cost, least = _cost(far), np.inf
    best: _Trial | None = None
    for trial in (*_near(sample, lights.direction), *_one_strength(sample, lights.direction, far, given.stack.frames)):
        if (total := float(_cost(trial.fit).sum())) < least:
            best, least = trial, total
    if best is None or np.median(_cost(best.fit)) > EXPLAINED:
        return None
    gain = 1 - least / max(float(cost.sum()), 1e-12)
    square = np.clip((at + 1) * SQUARES / 2, 0, SQUARES - 1).astype(int)
    less = np.bincount(square[:, 0] * SQUARES + square[:, 1], weights=cost - _cost(best.fit))
    if gain < best.least_gain or less.sum() < SURE * np.sqrt((less**2).sum()):
        return None
    turned = degrees_between(far.normal, best.fit.normal)
    degrees = at_all_pixels(given.mask, np.flatnonzero(given.mask)[chosen][told], turned)
    return OtherLights(f"{best.sentence}; the readings then cost {100 * gain:.0f} % less", gain, degrees)


def _near(sample: _Sample, directions: np.ndarray) -> Iterator[_Trial]:
    """Yield the best fit of lights on a sphere about the object, and of lights on a plane in front of it.

    One at the nearest distance that is tried is none: something else than a distance makes up for what the model lacks.
    """
    ways = [directions]
    if (directions[:, 2] > LEAST_SLANT).all():
        ways.append(directions / directions[:, 2:])
    for way in ways:
        best, fit = _best_distance(sample, way)
        if best == 0:
            continue
        median = DISTANCES[best] * float(np.median(np.linalg.norm(way, axis=1)))
        yield _Trial(fit, (
            f"frames[].light.type: the lights look near, {median:.2g} half widths of the object away, and distant ones are declared: "
            "their light falls off over the image; declare point lights (relit calibrate light-positions measures them)"),
            LEAST_GAIN_NEAR if median < NEAR else LEAST_GAIN)


def _best_distance(sample: _Sample, way: np.ndarray) -> tuple[int, NearFit]:
    """Return the number of the distance at which lights that stand along `way` explain the readings best, and their fit."""
    @cache
    def fit_at(number: int) -> NearFit:
        return _fit(sample, np.concatenate([DISTANCES[number] * way, np.ones((len(way), 1))], axis=1))

    def cost_at(number: int) -> float:
        return float(_cost(fit_at(number)).sum())

    coarse = min(range(0, len(DISTANCES), EVERY), key=cost_at)
    best = min(range(max(coarse - EVERY + 1, 0), min(coarse + EVERY, len(DISTANCES))), key=cost_at)
    return best, fit_at(best)


def _one_strength(sample: _Sample, directions: np.ndarray, start: NearFit, images: tuple[str, ...]) -> Iterator[_Trial]:
    """Yield a fit for each light that stands out among the others, with the strength that the readings ask for."""
    place = _at_infinity(directions)
    off = np.abs(np.log(_left_out(sample, directions, start.lit)))
    for light in np.argsort(-off)[:MOST_STRENGTHS]:
        image, factor = images[light], 1.0
        for number in range(STRENGTH_ROUNDS):
            # without this light first: the others say what it should be
            readings, usable = sample.readings.copy(), sample.usable
            readings[light] /= factor
            if number == 0:
                usable = usable.copy()
                usable[light] = False
            fit = _fit(sample._replace(readings=readings, usable=usable), place)
            cosine = directions[light] @ fit.normal
            others = np.delete(np.arange(len(directions)), light)
            level = median_of(readings[others] / np.maximum(directions[others] @ fit.normal, SHADOW), fit.lit[others])
            seen = sample.usable[light] & (cosine > SHADOW) & (level > 0)
            ratio = sample.readings[light, seen] / (cosine * level)[seen]
            if len(ratio) < LEAST_PIXELS or not (factor := float(np.median(ratio))) > 0:
                break
        else:
            if max(factor, 1 / factor) >= LEAST_FACTOR:
                yield _Trial(fit, f"frames[].light.irradiance: {image} looks {factor:.2g} times as bright as declared beside the others; "
                                  "check its irradiance and exposure_s, or leave it out")


def _left_out(sample: _Sample, directions: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return by which factor each light [lights] reads more than the other lights predict by least squares; 1 where nothing tells."""
    inverse = np.linalg.pinv(normal_equations(lit.astype(np.float64), directions), rcond=1e-6, hermitian=True)
    vector = np.einsum("pab,lb,lp->pa", inverse, directions, np.where(lit, sample.readings, 0))
    leverage = np.einsum("la,pab,lb->lp", directions, inverse, directions)
    # the prediction without a reading, by its leverage: Cook and Weisberg, Residuals and Influence in Regression, 1982, equation 2.2.9
    predicted = (directions @ vector.T - leverage * sample.readings) / np.maximum(1 - leverage, 1e-6)
    found = np.ones(len(directions))
    for light, told in enumerate(lit & (predicted > 0) & (leverage < MOST_LEVERAGE)):
        if told.sum() >= LEAST_PIXELS:
            found[light] = np.median(sample.readings[light, told] / predicted[light, told])
    return found


def _at_infinity(directions: np.ndarray) -> np.ndarray:
    return np.concatenate([directions, np.zeros((len(directions), 1))], axis=1)


def _fit(sample: _Sample, place: np.ndarray) -> NearFit:
    """Fit normals under lights at these places, each as strong at the middle of the object as a distant one."""
    strength = np.where(place[:, 3] == 1, (place[:, :3] ** 2).sum(axis=1), 1.0)
    return fit_near(sample.readings, sample.usable, Lamps(place, strength, np.zeros((len(place), 4))), sample.points)


def _cost(fit: NearFit) -> np.ndarray:
    """Return the cost of each pixel; one that too few lights light has none."""
    return cost_of(fit, least_lit=LEAST_LIT, unlit=0.0)
