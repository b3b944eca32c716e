"""The profile of each pixel's specular part: how far the captured images say that the solved lobe is too weak, too wide or too narrow.

One GGX lobe of a solved material is a fit of all angles at once, and real highlights have narrower peaks and wider tails. The specular
part is multiplied by c0 + c1 t² + c2 t⁸, where t = 1 / (1 + (tan θ_h / α)²) falls from 1 at the peak of the lobe: GGX's D is
proportional to t² / cos⁴ θ_h, so the terms are the lobe itself and two narrower ones. The coefficients are those of
least squares on what the captured images have beyond the model, with a normal prior around the coefficients of the whole object: where a
pixel's lights say little, it has the profile of the object. A term of each pixel's own diffuse part is eliminated first, so that a wrong
albedo is not taken for gloss.

Source: lobes as sums of narrower ones, Ashikhmin and Premože, "Distribution-based BRDFs", 2007; Bayesian linear regression, Bishop,
"Pattern Recognition and Machine Learning", equations 3.50 and 3.51.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels.device import once
from kernels.microfacet import INVERSE_PI
from kernels.pack_access import pack_load
from kernels.packs import bit_of, pack_type
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.guide import pooled
from kernels.relight.model.shading import lobes

TERMS = 4
"""Number of terms whose moments are taken: three of the profile, and the diffuse part."""
PLAIN = (1.0, 0.0, 0.0)
"""Profile of a specular part that is that of the BRDF."""
SPREAD = 1.0
"""Standard deviation of a pixel's coefficients around those of the object: a lobe may be stronger by its own strength."""
OBJECT_SPREAD = 10.0
"""Standard deviation of the object's coefficients around the plain profile, so wide that only terms that no light sees keep it."""
LEAST_FACING = 0.05
"""Least n·l of a light that counts: closer to grazing light, normals and shadows err more than the lobe."""
FLOOR = 1e-3
"""Least standard deviation of what the images have beyond the model, as a fraction of the object's specular part: half rounding."""
LEAST_VARIANCE = 1e-30
"""Variance that keeps a division finite where an object has no specular part."""
PRODUCTS = tuple((i, j) for i in range(TERMS) for j in range(i, TERMS))
"""Pairs of terms whose sums of products the moments hold."""
MOMENTS = len(PRODUCTS) + TERMS + 2
"""Number of sums of a pixel: products of terms, terms times residual, residual squared, and number of lights."""


def profile_moments(captured: Captured) -> wp.array:
    """Sum what the captured images, as grey, have beyond the model, against the terms of a profile: [MOMENTS, pixels padded] float32.

    The surface has the plain profile. Clipped readings count where they are brighter than the model all the same.
    """
    return captured.sums(_moments_kernel, MOMENTS)


def fit_profile(moments: np.ndarray, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return the profile of each pixel, [n, 3] float32 coefficients, from the moments [MOMENTS, n] of it and of its neighbours.

    Pixels are row-major positions in an image of this shape.
    """
    first = len(PRODUCTS)
    alone = moments.astype(np.float64)
    products = dict(zip(PRODUCTS, alone[:first], strict=True))
    against, matt = alone[first : first + TERMS], products[TERMS - 1, TERMS - 1]

    def without_diffuse(plane: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Return the mean over a pixel's window of sums [n] without what the diffuse term explains, from its sums with both factors."""
        kept = plane - np.divide(one * other, matt, out=np.zeros_like(plane), where=matt > 0)
        return pooled(pooled(kept, pixels, shape), pixels, shape) / beside

    # a mean and no sum, because what the images have beyond the model is much the same in neighbours: they are no evidence of their own
    beside = pooled(pooled(np.ones(len(pixels)), pixels, shape), pixels, shape)
    diffuse = [products[i, TERMS - 1] for i in range(TERMS - 1)]
    normal, right = np.empty((len(pixels), TERMS - 1, TERMS - 1)), np.empty((len(pixels), TERMS - 1))
    for i in range(TERMS - 1):
        right[:, i] = without_diffuse(against[i], diffuse[i], against[-1])
        for j in range(i, TERMS - 1):
            normal[:, i, j] = normal[:, j, i] = without_diffuse(products[i, j], diffuse[i], diffuse[j])
    lights = np.maximum(pooled(pooled(alone[-1], pixels, shape), pixels, shape) / beside, 1e-9)
    noise = without_diffuse(alone[-2], against[-1], against[-1]) / lights
    noise = np.maximum(noise, FLOOR**2 * (normal[:, 0, 0] / lights).mean() + LEAST_VARIANCE)
    normal, right = normal / noise[:, None, None], right / noise[:, None]
    whole = np.linalg.solve(normal.mean(axis=0) + np.eye(TERMS - 1) / OBJECT_SPREAD**2, right.mean(axis=0))
    prior = np.eye(TERMS - 1) / SPREAD**2
    fitted = np.linalg.solve(normal + prior, (right + prior @ whole)[..., None])[..., 0]
    return np.asarray(np.array(PLAIN) + fitted, dtype=np.float32)


@once
def _moments_kernel(pack: int) -> Any:
    lane_type, images_struct, evaluate = pack_type(pack, wp.float32), images_type(pack), lobes(pack)
    load, load_half, load_byte = (pack_load(pack, kind) for kind in (wp.float32, wp.float16, wp.uint8))
    sums_type = wp.types.matrix(shape=(MOMENTS, pack), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def moments_kernel(first: int,
                       images: images_struct,
                       # outputs
                       moments: wp.array2d(dtype=lane_type)):  # [MOMENTS, P]
        p = first + wp.tid()
        albedo_r = load(images.surface, 3, p)
        albedo_g = load(images.surface, 4, p)
        albedo_b = load(images.surface, 5, p)
        albedo = albedo_r + albedo_g + albedo_b
        sums = sums_type()
        for light in range(images.places.shape[0]):
            factor = images.factors[light]
            red = load_half(images.stored, light, p)
            green = load_half(images.stored, images.padded + light, p)
            blue = load_half(images.stored, 2 * images.padded + light, p)
            reading = lane_type()
            for k in range(pack):
                reading[k] = (factor[0] * float(red[k]) + factor[1] * float(green[k]) + factor[2] * float(blue[k])) / 3.0
            facing, gloss, _, peak = evaluate(images.surface, p, images.places[light], wp.vec4())
            bits = load_byte(images.clipped, light / 8, p)
            lit = load_byte(images.visible, light, p)
            for k in range(pack):
                seen = float(lit[k]) * wp.static(1.0 / (3.0 * 255.0))
                shine = seen * (gloss[0, k] + gloss[1, k] + gloss[2, k])
                matt = seen * albedo[k] * INVERSE_PI * facing[k]
                rest = reading[k] - matt - shine
                counts = wp.where(facing[k] < LEAST_FACING or (bit_of(bits[k], light) == 1 and rest < 0.0), 0.0, 1.0)
                rest = counts * rest
                shine = counts * shine
                matt = counts * matt
                square = peak[k] * peak[k]
                fourth = square * square
                terms = wp.vec4(shine, shine * square, shine * fourth * fourth, matt)
                row = wp.int32(0)
                for i in range(TERMS):
                    for j in range(i, TERMS):
                        sums[row, k] += terms[i] * terms[j]
                        row += 1
                for i in range(TERMS):
                    sums[row + i, k] += terms[i] * rest
                sums[row + TERMS, k] += rest * rest
                sums[row + TERMS + 1, k] += counts
        for row in range(wp.static(MOMENTS)):
            out = lane_type()
            for k in range(pack):
                out[k] = sums[row, k]
            moments[row, p] = out

    return moments_kernel
