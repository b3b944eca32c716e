"""Interreflection settled: the surface, its albedo and the light that it throws on itself are found again from each other.

Bounced light makes hollows look shallower, so that the first search underestimates form factors, and its albedo contains the bounce. One
pixel of each block is searched again in its direct light; what this changes is carried over to the block, and the arriving light follows
anew. Where the scale of the lights is unknown, the scale of albedo is chosen from the images in each round. Where shadows show no bounced
light, none is taken out at all.

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991, section 4: shape and interreflection are corrected in turn.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.photometric.model.samples import Samples, readings_of
from kernels.photometric.search.descent import descend
from kernels.photometric.search.hypotheses import Diffuse
from service.solve.height.direct_light import DirectLight
from service.solve.height.interreflection import arriving_light
from service.solve.methods.shadow_light import ScaleFit, fit_albedo_scale, has_bounced, largest_scale, readings_in_shadow, shown_bounce

BLOCKS = 2500
"""Most pixels that are searched again, each for a square block around it."""
ROUNDS = 2
"""Rounds: the third changes the scale of albedo by 1 %."""
SHADOW_PART = 0.1
"""Part of the mean of a pixel's readings below which a reading is not lit."""


class Settled(NamedTuple):
    """Interreflection after the rounds."""

    light: DirectLight
    scale: ScaleFit | None
    """None: it was not asked for, or the images do not decide it."""

    def report(self) -> dict[str, Any]:
        """Return what the report says about the scale of albedo."""
        if self.scale is None:
            return {"decided": False, "value": 1.0}
        value = min(self.scale.scale, largest_scale(self.light))
        return {"decided": True, "value": round(value, 4), "sigma": round(max(self.scale.sigma, self.scale.scale - value), 4),
                "from_shadows": round(self.scale.scale, 4), "stray_light": round(self.scale.stray, 5), "readings": self.scale.readings}


class Middles(NamedTuple):
    """The solved pixels in square blocks, and one pixel of each block."""

    solved: np.ndarray  # [pixels] bool
    block: np.ndarray  # [solved] number of the block of each
    pixels: np.ndarray  # [blocks] position of the pixel nearest to the middle of each
    readings: np.ndarray  # [blocks, lights] of that pixel


def middles_of(light: DirectLight, pick: Callable[[np.ndarray], Samples]) -> Middles:
    """Return the middles of the blocks of an object. `pick`: gives the readings of a few pixels by their positions."""
    solved = to_numpy(light.solved) > 0
    block, pixels = _blocks(np.flatnonzero(solved), light.given.camera.width)
    return Middles(solved, block, pixels, readings_of(pick(pixels)))


def as_shown(light: DirectLight, normal: np.ndarray, middles: Middles) -> tuple[DirectLight, float | None]:
    """Return the light of a first search without its arriving part where shadows show none; and what they show, of `shown_bounce`.
    `normal`: [3, pixels]."""
    shown = shown_bounce(*readings_in_shadow(light, middles.pixels, normal[:, middles.pixels].T, middles.readings))
    return (light if has_bounced(light, shown) else light._replace(arriving=None)), shown


def settle(light: DirectLight, normal: np.ndarray, shape: Diffuse, pick: Callable[[np.ndarray], Samples], within: Middles, *,
           relative: bool) -> Settled:
    """Find the light that an object throws on itself from the surface without it.
    `light`: of the first search, with arriving light, as `normal` [3, pixels] is. `pick`: as for `middles_of`, of which `within` is.
    `relative`: whether the scale of the lights, and so of albedo, is unknown."""
    assert light.arriving is not None
    solved, block, middles, whole = within
    pixels = np.flatnonzero(solved)
    first, albedo, start = normal, light.albedo, normal[:, middles].T
    turned = start
    for _ in range(ROUNDS):
        fit = fit_albedo_scale(*readings_in_shadow(light, middles, turned, whole)) if relative else None
        light = light._replace(albedo_scale=_value(fit))
        samples = pick(middles)
        light.keep(middles, samples)
        turned = descend(samples, start, shape=shape).normal
        again, dimmed = first.copy(), albedo.copy()
        again[:, pixels] = _turn(first[:, pixels].T, start[block], turned[block]).T
        dimmed[:, pixels] = albedo[:, pixels] * _direct_part(readings_of(samples), whole)[block]
        arriving = arriving_light(light.given, light.lights, again, light.height, solved)
        light = light._replace(arriving=arriving, albedo=dimmed)
    found = fit_albedo_scale(*readings_in_shadow(light, middles, turned, whole)) if relative else None
    return Settled(light._replace(albedo_scale=_value(found)), found)


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


def _value(fit: ScaleFit | None) -> float:
    """Return the scale, or 1 where the images do not decide it."""
    return 1.0 if fit is None else fit.scale


def _turn(normals: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return normals [n, 3], each turned by the least rotation that takes one unit vector to another; Rodrigues' formula."""
    axis, cosine = np.cross(before, after), (before * after).sum(axis=1, keepdims=True)
    along = axis * ((axis * normals).sum(axis=1, keepdims=True) / (1 + cosine))
    return normals * cosine + np.cross(axis, normals) + along


def _direct_part(direct: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return [n] the part of the lit readings [n, lights] that is direct light."""
    lit = (direct > 0) & (whole > SHADOW_PART * whole.mean(axis=1, keepdims=True))
    return np.where(lit, direct, 0).sum(axis=1) / np.maximum(np.where(lit, whole, 0).sum(axis=1), 1e-12)
