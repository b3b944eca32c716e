"""Interreflection settled: the surface, its albedo and the light that it throws on itself are found again from each other.

Bounced light makes hollows look shallower, so that the first search underestimates form factors, and its albedo contains the bounce. One
pixel of each block is searched again in its direct light; what this changes is carried over to the block, and the arriving light follows
anew. In each round shadows and lit readings say how strong the arriving light is: gloss, which sends most of it where light falls, and
surfaces that the camera does not see add to that of the form factors, and where the scale of the lights is unknown, so is that of albedo,
which shadows alone tell. Where shadows show no bounced light, or none falls and lit readings deny it, none is taken out at all.

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991, section 4: shape and interreflection are corrected in turn.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from kernels.device import to_numpy
from kernels.photometric.model.samples import Samples, evenly, readings_of
from kernels.photometric.search.descent import Descent, descend
from kernels.photometric.search.hypotheses import LobeShape
from service.light_estimation.lambertian import degrees_between
from service.solve.height.beyond import light_from_beyond, likelihoods
from service.solve.height.direct_light import DirectLight
from service.solve.height.height import projection_of
from service.solve.height.interreflection import patches_of
from service.solve.methods.shadow_light import (
    RELATIVE_NOISE,
    ScaleFit,
    fit_albedo_scale,
    has_bounced,
    largest_scale,
    readings_in_shadow,
    shown_bounce,
)

BLOCKS = 2500
"""Most pixels that are searched again, each for a square block around it."""
ROUNDS = 2
"""Rounds: the third changes the scale of albedo by 1 %."""
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
UNKNOWN_STRENGTH = 0.5
"""Relative error of the strength where shadows do not tell it: 1.2 to 2.5 times the light of the form factors arrives in glossy folds, and
1.0 to 1.2 times in matt ones."""
TOLD_DEGREES = 3.0
"""Turn by light from beyond the image from which on it is said: it is 1.7 to 8.5° in folds that fill the image."""
NEIGHBOURS = 5
"""Blocks, of which the median tells by how much an unknown strength turns normals: one pixel alone may jump to another normal."""
SHADOW_PART = 0.1
"""Part of the mean of a pixel's readings below which a reading is not lit."""


class Settled(NamedTuple):
    """Interreflection after the rounds, or without them where none is to be taken out or near lights settle it with the surface."""

    light: DirectLight
    shown: float | None
    """What shadows show of it, of `shown_bounce`."""
    rounds: bool = False
    scale: ScaleFit | None = None
    """The fit by shadows of the scale of albedo, or of the light that arrives; None where they do not decide it."""
    degrees: np.ndarray | float = 0.0
    """By how much its unknown strength, and what may arrive from beyond the image, turn the normals, [pixels] float32."""
    beyond: float | None = None
    """The 95th percentile of the latter alone, degrees; None where the surface reaches no border of the image."""

    def report(self, *, relative: bool) -> dict[str, Any]:
        """Return what the report says about bounced light, and, where the lights are `relative`, about the scale of albedo."""
        told: dict[str, Any] = {"taken_out": self.light.arriving is not None}
        if self.shown is not None:
            told["shown"] = round(self.shown, 3)
        if self.rounds:
            told["strength"] = round(self.light.albedo_scale, 3)
        if self.beyond is not None:
            told["beyond_image_degrees"] = round(self.beyond, 2)
        return {"bounced_light": told} | ({"albedo_scale": self._albedo_scale()} if self.rounds and relative else {})

    def warnings(self) -> list[str]:
        """Return what there is to say of light from beyond the image."""
        if self.beyond is None or self.beyond <= TOLD_DEGREES:
            return []
        return [f"the surface goes on beyond the image, and light that bounces there may turn normals by {self.beyond:.0f}°, which sigma "
                "holds: take more of it into the picture"]

    def _albedo_scale(self) -> dict[str, Any]:
        if self.scale is None:
            return {"decided": False, "value": 1.0}
        value = min(self.scale.scale, largest_scale(self.light))
        return {"decided": True, "value": round(value, 4), "sigma": round(max(self.scale.sigma, self.scale.scale - value), 4),
                "from_shadows": round(self.scale.scale, 4), "stray_light": round(self.scale.stray, 5), "readings": self.scale.readings}


