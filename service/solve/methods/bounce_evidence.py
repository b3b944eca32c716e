"""What readings say about the light that arrives at an object from other surfaces: whether there is any, how strong it is, and which of
several surfaces out of sight it comes from.

One pixel of each block is searched with that light taken out. Its readings in shadow tell the light itself, its lit ones by what they cost.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.model.samples import Samples, evenly, readings_of
from kernels.photometric.search.descent import Descent, descend
from kernels.photometric.search.hypotheses import LobeShape
from service.solve.height.direct_light import DirectLight
from service.solve.methods.shadow_light import ScaleFit, ShadowReadings, fit_albedo_scale, readings_in_shadow

BLOCKS = 2500
"""Most pixels that are searched again, each for a square block around it."""
BETTER, LEAST_GAIN = 0.9, 5e-4
"""Part of the cost with bounced light taken out below which that of the whole readings shows that there is none, and the least difference,
where the scale of the lights is unknown: the part is 0.6 to 0.75 in folds and grooves as a renderer of direct light shows them, 0.97 and
above where light bounces. A groove of two planes that all lights reach looks the same with bounced light and without, to 4e-5."""
DENIED, NOT_WORSE = 1.08, 1.05
"""Cost with twice the bounced light taken out, over that with once, above which lit readings show that there is none, where the scale of
the lights is known: 1.10 to 1.32 in folds as a renderer of direct light shows them, 0.82 to 1.06 where light bounces. In a white bowl it
is 3, so without it the cost must not be larger than this: it is 0.84 to 1.03 in such folds, and 8 in the bowl."""
LARGEST_STRENGTH = 3.0
"""Largest strength that is taken from shadows under lights of a known scale: they show 1.2 to 2.2 where light bounces, and 4 to 100 where
hardly any is expected."""
TRIED = (1.0, 1.5, 2.0, 3.0)
"""Strengths of which lit readings choose. Their cost falls until it is 1.5 to 2.5 times what arrives, and hardly rises beyond, because no
reading falls below zero: where half of the fall is reached, normals of glossy folds are best, or within a tenth of it. Images without
bounced light cost more at every strength above 1."""
COUNTED = 400
"""Most blocks whose cost tells a strength."""
LEAST_FALL = 0.03
"""Part of the cost that a strength above 1 must save: 3 to 27 % in folds of dielectrics, 1 to 2.5 % where metals mirror each other."""
COST_TEMPERATURE = 0.05
"""Softmax temperature of the cost of ways in which light may arrive, relative to the least one: a groove that ends with the image costs .4
more with light from beyond it, parts that are cut from folds cost .02 to .1 less with that of the way that is next to the truth."""


class Middles(NamedTuple):
    """The solved pixels in square blocks, and one pixel of each block."""

    solved: np.ndarray  # [rows, cols] bool
    block: np.ndarray  # [solved] number of the block of each
    pixels: np.ndarray  # [blocks] position of the pixel nearest to the middle of each
    readings: np.ndarray  # [blocks, lights] of that pixel


def middles_of(light: DirectLight, pick: Callable[[np.ndarray], Samples]) -> Middles:
    """Return the middles of the blocks of an object. `pick`: gives the readings of a few pixels by their positions."""
    solved = to_numpy(light.solved) > 0
    block, pixels = _blocks(np.flatnonzero(solved), light.given.camera.width)
    return Middles(solved, block, pixels, readings_of(pick(pixels)))


class Evidence(NamedTuple):
    """The middles of the blocks, of which readings are asked."""

    within: Middles
    normal: np.ndarray  # [blocks, 3] found so far
    shape: LobeShape
    pick: Callable[[np.ndarray], Samples]
    """Gives the readings of a few pixels by their positions."""
    relative: bool
    """Whether the scale of the lights, and so of albedo, is unknown."""

    def searched(self, light: DirectLight) -> tuple[Samples, np.ndarray]:
        """Return the readings in direct light, and the normals [blocks, 3] that they have."""
        samples, found = _searched(light, self.within.pixels, self.normal, self.shape, self.pick)
        return samples, found.normal

    def in_shadow(self, light: DirectLight) -> ShadowReadings:
        """Return what readings in shadow tell."""
        return readings_in_shadow(light, self.within.pixels, self.normal, self.within.readings)

    def cost_of(self, light: DirectLight) -> Callable[[float], float]:
        """Return what tells the mean cost of some of the middles by the strength of the arriving light, and measures each strength once."""
        some = evenly(len(self.normal), COUNTED)

        def cost(strength: float) -> float:
            arriving = light._replace(albedo_scale=strength) if strength else light._replace(arriving=None)
            found = _searched(arriving, self.within.pixels[some], self.normal[some], self.shape, self.pick)[1]
            return float(found.cost.mean(dtype=np.float64))

        return cache(cost)

    def with_strength(self, light: DirectLight, cost: Callable[[float], float]) -> tuple[DirectLight, ScaleFit | None]:
        """Return the light with the strength that shadows and lit readings show, and the fit by shadows. `cost`: of `cost_of`."""
        fit = fit_albedo_scale(*self.in_shadow(light))
        if self.relative:
            return light._replace(albedo_scale=1.0 if fit is None else fit.scale), fit
        lit = _shown_by_lit(cost)
        if fit is None:
            return light._replace(albedo_scale=lit or 1.0), None
        fit = fit._replace(scale=min(fit.scale, LARGEST_STRENGTH))
        return light._replace(albedo_scale=fit.scale if lit is None else max(fit.scale, (fit.scale + lit) / 2)), fit

    def likelihoods(self, light: DirectLight, ways: np.ndarray, likely: np.ndarray) -> np.ndarray:
        """Return the likelihood of each way [ways] in which more light may arrive, [ways, patches, 3, lights]. `likely`: [ways], before the
        readings are asked."""
        costs, lacking = np.zeros(len(ways)), np.zeros(len(ways))
        for number, way in enumerate(ways):
            cost = self.cost_of(light.with_more(way))
            found, fit = self.with_strength(light.with_more(way), cost)
            costs[number] = cost(found.albedo_scale)
            if fit is not None and not self.relative:
                lacking[number] = max(1 - fit.scale, 0) / fit.sigma
        return weighed(likely, costs, lacking)


def weighed(likely: np.ndarray, costs: np.ndarray, lacking: np.ndarray) -> np.ndarray:
    """Return the likelihood of each way, [ways], by that before the readings were asked, the cost of readings with its light, and the
    standard errors that shadows lack of that light: gloss and what is out of sight add to the light of form factors, and nothing takes from
    it."""
    dearer = (costs - costs.min()) / max(COST_TEMPERATURE * float(costs.min()), 1e-12)
    weights = likely * np.exp(-dearer - (lacking**2 - lacking.min()**2) / 2)
    return weights / weights.sum()


def _searched(light: DirectLight, pixels: np.ndarray, start: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples]
              ) -> tuple[Samples, Descent]:
    """Return the readings of some pixels in direct light, and their descents from `start` [n, 3]."""
    samples = pick(pixels)
    light.keep(pixels, samples)
    return samples, descend(samples, start, shape=shape)


def is_lit_by_bounces(cost: Callable[[float], float], *, relative: bool) -> bool:
    """Return whether lit readings leave it possible that light has bounced. `cost`: of `Evidence.cost_of`. `relative`: as of that."""
    once, without = cost(1.0), cost(0.0)
    if relative:
        return without >= min(BETTER * once, once - LEAST_GAIN)
    return without > NOT_WORSE * once or cost(2.0) <= max(DENIED * once, once + LEAST_GAIN)


def _shown_by_lit(cost: Callable[[float], float]) -> float | None:
    """Return the strength of the arriving light that lit readings show, or None where it is not above 1. `cost`: of `Evidence.cost_of`."""
    costs = [cost(each) for each in TRIED]
    if min(costs) >= min((1 - LEAST_FALL) * costs[0], costs[0] - LEAST_GAIN):
        return None
    half = (costs[0] + min(costs)) / 2
    at = next(number for number, cost in enumerate(costs) if cost <= half)
    return float(np.interp(half, costs[at - 1:at + 1][::-1], TRIED[at - 1:at + 1][::-1]))


def _blocks(pixels: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [n] the number of the square block that each pixel lies in, and [blocks] the pixel of each that is nearest its middle."""
    side = max(1, math.ceil(math.sqrt(len(pixels) / BLOCKS)))
    rows, cols = np.divmod(pixels, width)
    number = rows // side * width + cols // side
    middle = (side - 1) / 2
    order = np.lexsort(((rows % side - middle) ** 2 + (cols % side - middle) ** 2, number))
    _, first, block = np.unique(number[order], return_index=True, return_inverse=True)
    back = np.empty_like(block)
    back[order] = block
    return back, pixels[order[first]]
