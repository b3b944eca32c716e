"""Test whether another reading of the manifest explains the images much better than the manifest: encoding, brightness, order of lights.

Every explanation is judged by the same robust Lambertian fit of the same pixels. On a right manifest no explanation is better by more
than a factor of 1.9 (all objects of docs/checks.md but bare metal, for which no explanation is good: those must also leave little).
The wrong manifests leave three to a hundred times more than the right explanation does.
"""

from enum import Enum
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from service.light_estimation.brightness_step import BrightnessStep, find_step
from service.light_estimation.grey_ball import other_readings
from service.light_estimation.lambertian import (
    LEAST_APART,
    PLANE,
    SHADOW,
    Fit,
    bright_readings,
    degrees_between,
    fit_lambertian,
    least_squares,
    median_of,
    unlike_most,
)
from service.light_estimation.neighbours import IN_ORDER, MIN_LIGHTS_SMOOTH, SMOOTH, in_order
from service.light_estimation.other_directions import from_ball_normals, from_other_elevations
from service.light_estimation.semi_calibrated import ROUND, TINY, fit_intensities, flat_in_frontal_light, told_by_relief
from service.light_estimation.steady_light import fit_steady_light
from stage.colour.colour import GREY_WEIGHTS
from stage.colour.colour_spaces import is_linear
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

PIXELS = 600
"""Number of pixels, spread over the object, on which explanations are compared: three times as many change no misfit by a tenth."""
MIN_LIGHTS = 6
"""Least count of lights that contradict a manifest: three readings of a pixel always fit."""
MIN_LIGHTS_SCALED, MIN_LIGHTS_FREE = 8, 12
"""Least count of lights where their brightness, and where their directions are free: bare metal under six lights of free brightness, or
ten of free directions, fits too well."""
MIN_LIGHTS_LATE, LATE_EVERY, LATE_STEPS = 10, 4, 16
"""Fewer lights than the first are not asked from which image on they are one image off: those of a metal cube under eight fitted elsewhere.
The place is sought by one of LATE_EVERY pixels, first among LATE_STEPS places."""
MIN_READINGS_FREE = 7
"""Least count of lit readings of a pixel that is judged under free directions, twice its three unknowns and one."""
MIN_PIXELS = 60
"""Least count of pixels with more readings than unknowns; they are also the least part, a quarter, of the pixels that were given."""
MIN_PART = 0.25
"""The part of the pixels that must have readings to spare, for the misfit to speak for the object."""
TIMES = 2.5
"""An encoding or another order is named if it leaves this many times less: it has no free parameter."""
TIMES_FREE = 3.0
"""Explanations with free parameters are named if they leave this many times less."""
LARGEST_LEFT = 0.05
"""The most that an explanation may leave, relative to |b|: it must explain the images, which no Lambertian fit of bare metal does."""
LEAST_ENCODED, LEAST_ORDER, LEAST_LEFT, LEAST_LEFT_FEW = 0.02, 0.03, 0.05, 0.1
"""The least misfit of the manifest at which an encoding, an order or the rest is looked for: what smooth real surfaces leave; and
directions of few lights, where highlights of a plane show no order: right letters on a plate leave 0.06, 157 of 158 wrong orders more."""
LEAST_SPREAD = 0.1
"""Least standard deviation of the logarithm of the brightness that the images ask for: less does little harm."""
ABOUT = 1.3
"""The brightness of the lights can imitate an encoding, or another order, on a flat object. It has a number for each light: the others are
meant unless they leave more than this many times what the brightness leaves."""
SCALE_ROUNDS, FREE_ROUNDS = 12, 12
"""Rounds of alternating least squares."""
MEASURED_EVERY, STEP_EVERY = 3, 2
"""Every third pixel suffices to measure the brightness, whose rounds are many, and every second one a step of it."""
STEADY_EVERYWHERE = 0.9
"""Least part of the pixels that reflect light which all images share: it adds to every reading."""
PLENTY = 60
"""Least count of pixels, seen by most lights, from which free directions are started."""


