"""Diffuse normals and albedo from responses to spherical gradients.

Lambertian and convex: M₀ = ρ/π ∫ cos θ dω = ρ and M = ρ/π ∫ ω cos θ dω = (2/3) ρ n over the hemisphere about n, so the normal is
M/|M|, the albedo M₀, and (3/2)|M|/M₀ is one. Occlusion and light from neighbours make it less: the standard error says so.

Source: Ma et al., "Rapid Acquisition of Specular and Diffuse Normal Maps from Polarized Spherical Gradient Illumination",
EGSR 2007, section 3.1.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.packs import zeros
from kernels.photometric.gradient.moments import Moments
from kernels.status import DARK, ILL_POSED, OK

MIN_LENGTH = 0.05
"""Least (3/2)|M|/M₀ of a diffuse pixel: below it the pixel is equally bright from every side and the direction of M is noise."""
MAX_LENGTH = 1.5
"""Largest (3/2)|M|/M₀, that of light from a single direction: above it the readings contradict each other."""
PRIOR_GRADIENT_RESIDUAL = 0.01
"""Residual, relative to M₀, of one pseudo-observation that is added because four readings leave no residual, yet have noise. It is smaller
than that of single lights, because a gradient's reading is a mean over every lamp."""
ROUNDING = 2.0**-12
"""Relative rounding of a half reading: it may change the length of M although the fit leaves no residual."""


class GradientFit(NamedTuple):
    """Diffuse result of a band; the last axis is pixels, padded to whole packs. Only pixels with status OK have values."""

    normal: wp.array  # [3, pixels] float32, unit
    albedo: wp.array  # [3, pixels] float32, scene-linear
    sigma: wp.array  # [pixels] float32, standard error of the normal, degrees
    bent: wp.array  # [pixels] float32, the part of the standard error that a length other than one stands for, degrees
    length: wp.array  # [pixels] float32, (3/2)|M|/M₀: one on a convex Lambertian surface
    status: wp.array  # [pixels] int32, kernels.status.Status


def diffuse_normals(diffuse: Moments, grey_weights: tuple[float, float, float], *, gain: float, pixel_count: int,
                    device: str) -> GradientFit:
    """Estimate normal, albedo and standard error from diffuse responses; not synchronised on CUDA.

    Args:
        grey_weights: of the channels, for the normal; they add up to one.
        gain: diffuse light over what the frames hold of it: 2 behind a crossed analyser, else 1.

    Convention:
        σ² = 2 v s² (M₀/|M|)² + 2e + tilt², v the variance of M, s² the residual variance with
        one pseudo-observation of 1 %, and e how far (3/2)|M|/M₀ is from one, less twice what rounding and residual explain: light
        that is missing or added across the normal tilts M by δ and changes its length by δ²/2.
    """
    fit = GradientFit(zeros(pixel_count, wp.float32, device, rows=3), zeros(pixel_count, wp.float32, device, rows=3),
                      *(zeros(pixel_count, wp.float32, device) for _ in range(3)), zeros(pixel_count, wp.int32, device))
    devices.launch(_diffuse_kernel, pixel_count, [*diffuse, wp.vec3(*grey_weights), gain], fit, device=device)
    return fit


@wp.kernel(enable_backward=False, module="unique")
def _diffuse_kernel(first: int,
                    moments: wp.array2d(dtype=float),  # [12, N]
                    variance: wp.array(dtype=float),  # [N]
                    residual: wp.array(dtype=float),  # [N]
                    spare: wp.array(dtype=float),  # [N]
                    tilt: wp.array(dtype=float),  # [N]
                    solved: wp.array(dtype=int),  # [N]
                    grey: wp.vec3,
                    gain: float,
                    # outputs
                    normal: wp.array2d(dtype=float),  # [3, N]
                    albedo: wp.array2d(dtype=float),  # [3, N]
                    sigma: wp.array(dtype=float),  # [N]
                    bend: wp.array(dtype=float),  # [N]
                    length: wp.array(dtype=float),  # [N]
                    status: wp.array(dtype=int)):  # [N]
    p = first + wp.tid()
    status[p] = solved[p]
    if solved[p] != OK:
        return
    m0 = float(0.0)
    m = wp.vec3()
    for c in range(3):
        m0 += grey[c] * moments[4 * c, p]
        m += grey[c] * wp.vec3(moments[4 * c + 1, p], moments[4 * c + 2, p], moments[4 * c + 3, p])
    if m0 <= 0.0:
        status[p] = DARK
        return
    size = wp.length(m) / m0
    if 1.5 * size < MIN_LENGTH or 1.5 * size > MAX_LENGTH:
        status[p] = ILL_POSED
        return
    n = wp.normalize(m)
    for c in range(3):
        normal[c, p] = n[c]
        albedo[c, p] = gain * wp.max(moments[4 * c, p], 0.0)
    length[p] = 1.5 * size
    squares = (spare[p] + 4.0) * residual[p] * residual[p] + PRIOR_GRADIENT_RESIDUAL * PRIOR_GRADIENT_RESIDUAL
    noise = 2.0 * variance[p] * squares / ((spare[p] + 1.0) * size * size)
    explained = wp.static(2.0 * 1.5) * wp.sqrt(variance[p]) * (ROUNDING + residual[p])
    bent = 2.0 * wp.max(wp.abs(1.0 - 1.5 * size) - explained, 0.0)
    bend[p] = wp.degrees(wp.sqrt(bent))
    sigma[p] = wp.degrees(wp.sqrt(noise + bent + tilt[p] * tilt[p]))
