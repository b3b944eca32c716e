"""Distant lights that are declared wrongly in a way that few numbers mend: all of them stand near, or one is of another strength.

A light at distance d lights the near side of an object of extent s more by some 3 s / d, and from another direction. The normals of a fit
under distant lights take up a part of that, and the rest is left at every pixel. The declared directions are kept, and places along them
are tried, on a sphere about the object and on a plane in front of it, as domes and frames of lamps have them: one number is free. One
light of another strength is found by the readings that the others predict, also where they are too few to measure the strength of every
light.
"""

from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from kernels.photometric.lambertian.near import NearField
from kernels.photometric.lambertian.readings import pad_lights
from kernels.photometric.model.samples import evenly
from service.light_estimation.explanations import grey_readings
from service.light_estimation.lambertian import SHADOW, SIDE, degrees_between, median_of, normal_equations, unlike_most
from service.solve.base.batches import pick_pixels, view_directions
from service.solve.base.solution import SolveInput, at_all_pixels
from service.solve.height.distance import SQUARES, SURE, Lamps, NearFit, cost_of, fit_near
from service.solve.height.height import mean_height
from service.solve.methods.near import field_on
from stage.capture.point_lights import DistantLights, PlacedLights

TRIED_PIXELS = 600
"""Pixels, spread over the object, that are compared."""
DISTANCES = tuple(np.geomspace(0.8, 50, 19).tolist())
"""Distances from the middle of the object that are tried, in its half widths, 26 % apart."""
EVERY, PRECISE = 3, 0.02
"""Every so many of these distances is tried first; then those on both sides of the best one are, and distances between to this part."""
LEAST_LIGHTS, LEAST_LIT = 5, 5
"""Least count of lights, and of lit readings of a pixel that is compared: two to spare."""
LEAST_PIXELS = 60
LEAST_SLANT = 0.2
"""Least z of a direction to a lamp on a plane in front of the object."""
LEAST_GAIN, LEAST_GAIN_NEAR, LEAST_GAIN_RIG = 0.3, 0.1, 0.06
"""Least part of the cost that a light of another strength takes away, lights that stand near, and those of a rig: the right strength takes
0.5 to 0.99; lights within 8 half widths 0.14 of a glossy object, and 0.7 to 0.9 of matt ones; those of a real rig at 15 half widths 0.08.
Where distant ones are right, near ones take 0.05 in one of 290 path-traced scenes and parts of them, and less in the others."""
NEAR = 8.0
"""Half widths below which more gain is asked: of bare metal, lights as near explain more than it is."""
SURE_NEAR = 2.0
"""Least ratio of the gain of near lights to its standard error over squares of pixels."""
LEAST_LOBES_GAIN, CLOSE, LEAST_LOBES_GAIN_CLOSE = 0.1, 1.5, 0.3
"""Part of the cost of lobes of one shape that near lights take away, too: 0.15 to 0.95 where lights are near; gloss of round objects under
distant ones, which Lambert's law takes for the falloff of near ones, costs 1.05 to 70 times as much (200 domes of five to 96 lights). Of
bare rough metal under few lights they take 0.2 with lights within so many half widths."""
UNSURE = 0.015
"""Standard error of the inverse of a distance in half widths: of seven path-traced scenes with bounced light and gloss it is off by up to
0.02, and as much of a real object, whose readings fit best at 16 half widths and its normals at 23."""
EXPLAINED = 2.5
"""Largest cost of half of the pixels under other lights, that of a residual of three times the noise: on bare metal, which no
Lambertian fit explains, it is 3.2 and more, and near lights then take up to a quarter away of what they do not explain; on glossy objects
at most 2."""
FACING = 0.05
"""Least z of a normal from which the search for lobes begins."""
LEAST_FACTOR = 1.2
"""Least factor of the strength of one light: less turns normals by a few degrees."""
ROUND, ALIKE = 0.5, 0.67
"""Part of the pixels that face otherwise than most below which a highlight of a side may pass for a stronger light, and metal for a weaker
one: of right captures of six lights, ten of sixty path-traced ones do, of stairs and gears with a part of 0.17 to 0.43. Where it is larger,
what faces otherwise must ask for this part of the logarithm of the strength, at least: 0.95 and more where it is wrong, and of metal 3."""
STRENGTH_ROUNDS = 4
"""Fits with the strength of one light, each found from the one before."""
MOST_STRENGTHS = 4
"""The most lights whose strength is fitted: those of which the readings are farthest from what the other lights predict."""
MOST_LEVERAGE = 0.9
"""A reading with more leverage is not predicted by the others."""