class Cause(Enum):
    """The fault of the manifest."""

    ENCODED = "the images are display-encoded, and declared linear"
    LINEAR = "the images are linear, and declared display-encoded"
    IRRADIANCE = "the irradiance of the lights is wrong"
    ENCODED_OR_IRRADIANCE = "the images are display-encoded, or the irradiance of the lights is wrong"
    STEP = "the brightness of the images changes between two of them"
    NORMALISED = "the images are divided by the irradiance already"
    REVERSED = "the lights are in reverse order"
    TEXT = "the lights are in the order of their numbers as text, or the images are"
    SHIFTED = "the lights are one frame off"
    BALL_NORMALS = "the directions are normals of a mirror ball at the spots of the lamps"
    ELEVATION = "angles from the view axis and elevations are exchanged"
    DIRECTIONS = "directions and images do not belong together"
    STEADY = "light is on in all images that is not that of their lamps"


class Explanation(NamedTuple):
    """A fault that explains the images better than the manifest does."""

    cause: Cause
    misfit: float
    """Residual of the manifest: robust standard deviation of the readings over |b|."""
    left: float
    """Residual of the explanation, likewise."""
    degrees: float
    """Median angle between the normals of the two; where no normals follow, between those of every other light and the rest."""
    space: str = ""
    """Colour space that would declare the encoding; empty where the encoding is not the cause."""
    step: BrightnessStep | None = None
    """The change of brightness, where it is the cause."""
    late: tuple[int, int] | None = None
    """The first image whose light is not its own, where those before it are, and by how many lights it is off: 1 or -1."""
    part: float = 0.0
    """Median of the light that all images share, over that of a lamp which a pixel faces."""
    normal: np.ndarray | None = None  # [3, pixels] of the sample without that light
    gloss: bool = False  # whether a highlight of the object explains the images as well


class Sample(NamedTuple):
    """Pixels of the object with what the manifest says of them."""

    radiance: np.ndarray  # [lights, pixels, 3] float64, scene-linear as declared
    usable: np.ndarray  # [lights, pixels] bool: unsaturated
    directions: np.ndarray  # [lights, 3] float64, unit
    irradiance: np.ndarray  # [lights, 3] float64
    exposure: np.ndarray  # [lights] float64: recorded values over radiance
    color_space: str
    images: tuple[str, ...]
    """The names of the images."""


def fit_manifest(sample: Sample) -> Fit:
    """Return the fit of the readings as the manifest gives them."""
    return fit_lambertian(grey_readings(sample.radiance, sample.irradiance), sample.usable, sample.directions)


def better_explanation(sample: Sample, given: Fit) -> Explanation | None:
    """Return what explains the images much better than the manifest, or None; `given` is the fit of fit_manifest."""
    count, misfit = len(sample.directions), given.misfit()
    if count < MIN_LIGHTS or given.spare.sum() < MIN_PIXELS or given.spare.mean() < MIN_PART:
        return None
    encoding, (steady, shown, everywhere) = _encoding(sample, given, misfit), _steady_light(sample, given)
    if shown and (encoding is None or steady.left < encoding.left):
        return steady
    step = _step(sample, given, misfit)
    brightness = _brightness(sample, given, misfit) if count >= MIN_LIGHTS_SCALED else None
    if step is not None and (brightness is None or step.left <= TIMES_FREE * brightness.left):
        return step
    order = _order(sample, given, misfit)
    plain = min((found for found in (encoding, order) if found is not None), key=lambda found: found.left, default=None)
    if plain is not None and (brightness is None or plain.left <= ABOUT * brightness.left):
        return plain
    if brightness is not None:
        if encoding is None or encoding.cause is not Cause.ENCODED:
            return brightness
        return brightness._replace(cause=Cause.ENCODED_OR_IRRADIANCE, degrees=max(brightness.degrees, encoding.degrees),
                                   space=encoding.space)
    free = _free_directions(sample, given) if count >= MIN_LIGHTS_FREE else None
    if free is None:
        return None
    if everywhere and _explains(steady.left, steady.misfit, TIMES_FREE) and steady.left <= ABOUT * free.left:
        return steady
    of_a_coin = given.apart.mean() < ROUND and in_order(grey_readings(sample.radiance, sample.irradiance), sample.directions, IN_ORDER)
    return None if of_a_coin else free


