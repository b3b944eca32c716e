"""Diffuse normals and albedo from responses to spherical gradients.

Lambertian and convex: M₀ = ρ/π ∫ cos θ dω = ρ and M = ρ/π ∫ ω cos θ dω = (2/3) ρ n over the hemisphere about n, so the normal is
M/|M|, the albedo M₀, and (3/2)|M|/M₀ is one. Occlusion and light from neighbours make it less: the confidence says so.

Source: Ma et al., "Rapid Acquisition of Specular and Diffuse Normal Maps from Polarized Spherical Gradient Illumination",
EGSR 2007, section 3.1.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.packs import as_packs, pack_type, scalars
from kernels.photometric.moments import Moments
from kernels.status import DARK, ILL_POSED, OK

MIN_LENGTH = 0.05
"""Least (3/2)|M|/M₀: below, the pixel is as bright from every side and the direction of M is noise."""
MAX_LENGTH = 1.5
"""Largest: (3/2)|M|/M₀ of light from one direction alone; above, the readings contradict each other."""
PRIOR_RESIDUAL = 0.01
"""One pseudo-observation with this residual, relative to M₀: four readings leave no residual, yet are not certain. Smaller than
that of single lights, because a gradient's reading is a mean over every lamp."""
ROUNDING = 2.0**-12
"""Of a half reading, relative: what the length of M may be off by although the fit leaves no residual."""
CONFIDENCE_HALF = 0.01745329
"""Standard error of the normal, radians (one degree), at which confidence is one half."""


class GradientFit(NamedTuple):
    """Diffuse result of a band; the last axis is pixels, padded to whole packs. Only pixels with status OK have values."""

    normal: wp.array  # [3, pixels] float32, unit
    albedo: wp.array  # [3, pixels] float32, scene-linear
    confidence: wp.array  # [pixels] float32, 0…1
    length: wp.array  # [pixels] float32, (3/2)|M|/M₀: one on a convex Lambertian surface
    status: wp.array  # [pixels] int32, kernels.status.Status


def diffuse_normals(diffuse: Moments, grey_weights: tuple[float, float, float], *, gain: float, pixel_count: int,
                    device: str) -> GradientFit:
    """Normal, albedo and confidence from diffuse responses.

    Args:
        diffuse: the responses.
        grey_weights: of the channels, for the normal; they add up to one.
        gain: diffuse light over what the frames hold of it: 2 behind a crossed analyser, else 1.
        pixel_count: pixels of the band.
        device: where the responses are.

    Returns:
        The fit on the device; not synchronised on CUDA.

    Convention:
        confidence = 1 / (1 + σ/1°) with σ² = 2 v s² (M₀/|M|)² + 2e + tilt², v the variance of M, s² the residual variance with
        one pseudo-observation of 1 %, and e how far (3/2)|M|/M₀ is from one, less twice what rounding and residual explain: light
        that is missing or added across the normal tilts M by δ and changes its length by δ²/2.
    """
    fit = GradientFit(scalars(pixel_count, 3, wp.float32, device), scalars(pixel_count, 3, wp.float32, device),
                      scalars(pixel_count, None, wp.float32, device), scalars(pixel_count, None, wp.float32, device),
                      scalars(pixel_count, None, wp.int32, device))
    inputs = [as_packs(array, device) for array in diffuse]
    devices.launch(_diffuse_kernel(devices.pack_width(device)), inputs[0].shape[1], [*inputs, wp.vec3(*grey_weights), gain],
                   [as_packs(array, device) for array in fit], device=device)
    return fit


@cache
def _diffuse_kernel(pack: int) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def diffuse_kernel(first: int,
                       moments: wp.array2d(dtype=float_pack),  # [12, P]
                       variance: wp.array(dtype=float_pack),  # [P]
                       residual: wp.array(dtype=float_pack),  # [P]
                       spare: wp.array(dtype=float_pack),  # [P]
                       tilt: wp.array(dtype=float_pack),  # [P]
                       solved: wp.array(dtype=int_pack),  # [P]
                       grey: wp.vec3,
                       gain: float,
                       # outputs
                       normal: wp.array2d(dtype=float_pack),  # [3, P]
                       albedo: wp.array2d(dtype=float_pack),  # [3, P]
                       confidence: wp.array(dtype=float_pack),  # [P]
                       length: wp.array(dtype=float_pack),  # [P]
                       status: wp.array(dtype=int_pack)):  # [P]
        p = first + wp.tid()
        r0, rx, ry, rz = moments[0, p], moments[1, p], moments[2, p], moments[3, p]
        g0, gx, gy, gz = moments[4, p], moments[5, p], moments[6, p], moments[7, p]
        b0, bx, by, bz = moments[8, p], moments[9, p], moments[10, p], moments[11, p]
        spread, off, beyond, hidden, code = variance[p], residual[p], spare[p], tilt[p], solved[p]
        nx, ny, nz, red, green, blue = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        sure, ratio = float_pack(), float_pack()
        for k in range(pack):
            m0 = grey[0] * r0[k] + grey[1] * g0[k] + grey[2] * b0[k]
            m = (grey[0] * wp.vec3(rx[k], ry[k], rz[k]) + grey[1] * wp.vec3(gx[k], gy[k], gz[k])
                 + grey[2] * wp.vec3(bx[k], by[k], bz[k]))
            if code[k] == OK and m0 <= 0.0:
                code[k] = DARK
            if code[k] == OK:
                size = wp.length(m) / m0
                if 1.5 * size < MIN_LENGTH or 1.5 * size > MAX_LENGTH:
                    code[k] = ILL_POSED
                else:
                    n = wp.normalize(m)
                    nx[k] = n[0]
                    ny[k] = n[1]
                    nz[k] = n[2]
                    red[k] = gain * wp.max(r0[k], 0.0)
                    green[k] = gain * wp.max(g0[k], 0.0)
                    blue[k] = gain * wp.max(b0[k], 0.0)
                    ratio[k] = 1.5 * size
                    squares = (beyond[k] + 4.0) * off[k] * off[k] + PRIOR_RESIDUAL * PRIOR_RESIDUAL
                    noise = 2.0 * spread[k] * squares / ((beyond[k] + 1.0) * size * size)
                    explained = wp.static(2.0 * 1.5) * wp.sqrt(spread[k]) * (ROUNDING + off[k])
                    bent = 2.0 * wp.max(wp.abs(1.0 - 1.5 * size) - explained, 0.0)
                    sure[k] = 1.0 / (1.0 + wp.sqrt(noise + bent + hidden[k] * hidden[k]) / CONFIDENCE_HALF)
        normal[0, p] = nx
        normal[1, p] = ny
        normal[2, p] = nz
        albedo[0, p] = red
        albedo[1, p] = green
        albedo[2, p] = blue
        confidence[p] = sure
        length[p] = ratio
        status[p] = code

    return diffuse_kernel