class OtherLights(NamedTuple):
    """Lights that explain the readings much better than those that are declared."""

    sentence: str | None
    """What is wrong with the declared ones; None: Lambert's law alone says so, and lobes do not."""
    gain: float
    """The part of the cost of the readings that they take away."""
    degrees: np.ndarray  # [pixels of the image] float32, angle between the normals under these and under the declared; 0 outside the mask
    rig: "Rig | None" = None
    """All lights where they stand; None: one is of another strength."""


class Rig(NamedTuple):
    """The lights of a rig that is declared distant, at the distance from the object that its readings show."""

    lights: PlacedLights
    """In the unit of the camera's points."""
    half_widths: float
    """Median distance, in half widths of the object."""
    gain: float
    """As of `OtherLights`."""
    degrees: np.ndarray  # [pixels of the image] float32, standard error of the normals for that of the distance

    @property
    def sentence(self) -> str:
        """What the solve did, for its report."""
        return (f"frames[].light.type: the lights look near, {self.half_widths:.2g} half widths of the object away, and distant ones are "
                f"declared: the solve has taken them there, where the readings cost {100 * self.gain:.0f} % less; declare point lights "
                "(relit calibrate light-positions measures them)")

    def facts(self) -> dict[str, Any]:
        """Return what the report says about it."""
        return {"light_distance": {"half_widths": round(self.half_widths, 2), "gain": round(self.gain, 4)}}


class _Sample(NamedTuple):
    readings: np.ndarray  # [lights, pixels] float64, radiance over irradiance
    usable: np.ndarray  # [lights, pixels] bool
    points: np.ndarray  # [pixels, 3] from the middle of the object, in its half widths


class _Trial(NamedTuple):
    fit: NearFit
    sentence: str
    least_gain: float = LEAST_GAIN
    ways: np.ndarray | None = None  # [lights, 3] from the middle of the object to each, half widths; None: they are distant


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
    sure = SURE if best.ways is None else SURE_NEAR
    if gain < best.least_gain or less.sum() < sure * np.sqrt((less**2).sum()):
        return None
    pixels = np.flatnonzero(given.mask)[chosen][told]
    turned = degrees_between(far.normal, best.fit.normal)
    degrees = at_all_pixels(given.mask, pixels, turned)
    rig = None
    if best.ways is not None:
        placed, median = _placed(given, lights, best.ways)
        asked = LEAST_LOBES_GAIN_CLOSE if median < CLOSE else LEAST_LOBES_GAIN
        if _lobes_gain(given, lights, placed, pixels, far, best.fit) < asked:
            return OtherLights(None, gain, degrees)
        rig = Rig(placed, median, gain, (UNSURE * median * degrees).astype(np.float32))
    return OtherLights(f"{best.sentence}; the readings then cost {100 * gain:.0f} % less", gain, degrees, rig)


def _placed(given: SolveInput, lights: DistantLights, ways: np.ndarray) -> tuple[PlacedLights, float]:
    """Return lights that stand so, [lights, 3] half widths from the middle of the object, and their median distance in these."""
    distance = np.linalg.norm(ways, axis=1, keepdims=True)
    points = given.camera.points(_plane(given))[given.mask].astype(np.float64)
    half, centre = np.ptp(points[:, :2], axis=0).max() / 2, points.mean(axis=0)
    place = np.concatenate([centre + half * ways, np.ones((len(ways), 1))], axis=1)
    return (PlacedLights.about(centre, place, lights.irradiance * (half * distance) ** 2, np.zeros((len(ways), 4))),
            float(np.median(distance)))


def _plane(given: SolveInput) -> np.ndarray:
    """Return the height of a plane in the place of the object, [rows, cols]."""
    return np.full(given.mask.shape, mean_height(given.camera), np.float32)


