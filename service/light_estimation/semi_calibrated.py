"""Semi-calibrated photometric stereo: the brightness of lights of known direction from images of the object.

Readings y_lp = e_l · l·b_p of a Lambertian surface are linear in q_l = 1/e_l and b_p together, q_l y_lp - l·b_p = 0. Every b_p is
eliminated in closed form, which leaves one small symmetric eigenvalue problem in q. Weights exclude shadows and highlights, and the
last rounds alternate between b and e.

Source: Cho, Matsushita, Tai and Kweon, "Photometric stereo under non-uniform light intensities and exposures", ECCV 2016, and
    "Semi-calibrated photometric stereo", TPAMI 42(1), 2020: the linear joint estimation and the alternating one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from service.light_estimation.grey_ball import WEIGHT_SCALE
from service.light_estimation.lambertian import (
    BRIGHT_END,
    SHADOW,
    Fit,
    bright_readings,
    fit_lambertian,
    least_squares,
    median_of,
    normal_equations,
)
from stage.errors import CalibrationError
from stage.spread import MAD_TO_SIGMA

MIN_LIGHTS = 4
"""The least count of lights: each gives two equations for the eight unknowns of the ambiguity."""
MIN_PIXELS = 30
"""The least count of pixels that must show a light."""
MIN_DETERMINED = 1e-3
"""The least relative singular value of the equations for the ambiguity: below it the brightness is not determined."""
RIDGE = 1e-12
"""The part of the mean of its diagonal that is added to the normal equations of a pixel: pixels of no weight get no b."""
GUESS_ROUNDS = 3
"""Rounds of the first guess, each of which compares a light with the bright readings that the others then have."""
UNLIT = 0.4
"""Median relative error of the readings of a light from which it is dark: noise alone has 1 and more, a thirtieth of the others' light
under noise of a sixteenth of its own .2."""
ROUNDS = 60
"""The most rounds."""
LINEAR_ROUNDS = range(6, 12)
"""The rounds that solve the eigenvalue problem."""
CONVERGED = 1e-4
"""The largest relative change of a light in the last round, a hundredth of the uncertainty on real surfaces."""
PARTS, LEAST_PARTS = 6, 3
"""Parts of an object, by how much its pixels face the viewer, whose lights are compared, and how many of them must tell a light."""
IN_COMMON = 2.0
"""What parts of an object have in common, over what they differ by: of 40 objects, matt ones to metal, errors are .2 of what this makes of
the differences in the median, and 1.8 at most."""
BEHIND = 0.05
"""How far a light is behind a surface, as −cosine, from which on it does not reach it: normals may be wrong by 3°."""
MISLEADS = 1.5
"""Error of the brightness of a light over the part that light from elsewhere has of it: with it, of 120 objects in a lit room, or with
bounced light, under 8 to 24 lights, errors are .2 of the uncertainty in the median, and 1.6 times it at most."""
ALIKE = 3.5
"""What one pattern may leave, over what a fit of normals leaves, of a plane: up to 2.8 of planes, 4.7 and more of relief of a degree."""
ROUND, RELIEF_TIMES = 0.65, 2.5
"""Part of the pixels that face otherwise than most, below which the relief of an object must tell the intensities; and their spread over
their uncertainty, from which on it does: 0.9 to 2.3 of highlights on relief of 1 to 8 degrees under right lights, 7 to 150 of matt relief
under wrong ones, 3 and more of glossy relief and folds under lights that are wrong by a third."""
FRONTAL = 0.766
"""Cosine of 40°: within this angle of where a flat object faces, a broad highlight falls off over the lights as shading does that is
decoded once too often. Of 32 right glossy reliefs under 6 to 24 lights within 33° (roughness .25 to .9) eight looked linear, of 96 beyond
48° none."""
ENOUGH_APART, FAR_BETTER = 0.2, 4.0
"""Part of the pixels that face otherwise than most under either strength of the lights, and the factor by which the strengths lower their
misfit, from which on they tell these: 1.8 of glossy relief of five degrees under right lights, 10 of an ellipsoid before a wall under wrong
ones."""
TINY = 1e-200
"""A number below any reading, which avoids division by zero."""


class Intensities(NamedTuple):
    """The brightness of each light; NaN for a light that too few pixels show, because it is behind the object or dark."""

    irradiance: np.ndarray  # [lights, 3] float64, mean 1 over the measured lights in each channel
    residual: np.ndarray  # [lights, 3] float64, weighted root mean square of the residual over |b|
    pixels: int
    """The count of pixels that were used."""


class _UnlitError(Exception):
    """Too few pixels show these lights."""

    def __init__(self, lights: np.ndarray) -> None:
        super().__init__(lights)
        self.lights = lights


def fit_intensities(
    readings: np.ndarray,  # [lights, pixels, 3] scene-linear radiance of pixels of the object
    usable: np.ndarray,  # [lights, pixels] bool, True for unsaturated readings
    directions: np.ndarray,  # [lights, 3] unit
) -> Intensities:
    """Measure the irradiance of every light, up to one factor in each channel.
    Raises CalibrationError if there are too few lights or pixels, or the directions do not determine the brightness."""
    result = [np.full((len(directions), 3), np.nan) for _ in range(2)]
    told, fits = _fit_channels(readings, usable, directions, "RGB")
    for part, values in enumerate(result):
        values[told] = np.stack([fit[part] for fit in fits], axis=-1)
    return Intensities(result[0], result[1], min(fit[2] for fit in fits))


def uncertainty_of(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, irradiance: np.ndarray,
                   elsewhere: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the brightness of lights, [lights, 3] relative to the value, 1 at most: of what parts of the object
    ask for, and of what light from elsewhere may add, as much to dim lights as to bright ones. The arguments are those of
    `fit_intensities`, its result, and that of `light_from_elsewhere`."""
    return np.fmin(np.hypot(part_uncertainty(readings, usable, directions, irradiance), MISLEADS * elsewhere / irradiance), 1.0)