class Middles(NamedTuple):
    """The solved pixels in square blocks, and one pixel of each block."""

    solved: np.ndarray  # [rows, cols] bool
    block: np.ndarray  # [solved] number of the block of each
    pixels: np.ndarray  # [blocks] position of the pixel nearest to the middle of each
    readings: np.ndarray  # [blocks, lights] of that pixel


def _middles_of(light: DirectLight, pick: Callable[[np.ndarray], Samples]) -> Middles:
    """Return the middles of the blocks of an object. `pick`: gives the readings of a few pixels by their positions."""
    solved = to_numpy(light.solved) > 0
    block, pixels = _blocks(np.flatnonzero(solved), light.given.camera.width)
    return Middles(solved, block, pixels, readings_of(pick(pixels)))


def settle(light: DirectLight, normal: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples], *, relative: bool,
           direct: bool) -> Settled:
    """Find the light that an object throws on itself from the surface without it.
    `light`: of a first search, with arriving light, as `normal` [3, pixels] is. `pick`: gives the readings of a few pixels by their
    positions. `relative`: whether the scale of the lights, and so of albedo, is unknown. `direct`: whether `light` and `normal` are of an
    earlier solution, whose albedo holds no bounced light."""
    within = _middles_of(light, pick)
    shown = shown_bounce(*readings_in_shadow(light, within.pixels, normal[:, within.pixels].T, within.readings))
    cost = _cost_of(light, within.pixels, normal[:, within.pixels].T, shape, pick)
    bounced = _is_lit_by_bounces(cost, relative=relative) if shown is None else has_bounced(light, shown)
    if not bounced:
        return Settled(light._replace(arriving=None), shown)
    return _in_rounds(light, normal, shape, pick, within, cost, relative=relative, direct=direct)._replace(shown=shown)


def _searched(light: DirectLight, pixels: np.ndarray, start: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples]
              ) -> tuple[Samples, Descent]:
    """Return the readings of some pixels in direct light, and their descents from `start` [n, 3]."""
    samples = pick(pixels)
    light.keep(pixels, samples)
    return samples, descend(samples, start, shape=shape)


def _cost_of(light: DirectLight, pixels: np.ndarray, start: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples]
             ) -> Callable[[float], float]:
    """Return what tells the mean cost of some of these pixels by the strength of the arriving light, and measures each strength once;
    parameters as of `_searched`."""
    some = evenly(len(pixels), COUNTED)

    def cost(strength: float) -> float:
        arriving = light._replace(albedo_scale=strength) if strength else light._replace(arriving=None)
        return float(_searched(arriving, pixels[some], start[some], shape, pick)[1].cost.mean(dtype=np.float64))

    return cache(cost)


def _is_lit_by_bounces(cost: Callable[[float], float], *, relative: bool) -> bool:
    """Return whether lit readings leave it possible that light has bounced. `cost`: of `_cost_of`. `relative`: as of `settle`."""
    once, without = cost(1.0), cost(0.0)
    if relative:
        return without >= min(BETTER * once, once - LEAST_GAIN)
    return without > NOT_WORSE * once or cost(2.0) <= max(DENIED * once, once + LEAST_GAIN)


def _shown_by_lit(cost: Callable[[float], float]) -> float | None:
    """Return the strength of the arriving light that lit readings show, or None where it is not above 1. `cost`: of `_cost_of`."""
    costs = [cost(each) for each in TRIED]
    if min(costs) >= min((1 - LEAST_FALL) * costs[0], costs[0] - LEAST_GAIN):
        return None
    half = (costs[0] + min(costs)) / 2
    at = next(number for number, cost in enumerate(costs) if cost <= half)
    return float(np.interp(half, costs[at - 1:at + 1][::-1], TRIED[at - 1:at + 1][::-1]))


