"""Test whether few lights support the general solver: readings of lights that are left out are predicted by it and by Lambert's law.

A mixture of six lobes and a normal follow a dozen readings whatever their cause, be it a highlight or a light whose direction is a few
degrees off. What they learnt from highlights predicts further readings; what they learnt from errors does not.

Source: choice of a model by the prediction of left-out data, Stone, "Cross-validatory choice and assessment of statistical predictions",
Journal of the Royal Statistical Society B 1974.
"""

from typing import NamedTuple

import numpy as np

from kernels.photometric.model.samples import Samples, device_values, host_values, host_vectors
from kernels.photometric.search.hypotheses import Diffuse, SearchOptions, predict
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.search.survey import QUICK
from service.solve.base.solution import Solution, raise_error

PARTS = 12
"""Number of parts into which the lights are divided, each left out once; fewer lights are left out singly."""
RIDGE = 1e-6
"""Added to the diagonal of the normal equations, so that coplanar lights give a solution."""


class LeftOut(NamedTuple):
    """Mean cost of the left-out readings, as the search counts it."""

    general: float
    """The readings as the mixture of lobes predicts them."""
    lambert: float
    """The readings as Lambert's law predicts them."""


def leave_out(samples: Samples, start: np.ndarray) -> LeftOut:
    """Predict the readings of each light from those of the others.
    `samples`: some hundreds of pixels, spread over the object, under four lights or more. `start`: [n, 3] unit normals to begin from."""
    lights = samples.light_count
    readings = host_values(samples, samples.grey).astype(np.float64)
    toward = np.moveaxis(host_vectors(samples, samples.toward), 0, -1).astype(np.float64, order="C")
    parts = min(PARTS, lights)
    costs: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    for part in range(parts):
        out = np.arange(lights) % parts == part
        kept = np.where(out, -1.0, readings)
        lambertian = _lambert(kept, toward)
        rest = samples._replace(grey=device_values(samples, kept))
        found = find_normals(rest, start, shape=Diffuse(), sweep=QUICK).best
        general = predict(samples, found.normal, found.weights, shape=Diffuse())
        given = readings[:, out] >= 0
        for kept_costs, predicted in zip(costs, (general, np.einsum("nlc,nc->nl", toward, lambertian)), strict=True):
            kept_costs.append(_cost(readings[:, out], np.maximum(predicted[:, out], 0))[given])
    return LeftOut(*(float(np.concatenate(each).mean()) if sum(map(len, each)) else 0.0 for each in costs))


def _lambert(readings: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Return [n, 3] the least-squares b of b·l = reading over the readings above zero."""
    weights = (readings > 0).astype(np.float64)
    gram = np.einsum("nl,nli,nlj->nij", weights, toward, toward) + RIDGE * np.eye(3)
    return np.linalg.solve(gram, np.einsum("nl,nli->ni", weights * readings, toward)[..., None])[..., 0]


def _cost(readings: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Return the cost of each reading as the search counts it."""
    options = SearchOptions()
    squared = ((readings - predicted) / (options.noise_floor + options.noise_slope * np.maximum(readings, 0))) ** 2
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


def is_supported(general: float, lambert: float) -> bool:
    """Return whether these misfits of left-out readings support the general solver."""
    return general <= (SUPPORTED_RATIO if min(general, lambert) < UNDESCRIBED else UNDESCRIBED_RATIO) * lambert


def supports_lobes(result: Solution, samples: Samples, start: np.ndarray, *, matt: bool) -> bool:
    """Return whether few lights support the general solver, and say in the solution what speaks against it; parameters as of leave_out.
    `matt`: the images hold diffuse light alone, so that no specular lobe is expected."""
    count = samples.light_count
    fallback = (f"normals are drawn to those of lambert{'' if matt else ' and no specular lobe is estimated'}; capture 32 lights or more, "
                "spread over the hemisphere, or take --method robust")
    if count < TESTED_LIGHTS:
        result.warnings.append(f"method svbrdf: {count} lights are fewer than the unknowns of a pixel: {fallback}.")
        return False
    general, lambert = (round(cost, 4) for cost in leave_out(samples, start))
    result.facts |= {"left_out_misfit": general, "left_out_misfit_lambert": lambert}
    supported = is_supported(general, lambert)
    if not supported:
        result.warnings.append(f"method svbrdf: the images of left-out lights are predicted hardly better with specular lobes than without "
                               f"(misfit {general:.2g} against {lambert:.2g}): {fallback}.")
    return supported


def raise_undescribed(solution: Solution) -> None:
    """Make normals less sure, and say so, where the readings of left-out lights are predicted by no model."""
    general, lambert = (solution.facts.get(name) for name in ("left_out_misfit", "left_out_misfit_lambert"))
    if general is None or lambert is None or is_supported(general, lambert) or min(general, lambert) < UNDESCRIBED:
        return
    raise_error(solution, DEGREES * min(general, lambert))
    solution.warnings.append("method svbrdf: the object reflects neither by Lambert's law nor with highlights, as velvet does not: the "
                             "normals are only as sure as the layer sigma says; a ball of its material tells more (--reference-ball)")