def part_uncertainty(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the brightness of lights, [lights, 3] relative to the value, from what parts of the object ask for.

    A surface that is not quite Lambertian asks for wrong lights, and leaves next to no residual; where it faces the viewer it asks for
    other ones than where it turns away. 1 where fewer than LEAST_PARTS tell. The arguments are those of `fit_intensities`, and its result.
    """
    told = np.isfinite(irradiance).all(axis=1)
    grey = (readings[told] / irradiance[told, None]).mean(axis=2)
    facing = fit_lambertian(grey, usable[told], directions[told]).normal[2]
    asked = []
    for part in np.array_split(np.argsort(facing), PARTS):
        try:
            found = fit_intensities(readings[:, part], usable[:, part], directions).irradiance
        except CalibrationError:
            continue
        ratio = np.log(found / irradiance)
        known = np.isfinite(ratio).all(axis=1)
        asked.append(ratio - ratio[known].mean(axis=0) if known.any() else ratio)
    if len(asked) < LEAST_PARTS:
        return np.ones_like(irradiance)
    enough = np.isfinite(asked).sum(axis=0) >= LEAST_PARTS
    own = np.nanvar(np.where(enough, asked, 0), axis=0)  # of six values: half of it is that of all lights
    return np.where(enough, IN_COMMON * np.sqrt((own + own.mean(axis=0)) / 2), 1.0)


def shades_alike(readings: np.ndarray, usable: np.ndarray, misfit: float) -> bool:
    """Return whether readings [lights, pixels] are one pattern of lights times the albedo of each pixel, as far as a fit that leaves
    `misfit`, relative to |b|, tells: all pixels of a plane shade alike, whatever the lights are, so that they do not tell these."""
    level = np.maximum(np.where(usable, readings, 0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1), TINY)
    relative = readings / level
    pattern = np.maximum(median_of(relative.T, usable.T), TINY)
    off = np.abs(relative / pattern[:, None] - 1)[usable]
    return MAD_TO_SIGMA * float(np.median(off)) < ALIKE * misfit


def flat_in_frontal_light(fit: Fit, directions: np.ndarray) -> bool:
    """Return whether most of an object faces one way, and all lights [lights, 3] stand near it."""
    facing = np.median(fit.normal, axis=1)
    return bool(fit.apart.mean() < ROUND and (directions @ facing).min() > FRONTAL * np.linalg.norm(facing))


def told_by_relief(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, factor: np.ndarray, fit: Fit, declared: Fit) -> bool:
    """Return whether the relief of a flat object tells the intensities: its parts, by how they face the viewer, ask for the same ones, and
    would not if they were highlights. Where enough faces otherwise than most and is far better explained, as a body before a wall, it
    tells them unless it shades alike. `factor`: [lights], that grey readings [lights, pixels] ask for. `fit`, `declared`: under these and
    under the declared ones."""
    apart = fit.apart & declared.apart  # highlights make normals of flat relief differ under other strengths
    if apart.mean() >= ENOUGH_APART and declared.misfit(apart) > FAR_BETTER * fit.misfit(apart):
        return not shades_alike(readings[:, apart], usable[:, apart], fit.misfit(apart))
    if shades_alike(readings, usable, fit.misfit()):
        return False
    sigma = part_uncertainty(np.repeat(readings[..., None], 3, axis=2), usable, directions, np.repeat(factor[:, None], 3, axis=1))
    return float(np.log(factor).std()) > RELIEF_TIMES * float(np.median(sigma))


def light_from_elsewhere(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """Return the light of the room and of other surfaces, [3] over that of the mean light where it falls straight on a surface: what
    pixels read under the lights behind them, in the median. 0 where fewer than MIN_PIXELS readings tell. The arguments are those of
    `fit_intensities`, and its result."""
    told = np.isfinite(irradiance).all(axis=1)
    found = np.zeros(3)
    for channel, factor in enumerate(irradiance[told].T):
        seen = readings[told, :, channel]
        vector = fit_lambertian(seen / factor[:, None], usable[told], directions[told]).vector
        length = np.maximum(np.linalg.norm(vector, axis=0), TINY)
        behind = usable[told] & (directions[told] @ vector < -BEHIND * length)
        if behind.sum() >= MIN_PIXELS:
            found[channel] = max(float(np.median((seen / length)[behind])), 0.0)
    return found


def fit_grey_intensities(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray, *, rounds: int = ROUNDS) -> np.ndarray:
    """Measure one brightness of every light, up to one factor; quicker than three channels.
    `readings`: [lights, pixels] scene-linear grey readings of pixels of the object. `usable`, `directions`: as of fit_intensities, which
    raises the same errors. `rounds`: the most rounds, more than LINEAR_ROUNDS.stop. Returns [lights] float64, mean 1 over the measured
    lights; NaN for a light that too few pixels show."""
    told, (fit,) = _fit_channels(readings[..., None], usable, directions, ("grey",), rounds)
    result = np.full(len(directions), np.nan)
    result[told] = fit[0]
    return result


def _fit_channels(readings: np.ndarray, usable: np.ndarray, directions: np.ndarray,
                  names: Sequence[str], rounds: int = ROUNDS) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray, int]]]:
    """Return the lights that enough pixels show, and the fit of each channel to them."""
    check_directions(directions)
    told = np.arange(len(directions))
    while True:
        try:
            return told, [_fit_channel(readings[told, :, channel].astype(np.float64), usable[told], directions[told], name, rounds)
                          for channel, name in enumerate(names)]
        except _UnlitError as unlit:
            told = np.delete(told, unlit.lights)
            check_directions(directions[told])


def check_directions(directions: np.ndarray) -> None:
    """Check that the directions of the lights determine their brightness.

    Another brightness explains the same images when there is a 3×3 matrix G, other than a multiple of the identity, with Gᵀ l
    parallel to l for every light. l × Gᵀ l = 0 is linear in G, so its null space must have one dimension.
    Raises CalibrationError if there are fewer than four lights, or all lights but one lie in one plane."""
    if len(directions) < MIN_LIGHTS:
        raise CalibrationError(f"{len(directions)} distant lights: brightness needs {MIN_LIGHTS} or more")
    x, y, z = directions.T
    zero = np.zeros_like(x)
    cross = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], axis=1)
    equations = np.einsum("lij,lk->lijk", cross, directions).reshape(-1, 9)
    singular = np.linalg.svd(equations, compute_uv=False)
    if singular[7] < MIN_DETERMINED * singular[0]:
        raise CalibrationError("all lights but one lie in one plane (or on a line): brightness cannot be told from shape")


def _fit_channel(reading: np.ndarray, usable: np.ndarray, directions: np.ndarray,
                 name: str, rounds: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the irradiance [lights] of one channel, its residual, and the count of pixels.

    Each channel is fitted alone: under lights of different colours the grey of a coloured surface is no product of light and albedo.
    """
    lit = usable & (reading > 0)
    enough = lit.sum(axis=0) >= MIN_LIGHTS
    count = int(enough.sum())
    if count < MIN_PIXELS:
        raise CalibrationError(f"channel {name}: {count} pixels are lit and unsaturated under {MIN_LIGHTS} or more lights: "
                               f"{MIN_PIXELS} are needed")
    reading, lit = reading[:, enough], lit[:, enough]
    reading = reading / np.where(lit, reading, 0).max(axis=0)  # so that pixels of dark albedo have the same weight
    try:
        e, b, weight = _rounds(reading, lit, directions, np.ones(len(directions)), rounds)
    except _UnlitError:  # or far dimmer than the others
        e, b, weight = _rounds(reading, lit, directions, _first_guess(reading, lit), rounds)
        unlit = _off(reading, usable[:, enough], e, directions @ b) > UNLIT
        if unlit.any():
            raise _UnlitError(np.flatnonzero(unlit)) from None
    error = np.where(weight > 0, (reading / e[:, None] - directions @ b) / np.maximum(np.linalg.norm(b, axis=0), TINY), 0)
    total = weight.sum(axis=1)
    residual = np.sqrt((weight * error**2).sum(axis=1) / total)
    return e, residual, count


def _rounds(reading: np.ndarray, lit: np.ndarray, directions: np.ndarray, e: np.ndarray,
            rounds: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the irradiance [lights] that the rounds lead to from `e`, the vectors of the pixels, and the weights."""
    weight = lit.astype(np.float64)
    for step in range(rounds):
        weight = _weights(reading, lit, e, directions, weight)
        unlit = (weight > 0).sum(axis=1) < MIN_PIXELS
        if unlit.any():
            raise _UnlitError(np.flatnonzero(unlit))
        before = e
        # the first rounds alternate: they converge slowly, but highlights cannot make them negative
        e = _linear(reading, weight, directions, e) if step in LINEAR_ROUNDS else e
        b = least_squares(reading / e[:, None], weight * e[:, None] ** 2, directions, RIDGE)
        e = _scale(reading, directions @ b, weight)
        e /= e.mean()
        if step >= LINEAR_ROUNDS.stop and np.abs(e / before - 1).max() < CONVERGED:
            break
    return e, b, weight


def _first_guess(reading: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Return the irradiance [lights] from the bright readings of each light, which pixels that face it have."""
    e = np.ones(len(reading))
    for _ in range(GUESS_ROUNDS):
        scaled = np.where(lit, reading / e[:, None], 0)
        scaled /= scaled.max(axis=0)
        e *= [np.quantile(each[seen], BRIGHT_END) if seen.any() else 1.0 for each, seen in zip(scaled, lit, strict=True)]
    return e / e.mean()


def _off(reading: np.ndarray, usable: np.ndarray, e: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Return the median relative error [lights] of the readings where the light should be seen, whatever their weight."""
    seen = usable & (model > SHADOW * model.max(axis=0))
    relative = np.abs(reading / (e[:, None] * np.where(seen, model, 1)) - 1)
    return np.asarray(median_of(relative.T, seen.T))


def _linear(reading: np.ndarray, weight: np.ndarray, directions: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Return e = 1/q from the minimum of q D Σ_p w_p y_p (I - projection on the lights) y_p D q, with D = (Σ w y²)^-1/2 of each light.

    A negative result, which outliers cause in early rounds, is replaced by the given `e`.
    """
    gram = normal_equations(weight, directions)
    values, vectors = np.linalg.eigh(gram)
    root = vectors / np.sqrt(np.maximum(values, 1e-9 * values[:, 2:] + TINY))[:, None, :]
    spread = np.einsum("lp,li,pij->lpj", weight * reading, directions, root, optimize=True).reshape(len(reading), -1)
    scale = 1 / np.sqrt((weight * reading**2).sum(axis=1))
    q = np.linalg.eigh(np.eye(len(reading)) - scale[:, None] * (spread @ spread.T) * scale)[1][:, 0] * scale
    q = q * np.sign(q.sum())
    return len(q) / q / (1 / q).sum() if (q > 0).all() else e


def _weights(reading: np.ndarray, lit: np.ndarray, e: np.ndarray, directions: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return Cauchy weights of the residual over |b| from the last weights; 0 where the readings or the model show a shadow."""
    scaled = reading / e[:, None]
    bright = lit & (scaled > SHADOW * bright_readings(scaled, lit))
    b = least_squares(scaled, weight * bright, directions, RIDGE)
    model, length = directions @ b, np.maximum(np.linalg.norm(b, axis=0), TINY)
    chosen = bright & (model > SHADOW * length)
    relative = np.where(chosen, scaled - model, 0) / length
    spread = MAD_TO_SIGMA * np.median(np.abs(relative[chosen])) if chosen.any() else 1.0
    weight = chosen / (1 + (relative / (WEIGHT_SCALE * spread + 1e-9)) ** 2)
    weight[:, (weight > 0.1).sum(axis=0) < MIN_LIGHTS] = 0  # three readings fit any brightness
    return weight


def _scale(reading: np.ndarray, model: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the least-squares factor [lights] between the readings of each light and the model."""
    return (weight * reading * model).sum(axis=1) / (weight * model**2).sum(axis=1)