def _in_rounds(light: DirectLight, normal: np.ndarray, shape: LobeShape, pick: Callable[[np.ndarray], Samples], within: Middles,
               cost: Callable[[float], float], *, relative: bool, direct: bool) -> Settled:
    """Return the light after the rounds. `cost`: of `_cost_of`, before them. Others as of `settle`."""
    assert light.arriving is not None
    solved, block, middles, whole = within
    pixels = np.flatnonzero(solved)
    first, albedo, start, camera = normal, light.albedo, normal[:, middles].T, light.given.camera
    directions, turned = light.lights.direction[:light.given.stack.light_count], start
    beyond: np.ndarray | None = None

    def with_strength(light: DirectLight, cost: Callable[[float], float]) -> tuple[DirectLight, ScaleFit | None]:
        """Return the light with the strength that shadows and lit readings show now, and the fit by shadows."""
        fit = fit_albedo_scale(*readings_in_shadow(light, middles, turned, whole))
        if relative:
            return light._replace(albedo_scale=1.0 if fit is None else fit.scale), fit
        lit = _shown_by_lit(cost)
        if fit is None:
            return light._replace(albedo_scale=lit or 1.0), None
        fit = fit._replace(scale=min(fit.scale, LARGEST_STRENGTH))
        return light._replace(albedo_scale=fit.scale if lit is None else max(fit.scale, (fit.scale + lit) / 2)), fit

    def shown_beyond(light: DirectLight, ways: np.ndarray) -> np.ndarray:
        """Return the likelihood of each of `ways` to go on beyond the image, by what readings say with its light."""
        costs, lacking = np.zeros(len(ways)), np.zeros(len(ways))
        for number, way in enumerate(ways):
            cost = _cost_of(light.with_more(way), middles, turned, shape, pick)
            found, fit = with_strength(light.with_more(way), cost)
            costs[number] = cost(found.albedo_scale)
            if fit is not None and not relative:
                lacking[number] = max(1 - fit.scale, 0) / fit.sigma
        return likelihoods(costs, lacking)

    for _ in range(ROUNDS):
        light, _ = with_strength(light, cost)
        samples, found = _searched(light, middles, start, shape, pick)
        turned = found.normal
        again, dimmed = first.copy(), albedo.copy()
        again[:, pixels] = _turn(first[:, pixels].T, start[block], turned[block]).T
        if not direct:
            dimmed[:, pixels] = albedo[:, pixels] * _direct_part(readings_of(samples), whole)[block]
        patches = patches_of(light.given, light.lights, again, light.height, solved)
        light = light._replace(arriving=None if patches is None else patches.arriving(light.height, projection_of(camera)), albedo=dimmed)
        beyond = None if patches is None else light_from_beyond(patches, camera, directions, light.height, solved)
        if beyond is not None:
            taken = np.tensordot(shown_beyond(light, beyond), beyond, 1)
            light, beyond = light.with_more(taken), beyond - taken
        cost = _cost_of(light, middles, turned, shape, pick)
    settled, fit = with_strength(light, cost)
    unknown = UNKNOWN_STRENGTH if fit is None else math.hypot(RELATIVE_NOISE, fit.sigma / fit.scale, settled.albedo_scale / fit.scale - 1)
    doubted = [settled._replace(albedo_scale=(1 + unknown) * settled.albedo_scale)]
    doubted += [] if beyond is None else [settled.with_more(way) for way in beyond]
    now, *others = (_searched(each, middles, turned, shape, pick)[1].normal.T for each in (settled, *doubted))
    places = np.stack(np.divmod(middles, camera.width), axis=1)
    nearest = cKDTree(places).query(places, k=range(1, min(NEIGHBOURS, len(places)) + 1))[1]
    strength, *ways = (np.median(degrees_between(now, other)[nearest], axis=1) for other in others)
    goes_on = np.sqrt(np.mean(np.square(ways), axis=0)) if ways else np.zeros(len(middles))
    degrees = np.zeros(solved.size, np.float32)
    degrees[pixels] = np.hypot(strength, goes_on)[block]
    return Settled(settled, None, True, fit, degrees, float(np.percentile(goes_on, 95)) if ways else None)


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


def _turn(normals: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return normals [n, 3], each turned by the least rotation that takes one unit vector to another; Rodrigues' formula."""
    axis, cosine = np.cross(before, after), (before * after).sum(axis=1, keepdims=True)
    along = axis * ((axis * normals).sum(axis=1, keepdims=True) / (1 + cosine))
    return normals * cosine + np.cross(axis, normals) + along


def _direct_part(direct: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return [n] the part of the lit readings [n, lights] that is direct light."""
    lit = (direct > 0) & (whole > SHADOW_PART * whole.mean(axis=1, keepdims=True))
    return np.where(lit, direct, 0).sum(axis=1) / np.maximum(np.where(lit, whole, 0).sum(axis=1), 1e-12)
