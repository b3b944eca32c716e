"""Test whether few lights support the general solver: readings of lights that are left out are predicted by it and by Lambert's law.

A mixture of six lobes and a normal follow a dozen readings whatever their cause, be it a highlight or a light whose direction is a few
degrees off. What they learnt from highlights predicts further readings; what they learnt from errors does not.

Source: choice of a model by the prediction of left-out data, Stone, "Cross-validatory choice and assessment of statistical predictions",
Journal of the Royal Statistical Society B 1974.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.lambertian.robust import (
    BRIGHT_FRACTION,
    BRIGHT_RANKS,
    CAUCHY_SCALE,
    DARK_RANKS,
    KEPT_AT_LEAST,
    REWEIGHTINGS,
    SHADOW_FRACTION,
)
from kernels.photometric.model.samples import Samples, device_values, host_values, host_vectors
from kernels.photometric.search.hypotheses import LobeShape, SearchOptions, predict
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.search.survey import QUICK
from service.requests.solve import Method
from service.solve.base.solution import Solution, raise_error

PARTS = 12
"""Number of parts into which the lights are divided, each left out once; fewer lights are left out singly."""
RIDGE = 1e-6
"""Added to the diagonal of the normal equations, so that coplanar lights give a solution."""
SHARED = 0.15
"""Correlation of what is left at neighbouring pixels below which it is noise, which sigma holds: 0.02 to 0.11 under noise, 0.2 where the
camera shakes, and 0.5 to 0.95 of velvet, wrong lights and images that are not linear."""
OUTLYING = 3.0
"""Residual, in units of the noise of the cost, that larger ones count as where those of neighbours are compared."""


class LeftOut(NamedTuple):
    """Mean cost of the left-out readings at the first pixels of pairs, as the search counts it."""

    general: float
    """The readings as the mixture of lobes predicts them."""
    lambert: float
    """The readings as Lambert's law predicts them, fitted by least squares."""
    robust: float
    """The same, fitted to middle ranks."""
    shared: float
    """Correlation of what the best of the three leaves at neighbouring pixels: near 0 for noise."""


def leave_out(samples: Samples, start: np.ndarray) -> LeftOut:
    """Predict the readings of each light from those of the others.
    `samples`: pairs of neighbouring pixels, some hundreds that are spread over the object, the first ones of all pairs, then the second
    ones, under four lights or more. `start`: [n, 3] unit normals to begin from."""
    lights = samples.light_count
    readings = host_values(samples, samples.grey).astype(np.float64)
    toward = np.moveaxis(host_vectors(samples, samples.toward), 0, -1).astype(np.float64, order="C")
    parts = min(PARTS, lights)
    predicted = np.zeros((3, *readings.shape))
    for part in range(parts):
        out = np.arange(lights) % parts == part
        kept = np.where(out, -1.0, readings)
        rest = samples._replace(grey=device_values(samples, kept))
        found = find_normals(rest, start, shape=LobeShape(), sweep=QUICK).best
        predicted[0][:, out] = np.maximum(predict(samples, found.normal, found.weights, shape=LobeShape())[:, out], 0)
        for model, method in enumerate((Method.LAMBERT, Method.ROBUST), start=1):
            predicted[model][:, out] = np.maximum(np.einsum("nlc,nc->nl", toward[:, out], _simple_fit(kept, toward, method)), 0)
    given = readings >= 0
    count = len(readings) // 2
    if not given[:count].any():
        return LeftOut(0.0, 0.0, 0.0, 0.0)
    costs = [float(_cost(readings, each)[:count][given[:count]].mean()) for each in predicted]
    left = np.where(given, np.clip((readings - predicted[int(np.argmin(costs))]) / SearchOptions().noise(readings), -OUTLYING, OUTLYING), 0)
    first, second = left.reshape(2, count, -1)
    shared = float((first * second).sum()) / max(0.5 * float((left**2).sum()), 1e-30)
    return LeftOut(costs[0], costs[1], costs[2], shared)


