"""Light from beyond the captured lights, where nothing can be interpolated: how far away it is, and how far a model may be followed.

Plain sums let the nearest captured lights stand in for such light. A model of the surface says how much brighter or darker it leaves a
pixel. What it adds is added; what it takes away is taken as a share of the picture, so that a model that is too bright or that misses a
shadow does not turn a pixel black. How much of this to believe, β, is measured on the captured lights: each is predicted from a
light farther inside, as many degrees away as light that counts as wholly beyond.

Source: brightness as a ratio to that of an image under other light, Shashua and Riklin-Raviv, "The quotient image", TPAMI 2001; β is the
regression coefficient of a control variate, as in kernels.relight.model.guide.
"""

import math
from typing import Any

import numpy as np
import warp as wp

from kernels.device import once
from kernels.packs import bit_of, pack_type
from kernels.relight.directions.latlong import first_of_equals
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.shading import lobes, modelled

LONGEST_REACH = math.pi / 4
"""Largest reach, radians. With it, light that is 90 degrees from every captured light is wholly beyond them: a surface that faces it may
be in the dark under all of them."""


def spacing(direction: np.ndarray) -> float:
    """Return the angle between a captured light and its nearest neighbour, the median over the lights, in radians; π for a single light.

    Directions are [lights, 3] unit vectors; several in one place count as one.
    """
    kept = direction[first_of_equals(direction)]
    cosine = kept @ kept.T - 2 * np.eye(len(kept))
    return float(np.median(np.arccos(np.clip(cosine.max(axis=1), -1, 1))))


def reach(direction: np.ndarray) -> float:
    """Return how far from a captured light, in radians, other light counts as between the captured lights: their spacing, as far as leaving
    out a light tests; at most LONGEST_REACH."""
    return min(LONGEST_REACH, spacing(direction))


def share_beyond(direction: np.ndarray, samples: np.ndarray) -> np.ndarray:
    """Return how far samples of light lie beyond the captured lights: [n] float64 from 0 to 1, both given as unit vectors.

    It is 0 up to the reach of the nearest light, 1 from twice the reach on, linear in the angle between.
    """
    nearest = np.arccos(np.clip((direction @ samples.T).max(axis=0, initial=-1.0), -1, 1))
    return np.asarray(np.clip(nearest / reach(direction) - 1, 0, 1))


def inward_pairs(direction: np.ndarray) -> np.ndarray:
    """Return which captured light is predicted from which other one to test a model beyond the lights.

    The answer is [pairs, 2] int32: a light, and of the lights that are nearer to the mean direction the one whose angle from it is closest
    to twice the reach. The innermost light has none.
    """
    kept = first_of_equals(direction)
    towards = direction[kept]
    inner = towards @ towards.sum(axis=0)
    angle = np.arccos(np.clip(towards @ towards.T, -1, 1))
    off = np.where(inner[None, :] > inner[:, None], np.abs(angle - 2 * reach(direction)), np.inf)
    has = np.isfinite(off).any(axis=1)
    return np.stack([kept[has], kept[off[has].argmin(axis=1)]], axis=1).astype(np.int32)


def followed(change: np.ndarray, picture: np.ndarray, modelled_picture: np.ndarray) -> np.ndarray:
    """Return how a picture changes as a model of it does: a gain is added, a loss is a share of the picture.

    `change` is the model's, `modelled_picture` what the model has in place of the picture; a loss is no larger.
    """
    share = np.divide(picture, modelled_picture, out=np.zeros_like(picture), where=modelled_picture > 0)
    return np.where(change < 0, change * np.maximum(share, 0), change)


def trusted(change: np.ndarray, trust: np.ndarray, least: float) -> np.ndarray:
    """Return a change […, n] of pictures times β [n], of losses at least the median β of the object.

    In the highlights of the captured lights readings tell of these alone, and little trust left them as lit patches on dark sides. A loss
    is a share of the picture, and safer than a gain.
    """
    return np.where(change < 0, np.maximum(trust, least), trust) * change


def compare_beyond(captured: Captured, pairs: np.ndarray) -> wp.array:
    """Compare the model's changes from light to light with those of the captured images.

    Args:
        captured: images and model; pairs with a clipped reading do not count.
        pairs: [pairs, 2] of inward_pairs.

    Returns:
        [2, pixels padded] float32 on the device: Σ over pairs and channels of missing · told, and of told², where the image of the
        first light of a pair misses `missing` from that of the second, and `told` is what `followed` makes of the model's change.
    """
    return captured.sums(_compare_kernel, 2, wp.array(pairs, dtype=wp.vec2i, device=captured.surface.device))


@wp.func
def _told(before: float, after: float, reading: float) -> float:
    """Return what `followed` makes of a model's change."""
    change = after - before
    if change < 0.0:
        change = change * wp.max(reading, 0.0) / before
    return change


@once
def _compare_kernel(pack: int) -> Any:
    lane_type, images_struct, evaluate = pack_type(pack, wp.float32), images_type(pack), lobes(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def compare_kernel(first: int,
                       images: images_struct,
                       pairs: wp.array(dtype=wp.vec2i),  # [pairs] predicted light, light that it is predicted from
                       # outputs
                       sums: wp.array2d(dtype=lane_type)):  # [2, P]
        p = first + wp.tid()
        top, bottom = lane_type(), lane_type()
        for n in range(pairs.shape[0]):
            j, i = pairs[n][0], pairs[n][1]
            facing_j, gloss_j, _, _ = evaluate(images.surface, p, images.places[j], wp.vec4())
            facing_i, gloss_i, _, _ = evaluate(images.surface, p, images.places[i], wp.vec4())
            lit_j = images.visible[j, p]
            lit_i = images.visible[i, p]
            bits_j = images.clipped[j / 8, p]
            bits_i = images.clipped[i / 8, p]
            for c in range(3):
                albedo = images.surface[3 + c, p]
                image_j = images.stored[c * images.padded + j, p]
                image_i = images.stored[c * images.padded + i, p]
                factor_j, factor_i = images.factors[j][c], images.factors[i][c]
                for k in range(pack):
                    after = modelled(float(lit_j[k]) * wp.static(1.0 / 255.0), albedo[k], facing_j[k], gloss_j[c, k])
                    before = modelled(float(lit_i[k]) * wp.static(1.0 / 255.0), albedo[k], facing_i[k], gloss_i[c, k])
                    reading = factor_i * float(image_i[k])
                    missing = factor_j * float(image_j[k]) - reading
                    told = _told(before, after, reading)
                    told = wp.where(bit_of(bits_j[k], j) + bit_of(bits_i[k], i) > 0, 0.0, told)
                    top[k] += missing * told
                    bottom[k] += told * told
        sums[0, p] = top
        sums[1, p] = bottom

    return compare_kernel