def _explains(left: float, misfit: float, times: float) -> bool:
    return left <= LARGEST_LEFT and misfit >= times * left


def _angle(one: Fit, other: Fit) -> float:
    return float(np.median(degrees_between(one.normal, other.normal)))


def grey_readings(radiance: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Return grey readings, [lights, pixels], of radiance [lights, pixels, 3] from the channels in which every light has irradiance."""
    weights = np.where((irradiance > 0).all(axis=0), GREY_WEIGHTS, 0)
    factors = np.divide(weights, irradiance, out=np.zeros_like(irradiance), where=irradiance > 0)
    return np.asarray(np.einsum("lpc,lc->lp", radiance, factors))


def _encoding(sample: Sample, given: Fit, misfit: float) -> Explanation | None:
    """Return the opposite of the declared encoding if it explains the images: sRGB or power 2.2 where no value is above one, or linear."""
    linear = is_linear(sample.color_space)
    if misfit < (LEAST_ENCODED if linear else LEAST_LEFT):
        return None
    found: list[Explanation] = []
    for space, radiance in other_readings(sample.radiance, sample.exposure[:, None, None], sample.color_space):
        fit = fit_manifest(sample._replace(radiance=radiance))
        if _explains(fit.misfit(), misfit, TIMES if linear else TIMES_FREE):
            found.append(Explanation(Cause.ENCODED if linear else Cause.LINEAR, misfit, fit.misfit(), _angle(given, fit), space=space,
                                     gloss=not linear and flat_in_frontal_light(given, sample.directions)))
    if not found:
        return None
    best = min(found, key=lambda one: one.left)
    return found[0] if found[0].left <= ABOUT * best.left else best  # sRGB is the usual one


def _order(sample: Sample, given: Fit, misfit: float) -> Explanation | None:
    """Return the reverse order of the lights, that of text, or one that is a frame off, from an image on if not everywhere, or what else
    the vectors may be, if it explains the images."""
    if misfit < LEAST_ORDER:
        return None
    numbers, found = np.arange(len(sample.directions)), []

    def tell(cause: Cause, read: Sample, *, least_apart: float = 0.0, late: tuple[int, int] | None = None) -> None:
        fit = fit_manifest(read)
        if _explains(fit.misfit(), misfit, TIMES) and fit.apart.mean() >= least_apart:
            found.append(Explanation(cause, misfit, fit.misfit(), _angle(given, fit), late=late))

    texts = [np.array(sorted(numbers, key=lambda number: str(number + first))) for first in (0, 1)]
    for cause, order in ((Cause.REVERSED, numbers[::-1]), (Cause.SHIFTED, np.roll(numbers, 1)), (Cause.SHIFTED, np.roll(numbers, -1)),
                         *((Cause.TEXT, order) for text in texts for order in (text, np.argsort(text)) if (text != numbers).any())):
        tell(cause, sample._replace(directions=sample.directions[order], irradiance=sample.irradiance[order]))
    if len(numbers) >= MIN_LIGHTS_FREE:
        for cause, other in ((Cause.BALL_NORMALS, from_ball_normals), (Cause.ELEVATION, from_other_elevations)):
            tell(cause, sample._replace(directions=other(sample.directions)), least_apart=ROUND)
    if len(numbers) >= MIN_LIGHTS_LATE:
        late = _late(sample)
        tell(Cause.SHIFTED, _moved(sample, *late), late=late)
    return min(found, key=lambda one: one.left if one.late is None else ABOUT * one.left, default=None)


def _late(sample: Sample) -> tuple[int, int]:
    """Return from which image on the next lights, or those before, fit best, and which of them, 1 or -1: the misfit falls towards it."""
    few = sample._replace(radiance=sample.radiance[:, ::LATE_EVERY], usable=sample.usable[:, ::LATE_EVERY])

    @cache
    def left(first: int, by: int) -> float:
        return fit_manifest(_moved(few, first, by)).misfit()

    last, found = len(sample.directions) - 2, []
    step = max(1, last // LATE_STEPS)
    for by in (1, -1):
        near = min(range(1, last + 1, step), key=partial(left, by=by))
        found += [(first, by) for first in range(max(near - step, 1), min(near + step, last) + 1)]
    return min(found, key=lambda each: left(each[0], by=each[1]))


def _moved(sample: Sample, first: int, by: int) -> Sample:
    """Return a sample whose images from one on have the light after their own, or before it; without an image that then has none."""
    light = np.arange(len(sample.directions))
    light[first:] += by
    told = light < len(light)
    return sample._replace(radiance=sample.radiance[told], usable=sample.usable[told], directions=sample.directions[light[told]],
                           irradiance=sample.irradiance[light[told]])


def _step(sample: Sample, given: Fit, misfit: float) -> Explanation | None:
    """Return a brightness that changes between two images, if the images ask for it."""
    few = slice(None, None, STEP_EVERY)
    readings = grey_readings(sample.radiance, sample.irradiance)
    part = Fit(given.vector[:, few], given.residual[:, few], given.lit[:, few])
    step = find_step(readings[:, few], sample.usable[:, few], sample.directions, part)
    if step is None:
        return None
    factors = step.factors(len(readings))
    fit = fit_lambertian(readings / factors[:, None], sample.usable, sample.directions)
    return Explanation(Cause.STEP, misfit, fit.misfit(), _angle(given, fit), step=step)


def _brightness(sample: Sample, given: Fit, misfit: float) -> Explanation | None:
    """Return a brightness of each light that explains the images, by alternating least squares between it and the normals.

    Source: Cho, Matsushita, Tai and Kweon, "Photometric stereo under non-uniform light intensities and exposures", ECCV 2016.
    """
    if misfit < LEAST_LEFT:
        return None
    readings = grey_readings(sample.radiance, sample.irradiance)
    factor = np.ones(len(readings))
    for _ in range(SCALE_ROUNDS):
        fit = fit_lambertian(readings / factor[:, None], sample.usable, sample.directions, rounds=3)
        model = sample.directions @ fit.vector
        seen = fit.lit & (model > SHADOW * np.linalg.norm(fit.vector, axis=0))
        step = median_of((readings / factor[:, None] / np.where(seen, model, 1)).T, seen.T)
        factor *= np.where(step > 0, step, 1.0)
        factor /= np.exp(np.log(factor).mean())
    free = fit_lambertian(readings / factor[:, None], sample.usable, sample.directions)
    left = free.misfit()
    if np.log(factor).std() < LEAST_SPREAD or not _explains(left, misfit, TIMES_FREE):
        return None
    apart = free.apart  # under the declared brightness, normals of a metal plane seem to differ
    if apart.sum() >= LEAST_APART and given.misfit(apart) < TIMES_FREE * free.misfit(apart):
        return None
    smooth = len(factor) >= MIN_LIGHTS_SMOOTH and in_order(np.log(factor)[:, None], sample.directions, SMOOTH)
    if smooth and free.apart.mean() < ROUND and not told_by_relief(readings, sample.usable, sample.directions, factor, free, given):
        return None  # highlights of a coin look like lights of other strengths
    # the alternation stops half-way: enough to see that brightness explains the images, but not how far the normals are off
    try:
        few = slice(None, None, MEASURED_EVERY)
        measured = fit_intensities(sample.radiance[:, few], sample.usable[:, few], sample.directions).irradiance
    except CalibrationError:
        measured = sample.irradiance * factor[:, None]
    known = np.isfinite(measured).all(axis=1)
    part = sample._replace(radiance=sample.radiance[known], usable=sample.usable[known], directions=sample.directions[known],
                           irradiance=measured[known])
    spread = float(np.log(measured[known]).std(axis=0).max())
    cause = Cause.NORMALISED if spread < LEAST_SPREAD else Cause.IRRADIANCE
    return Explanation(cause, misfit, left, _angle(given, fit_manifest(part)))


def _free_directions(sample: Sample, given: Fit) -> Explanation | None:
    """Say whether some directions explain the images where those of the manifest do not: whatever its lights are, a Lambertian object has
    images of rank three (Hayakawa, JOSA A 11(11), 1994), which alternating least squares find from the singular vectors of the pixels that
    most lights reach. A misfit is compared relative to the bright readings of each pixel, because |b| is not defined."""
    readings = grey_readings(sample.radiance, sample.irradiance)
    bright = bright_readings(readings, sample.usable)
    top = np.maximum(bright, TINY)
    readings = np.where(bright > 0, readings / top, 0)  # few lights reach some of the background, as the codes of a JPEG file have it
    lit = sample.usable & (readings > SHADOW)
    enough = lit.sum(axis=0) >= MIN_READINGS_FREE
    if enough.mean() < MIN_PART:
        return None
    lit &= enough
    best = np.argsort(-lit.sum(axis=0), kind="stable")[: max(PLENTY, lit.shape[1] // 4)]
    left, values, _ = np.linalg.svd(readings[:, best], full_matrices=False)
    lights, weight = left[:, :3] * values[:3], lit.astype(np.float64)
    surface = least_squares(readings, weight, lights)
    for _ in range(FREE_ROUNDS):
        lights = least_squares(readings.T, weight.T, surface.T).T
        surface = least_squares(readings, weight, lights)
        residual = np.where(lit, readings - lights @ surface, 0)
        spread = MAD_TO_SIGMA * float(np.median(np.abs(residual[lit]))) + 1e-4
        weight = lit / (1 + (residual / (3 * spread)) ** 2)
    scaled = given.residual * np.linalg.norm(given.vector, axis=0) / top

    def misfits(chosen: np.ndarray) -> tuple[float, float]:
        free, declared = (MAD_TO_SIGMA * float(np.median(np.abs(each[chosen]))) if chosen.any() else np.nan for each in (residual, scaled))
        return free, declared

    free, misfit = misfits(lit)
    if misfit < (LEAST_LEFT if len(lights) >= MIN_LIGHTS_SMOOTH else LEAST_LEFT_FEW) or not _explains(free, misfit, TIMES_FREE):
        return None
    apart = unlike_most(lights @ surface, PLANE, 3)  # any readings of three planes are explained by three numbers of each light
    if apart.sum() < LEAST_APART:
        return None
    explained, declared = misfits(lit & apart)
    if declared < TIMES_FREE * explained:
        return None
    halves = [fit_lambertian(readings[part::2], sample.usable[part::2], sample.directions[part::2]) for part in (0, 1)]
    return Explanation(Cause.DIRECTIONS, misfit, free, _angle(*halves))


def _steady_light(sample: Sample, given: Fit) -> tuple[Explanation, bool, bool]:
    """Return the light that all images share, as far as they do, whether readings in shadow show it, and whether it may be everywhere."""
    readings = grey_readings(sample.radiance, sample.irradiance)
    fit, part, in_shadow = fit_steady_light(readings, sample.usable, sample.directions, sample.irradiance)
    spare = fit.spare | ~fit.spare.any()
    turned = float(np.median(degrees_between(given.normal, fit.normal)[spare]))
    told = Explanation(Cause.STEADY, given.misfit(), fit.misfit(), turned, part=float(np.median(part[spare])), normal=fit.normal)
    shown = bool(in_shadow) and told.left < told.misfit
    return told, shown, in_shadow is not False and bool((part[spare] > 0).mean() >= STEADY_EVERYWHERE)