def simpler_normals(samples: Samples, simpler: Method, start: np.ndarray) -> np.ndarray:
    """Return [n, 3] unit normals of the readings of samples by a simpler method, LAMBERT or ROBUST; those of `start` where at most three
    readings are left, which nothing checks."""
    readings = host_values(samples, samples.grey).astype(np.float64)
    b = _simple_fit(readings, np.moveaxis(host_vectors(samples, samples.toward), 0, -1).astype(np.float64, order="C"), simpler)
    length = np.linalg.norm(b, axis=1, keepdims=True)
    told = ((readings > 0).sum(axis=1, keepdims=True) > 3) & (length > RIDGE)
    return np.where(told, b / np.maximum(length, RIDGE), start).astype(np.float32)


def _simple_fit(readings: np.ndarray, toward: np.ndarray, simpler: Method) -> np.ndarray:
    """Return [n, 3] albedo times normal of readings [n, lights], of which those at 0 or below do not count, by a simpler method."""
    robust = simpler is Method.ROBUST
    weights = _middle(readings) if robust else (readings > 0).astype(np.float64)
    b = _least_squares(readings, toward, weights)
    for _ in range(REWEIGHTINGS if robust else 0):
        off = readings - np.einsum("nlc,nc->nl", toward, b)
        b = _least_squares(readings, toward, weights / (1 + (off / (CAUCHY_SCALE * np.linalg.norm(b, axis=1)[:, None] + RIDGE)) ** 2))
    return b


def _middle(readings: np.ndarray) -> np.ndarray:
    """Return 1 for readings [n, lights] of the middle ranks, as of `solve_robust`, and 0 for others."""
    lit = readings > SHADOW_FRACTION * np.quantile(np.maximum(readings, 0), 1 - BRIGHT_FRACTION, axis=1, keepdims=True)
    count = lit.sum(axis=1, keepdims=True)
    share = np.minimum(1, np.maximum(count - KEPT_AT_LEAST, 0) / np.maximum((DARK_RANKS + BRIGHT_RANKS) * count, 1))
    rank = np.where(lit, readings, -np.inf).argsort(axis=1).argsort(axis=1) - (readings.shape[1] - count)  # from the darkest lit one
    kept = (rank >= np.floor(share * DARK_RANKS * count)) & (rank < count - np.floor(share * BRIGHT_RANKS * count))
    return kept.astype(np.float64)