def _lobes_gain(given: SolveInput, lights: DistantLights, placed: PlacedLights, pixels: np.ndarray, far: NearFit, near: NearFit) -> float:
    """Return the part of the cost of lobes that near lights take away. `pixels`: [n] positions, of which `far` and `near` are fits."""
    from kernels.photometric.search.lobe_shape import choose_lobe_shape  # for few captures: their import takes a tenth of a second
    from service.solve.methods.kinds import LOBE_PIXELS

    some, view = evenly(len(pixels), LOBE_PIXELS), view_directions(given.camera)
    field = field_on(given, placed, _plane(given))

    def cost(direction: np.ndarray, strength: np.ndarray, fit: NearFit, field: NearField | None) -> float:
        start = fit.normal[:, some].T.astype(np.float32)
        start[:, 2] = np.maximum(start[:, 2], FACING)
        start /= np.linalg.norm(start, axis=1, keepdims=True)
        samples = pick_pixels(given, pad_lights(direction, strength, given.stack.scale), view, pixels[some], field)
        return min(choose_lobe_shape(samples, start).tried.values())

    distant = cost(lights.direction, lights.irradiance, far, None)
    return 1 - cost(placed.direction, placed.strength, near, field) / max(distant, 1e-12)


def _near(sample: _Sample, directions: np.ndarray) -> Iterator[_Trial]:
    """Yield the best fit of lights on a sphere about the object, and of lights on a plane in front of it.

    One at the nearest distance that is tried is none: something else than a distance makes up for what the model lacks. The farthest is as
    good as infinite.
    """
    ways = [directions]
    if (directions[:, 2] > LEAST_SLANT).all():
        ways.append(directions / directions[:, 2:])
    for way in ways:
        distance = _best_distance(sample, way)
        if distance is None:
            continue
        median = distance * float(np.median(np.linalg.norm(way, axis=1)))
        yield _Trial(_fit_at(sample, distance * way), (
            f"frames[].light.type: the lights look near, {median:.2g} half widths of the object away, and distant ones are declared: "
            "their light falls off over the image; declare point lights (relit calibrate light-positions measures them)"),
            LEAST_GAIN_NEAR if median < NEAR else LEAST_GAIN_RIG, distance * way)


def _best_distance(sample: _Sample, way: np.ndarray) -> float | None:
    """Return the distance at which lights that stand along `way` explain the readings best; None: an end of those that are tried does."""
    @cache
    def cost_at(logarithm: float) -> float:
        return float(_cost(_fit_at(sample, np.exp(logarithm) * way)).sum())

    tried = np.log(DISTANCES).tolist()
    coarse = min(range(0, len(tried), EVERY), key=lambda number: cost_at(tried[number]))
    best = min(range(max(coarse - EVERY + 1, 0), min(coarse + EVERY, len(tried))), key=lambda number: cost_at(tried[number]))
    if best in (0, len(tried) - 1):
        return None
    found = minimize_scalar(cost_at, bounds=(tried[best - 1], tried[best + 1]), method="bounded", options={"xatol": PRECISE})
    return float(np.exp(found.x))


def _fit_at(sample: _Sample, ways: np.ndarray) -> NearFit:
    """Fit normals under near lights, [lights, 3] from the middle of the object, half widths."""
    return _fit(sample, np.concatenate([ways, np.ones((len(ways), 1))], axis=1))


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
            if max(factor, 1 / factor) < LEAST_FACTOR:
                continue
            apart = unlike_most(fit.normal, SIDE)
            told = float(np.median(ratio[apart[seen]])) if apart[seen].any() else 0.0
            sentence = f"frames[].light.irradiance: {image} looks {factor:.2g} times as bright as declared beside the others"
            if apart.mean() < ROUND:
                yield _Trial(fit, f"{sentence}, or most of the object, which faces one way, has a highlight there; sigma holds either; "
                                  "check its irradiance and exposure_s")
            elif told > 0 and ALIKE <= np.log(told) / np.log(factor) <= 1 / ALIKE:
                yield _Trial(fit, f"{sentence}; check its irradiance and exposure_s, or leave it out")


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
