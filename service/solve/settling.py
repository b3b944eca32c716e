"""Interreflection settled: the surface, its albedo and the light that it throws on itself are found again from each other.

Bounced light makes hollows look shallower, so that the first search underestimates form factors, and its albedo contains the bounce. One
pixel of each block is searched again in its direct light; what this changes is carried over to the block, and the arriving light follows
anew. Where the scale of the lights is unknown, the scale of albedo is chosen from the images in each round.

Source: Nayar, Ikeuchi and Kanade, "Shape from interreflections", IJCV 1991, section 4: shape and interreflection are corrected in turn.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from kernels.photometric.albedo_scale import ScaleFit, fit_albedo_scale
from kernels.photometric.descent import descend
from kernels.photometric.hypotheses import Diffuse
from kernels.photometric.readings import channel_weights
from kernels.photometric.samples import Samples, readings_of
from service.solve.direct_light import LARGEST_ALBEDO, DirectLight
from service.solve.interreflection import ArrivingLight, arriving_light
from stage.colour import GREY_WEIGHTS

BLOCKS = 2500
"""Most pixels that are searched again, each for a square block around it."""
ROUNDS = 2
"""Rounds: the third changes the scale of albedo by 1 %."""
LEAST_ALBEDO = 0.02
"""Pixels of less albedo say nothing of its scale: what they send on is mostly stray or specular."""
GROUPS = 12
"""Number of squares along the longer side of the image; the readings of a square err alike."""
SHADOW_PART = 0.1
"""Part of the mean of a pixel's readings below which a reading is not lit."""
BRIGHT_PERCENTILE = 95.0
"""Percentile of the albedo, over pixels and channels, that must stay below 1."""


class Settled(NamedTuple):
    """Interreflection after the rounds."""

    light: DirectLight
    scale: ScaleFit | None
    """None: it was not asked for, or the images do not decide it."""

    def report(self) -> dict[str, Any]:
        """Return what the report says about the scale of albedo."""
        if self.scale is None:
            return {"decided": False, "value": 1.0}
        brightest = float(np.percentile(self.light.albedo[:, self.light.solved.numpy().reshape(-1) > 0].max(axis=0), BRIGHT_PERCENTILE))
        value = min(self.scale.scale, LARGEST_ALBEDO / max(brightest, 1e-6))
        return {"decided": True, "value": round(value, 4), "sigma": round(max(self.scale.sigma, self.scale.scale - value), 4),
                "from_shadows": round(self.scale.scale, 4), "stray_light": round(self.scale.stray, 5), "readings": self.scale.readings}


def settle(light: DirectLight, normal: np.ndarray, shape: Diffuse, pick: Callable[[np.ndarray], Samples], *, relative: bool) -> Settled:
    """Find the light that an object throws on itself from the surface without it.

    Args:
        light: of the first search, with arriving light.
        normal: [3, pixels] of the first search.
        shape: of the diffuse lobe.
        pick: gives the readings of a few pixels by their positions.
        relative: whether the scale of the lights, and so of albedo, is unknown.
    """
    assert light.arriving is not None
    solved = light.solved.numpy() > 0
    pixels = np.flatnonzero(solved)
    block, middles = _blocks(pixels, light.given.camera.width)
    first, albedo, start = normal, light.albedo, normal[:, middles].T
    turned, whole = start, readings_of(pick(middles))
    for _ in range(ROUNDS):
        light = light._replace(albedo_scale=_value(_fit(light, middles, turned, whole)) if relative else 1.0)
        samples = pick(middles)
        light.keep(middles, samples)
        turned = descend(samples, start, shape=shape).normal
        again, dimmed = first.copy(), albedo.copy()
        again[:, pixels] = _turn(first[:, pixels].T, start[block], turned[block]).T
        dimmed[:, pixels] = albedo[:, pixels] * _direct_part(readings_of(samples), whole)[block]
        arriving = arriving_light(light.given, light.lights, again, light.height, solved)
        light = light._replace(arriving=arriving, albedo=dimmed)
    found = _fit(light, middles, turned, whole) if relative else None
    return Settled(light._replace(albedo_scale=_value(found)), found)


def _blocks(pixels: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return [n] the number of the square block that each pixel lies in, and [blocks] the pixel of each that is nearest its middle.

    Args:
        pixels: [n] row-major positions in the image, one or more.
        width: of the image.
    """
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


def _fit(light: DirectLight, pixels: np.ndarray, normal: np.ndarray, readings: np.ndarray) -> ScaleFit | None:
    """Fit the scale of albedo at some pixels of known normals [n, 3] and readings [n, lights]."""
    assert isinstance(light.arriving, ArrivingLight)
    weights = channel_weights(light.lights, GREY_WEIGHTS)
    albedo = light.albedo[:, pixels].T.astype(np.float64) * weights
    grey = albedo.sum(axis=1)[:, None]
    rows, cols = np.divmod(pixels, light.given.camera.width)
    corners, shares = light.arriving.at(rows, cols)
    arriving = np.einsum("nc,nk,nkcl->nl", albedo, shares, light.arriving.light[corners], optimize=True)
    ratio = np.where((readings >= 0) & (grey > LEAST_ALBEDO), readings.astype(np.float64) / np.maximum(grey, LEAST_ALBEDO), np.nan)
    square = max(light.given.mask.shape) / GROUPS
    group = (rows // square * (GROUPS + 1) + cols // square).astype(int)
    cosine = normal @ light.lights.direction[: readings.shape[1]].T
    return fit_albedo_scale(ratio, arriving / np.maximum(grey, LEAST_ALBEDO), cosine, group)


def _turn(normals: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return normals [n, 3], each turned by the least rotation that takes one unit vector to another; Rodrigues' formula."""
    axis, cosine = np.cross(before, after), (before * after).sum(axis=1, keepdims=True)
    along = axis * ((axis * normals).sum(axis=1, keepdims=True) / (1 + cosine))
    return normals * cosine + np.cross(axis, normals) + along


def _direct_part(direct: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """Return [n] the part of the lit readings [n, lights] that is direct light."""
    lit = (direct > 0) & (whole > SHADOW_PART * whole.mean(axis=1, keepdims=True))
    return np.where(lit, direct, 0).sum(axis=1) / np.maximum(np.where(lit, whole, 0).sum(axis=1), 1e-12)