def _least_squares(readings: np.ndarray, toward: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return [n, 3] the least-squares b of b·l = reading."""
    gram = np.einsum("nl,nli,nlj->nij", weights, toward, toward) + RIDGE * np.eye(3)
    return np.linalg.solve(gram, np.einsum("nl,nli->ni", weights * readings, toward)[..., None])[..., 0]


def _cost(readings: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return the cost of each reading as the search counts it."""
    options = SearchOptions()
    squared = ((readings - predicted) / options.noise(readings)) ** 2
    dark = (readings < options.shadow_depth * predicted) & (squared > np.expm1(options.shadow_cost))
    return np.where(dark, options.shadow_cost, np.log1p(squared))


FEW_LIGHTS = 32
"""Fewer lights than this, four for each of the eight unknowns of a pixel, must show that they support the general solver."""
TESTED_LIGHTS = 6
"""The least number of lights of which one can be left out: with fewer, those that remain would not determine what is tested."""
UNDESCRIBED, DEGREES = 0.3, 30.0
"""Least misfit of left-out readings at which Lambert's law, or lobes, do not describe the material, and the error of the normals per misfit
where neither do: of two shapes of velvet the misfits are 0.7 and 1.3, and the errors 20 and 43 degrees. Matt objects under wrong lights
leave 0.1."""
SUPPORTED_RATIO, UNDESCRIBED_RATIO = 0.7, 0.85
"""Largest misfit of left-out readings, over that of Lambert's law, at which the general solver is supported: where Lambert's law describes
the object, 0.28 to 0.5 if the general normals are better, real and path-traced, 0.8 and above where they follow errors of the lights;
where it does not, and its normals are no refuge, up to 0.81 under noise, flicker and JPEG, 0.86 and more for velvet and lights in wrong
order."""

UNSUPPORTED_PULL, DOUBTFUL_PULL = 10.0, 0.5
"""Strengths of the prior towards the normals of a simpler method. The first is a standard deviation of some degrees for a reading that
misfits by the noise floor of the search, where what the simpler method leaves is noise, or lobes do not describe it. The second serves
where they do, and only predict it no better: few readings tell little of a left-out highlight, and much of a normal. With it the normals of
sheen under 6 to 16 lights are 1.1 to 2.2 degrees off, and 3.2 to 3.4 with the first; of DiLiGenT's cat under 8 and 10 lights 4.2 to 6.6,
and 6.4 to 8; of its ball under 12 frontal ones 1.8, and 3.6."""


class Support(NamedTuple):
    """How far few lights support the general solver."""

    lobes: bool = True
    """Whether normals are searched with specular lobes; materials have some where there is no pull."""
    simpler: Method = Method.LAMBERT
    """The simpler method that predicts left-out lights better, of LAMBERT and ROBUST."""
    pull: float = 0.0
    """Strength of the prior towards its normals."""
    warning: str | None = None
    """The sentence that says what speaks against the solver; None: nothing."""


def is_supported(general: float, lambert: float) -> bool:
    """Return whether these misfits of left-out readings support the general solver."""
    return general <= (SUPPORTED_RATIO if min(general, lambert) < UNDESCRIBED else UNDESCRIBED_RATIO) * lambert


def support_of(result: Solution, samples: Samples, start: np.ndarray, *, matt: bool) -> Support:
    """Return how far few lights support the general solver, and note in the solution what was measured; parameters as of leave_out.
    `matt`: the images hold diffuse light alone, so that no specular lobe is expected."""
    count = samples.light_count

    def fall_back(reason: str, simpler: Method, pull: float = UNSUPPORTED_PULL) -> Support:
        return Support(pull == DOUBTFUL_PULL, simpler, pull, f"method svbrdf: {reason}: normals are drawn to those of {simpler.value}"
                       f"{'' if matt else ' and no specular lobe is estimated'}; capture 32 lights or more, spread over the hemisphere, or "
                       "take --method robust.")

    if count < TESTED_LIGHTS:
        return fall_back(f"{count} lights are fewer than the unknowns of a pixel", Method.LAMBERT)
    general, lambert, robust, shared = (round(cost, 4) for cost in leave_out(samples, start))
    result.facts |= {"left_out_misfit": general, "left_out_misfit_lambert": lambert, "left_out_misfit_robust": robust,
                     "left_out_shared": shared}
    if is_supported(general, lambert):
        return Support()
    return fall_back(f"the images of left-out lights are predicted hardly better with specular lobes than without (misfit {general:.2g} "
                     f"against {min(robust, lambert):.2g})", Method.ROBUST if robust < lambert else Method.LAMBERT,
                     DOUBTFUL_PULL if shared >= SHARED and general < UNDESCRIBED and not matt else UNSUPPORTED_PULL)


def raise_undescribed(solution: Solution) -> None:
    """Make normals less sure, and say so, where the readings of left-out lights are predicted by no model."""
    if "left_out_misfit" not in solution.facts:
        return
    general, lambert, robust, shared = (solution.facts[name] for name in ("left_out_misfit", "left_out_misfit_lambert",
                                                                          "left_out_misfit_robust", "left_out_shared"))
    least = min(general, lambert, robust)
    if is_supported(general, lambert) or least < UNDESCRIBED or shared < SHARED:
        return
    degrees = np.full(solution.status.shape, DEGREES * least)
    if solution.brushed is not None:
        degrees[solution.brushed] = 0
    raise_error(solution, degrees)
    if not solution.mostly_brushed:
        solution.warnings.append("method svbrdf: the object reflects neither by Lambert's law nor with highlights, as velvet does not: "
                                 "the normals are only as sure as the layer sigma says; a ball of its material tells more "
                                 "(--reference-ball)")
