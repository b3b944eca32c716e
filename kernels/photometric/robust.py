"""Photometric stereo that rejects shadows and highlights per pixel: middle brightness ranks of the lit lights, Cauchy weights.

Per pixel: a light whose reading is under a tenth of the bright end is in shadow; of the lit ones the darkest fifth (grazing,
penumbra, interreflection) and the brightest three tenths (highlights) are set aside; the rest is solved by least squares,
re-weighted against what still does not fit. On a Lambertian surface the middle ranks are exact; on real materials they are
the part of the reflectance that is closest to it.

Source: position thresholding after Shi, Tan, Matsushita and Ikeuchi, "Bi-polynomial modeling of low-frequency reflectances",
TPAMI 2014, section 5; Cauchy weights as in robust regression (Huber and Ronchetti, "Robust Statistics", 2009, chapter 7).
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels.packs import Band, pack_type
from kernels.photometric.lambert import NormalFit, run_normal_kernel
from kernels.photometric.least_squares import confidence_of, fit_pixel, symmetric
from kernels.photometric.near import Near
from kernels.photometric.readings import Readings
from kernels.status import OK

BRIGHT_FRACTION = 0.1
"""The bright end of a pixel is the reading that this fraction of the lights exceed: above single highlights."""
SHADOW_FRACTION = 0.1
"""Readings under this fraction of the bright end are shadow, attached or cast."""
DARK_RANKS = 0.2
"""Fraction of the lit lights set aside at the dark end."""
BRIGHT_RANKS = 0.3
"""Fraction of the lit lights set aside at the bright end."""
KEPT_AT_LEAST = 8
"""Ranks are set aside only while this many lights stay: fewer determine the normal too loosely."""
CAUCHY_SCALE = 0.05
"""Residual, relative to |b|, at which a reading's weight is halved; relative noise of a good capture is below it."""
REWEIGHTINGS = 5
"""Rounds of re-weighting; the normal moves under 0.01° after five on real data."""
RANGE = 2.0**-26
"""Of the brightest reading: the least value that the bright end can have. A lamp mirrored in black is 2²⁰ times brighter."""
HALVINGS_OF_RATIO = 6
"""Steps that halve the ratio between the bounds of a rank's value: 2²⁶ becomes 1.33, whatever the highlight."""
BISECTIONS = 18
"""Steps in all; the others halve the difference, and find the value to 10⁻⁴ of itself, under the rounding of half values."""


def solve_robust(band: Band, readings: Readings, directions: np.ndarray, near: Near | None = None) -> NormalFit:
    """Normals from the lights that, at each pixel, are neither shadow nor highlight.

    Args:
        band: the stack on the device.
        readings: its grey readings; on return each holds the weight, 0…1, that the light had in the fit.
        directions: [lights, 3] unit, from the surface to the light; padding is ignored.
        near: directions and falloff per pixel, in place of `directions`, where some light is near.

    Returns:
        Normals on the device; not synchronised on CUDA.

    Raises:
        ArrayError: directions do not match the band.
    """
    return run_normal_kernel(_robust_kernel, band, readings, directions, near)


@wp.func
def _between(low: float, high: float, step: int) -> float:
    # the geometric mean first: a highlight far above all else must not take the steps
    return wp.where(step < HALVINGS_OF_RATIO, wp.sqrt(low) * wp.sqrt(high), 0.5 * (low + high))


@cache
def _robust_kernel(pack: int, near: bool = False) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def robust_kernel(first: int,
                      lights: wp.array(dtype=wp.vec3),  # [L]
                      toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of lights, if near
                      pack_stride: int,
                      light_stride: int,
                      # outputs
                      readings: wp.array(dtype=float_pack),  # in: readings, out: weights
                      normal: wp.array2d(dtype=float_pack),  # [3, P]
                      confidence: wp.array(dtype=float_pack),  # [P]
                      residual: wp.array(dtype=float_pack),  # [P]
                      status: wp.array(dtype=int_pack)):  # [P]
        p = first + wp.tid()
        light_count = lights.shape[0]
        start = p * pack_stride

        # the bright end: the value that a tenth of the readings exceed, by bisection
        top = float_pack()
        given = float_pack()
        for light in range(light_count):
            y = readings[start + light * light_stride]
            for k in range(pack):
                top[k] = wp.max(top[k], y[k])
                given[k] += wp.where(y[k] > 0.0, 1.0, 0.0)
        low, high, middle = float_pack(), float_pack(), float_pack()
        for k in range(pack):
            low[k] = RANGE * top[k]
            high[k] = top[k]
        for step in range(BISECTIONS):
            above = float_pack()
            for k in range(pack):
                middle[k] = _between(low[k], high[k], step)
            for light in range(light_count):
                y = readings[start + light * light_stride]
                for k in range(pack):
                    above[k] += wp.where(y[k] > middle[k], 1.0, 0.0)
            for k in range(pack):
                many = above[k] > wp.max(BRIGHT_FRACTION * given[k] - 0.5, 0.0)
                low[k] = wp.where(many, middle[k], low[k])
                high[k] = wp.where(many, high[k], middle[k])

        # of the lit lights, the values between which the kept ranks lie
        shadow = float_pack()
        lit = float_pack()
        for k in range(pack):
            shadow[k] = SHADOW_FRACTION * high[k]
        for light in range(light_count):
            y = readings[start + light * light_stride]
            for k in range(pack):
                lit[k] += wp.where(y[k] > shadow[k], 1.0, 0.0)
        keep_dark = float_pack()
        keep_bright = float_pack()
        dark_low, dark_high, bright_low, bright_high = float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            spare = wp.max(lit[k] - float(KEPT_AT_LEAST), 0.0)
            share = wp.min(1.0, spare / wp.max((DARK_RANKS + BRIGHT_RANKS) * lit[k], 1.0))
            keep_dark[k] = lit[k] - wp.floor(share * DARK_RANKS * lit[k])  # as many readings exceed the lower bound
            keep_bright[k] = wp.floor(share * BRIGHT_RANKS * lit[k])  # as many exceed the upper bound
            dark_low[k] = shadow[k]
            dark_high[k] = top[k]
            bright_low[k] = shadow[k]
            bright_high[k] = top[k]
        dark_middle, bright_middle = float_pack(), float_pack()
        for step in range(BISECTIONS):
            above_dark = float_pack()
            above_bright = float_pack()
            for k in range(pack):
                dark_middle[k] = _between(dark_low[k], dark_high[k], step)
                bright_middle[k] = _between(bright_low[k], bright_high[k], step)
            for light in range(light_count):
                y = readings[start + light * light_stride]
                for k in range(pack):
                    above_dark[k] += wp.where(y[k] > dark_middle[k], 1.0, 0.0)
                    above_bright[k] += wp.where(y[k] > bright_middle[k], 1.0, 0.0)
            for k in range(pack):
                dark_low[k] = wp.where(above_dark[k] >= keep_dark[k], dark_middle[k], dark_low[k])
                dark_high[k] = wp.where(above_dark[k] >= keep_dark[k], dark_high[k], dark_middle[k])
                bright_low[k] = wp.where(above_bright[k] > keep_bright[k], bright_middle[k], bright_low[k])
                bright_high[k] = wp.where(above_bright[k] > keep_bright[k], bright_high[k], bright_middle[k])

        # least squares on the kept ranks, re-weighted
        bx, by, bz, across, code = float_pack(), float_pack(), float_pack(), float_pack(), int_pack()
        reach = float_pack()  # residual at which a weight is halved; infinite in the first round
        for k in range(pack):
            reach[k] = 1.0e30
        for _ in range(REWEIGHTINGS + 1):
            xx, xy, xz, yy, yz, zz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            rx, ry, rz, squares, count = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            for light in range(light_count):
                at = start + light * light_stride
                y = readings[at]
                if wp.static(near):
                    tx = toward[0, at]
                    ty = toward[1, at]
                    tz = toward[2, at]
                else:
                    lx, ly, lz = lights[light][0], lights[light][1], lights[light][2]
                for k in range(pack):
                    if wp.static(near):
                        lx, ly, lz = tx[k], ty[k], tz[k]
                    off = (y[k] - (bx[k] * lx + by[k] * ly + bz[k] * lz)) / reach[k]
                    kept = wp.where(y[k] > dark_low[k], 1.0, 0.0) * wp.where(y[k] <= bright_high[k], 1.0, 0.0)
                    w = kept / (1.0 + off * off)
                    count[k] += kept
                    squares[k] += w * y[k] * y[k]
                    rx[k] += w * y[k] * lx
                    ry[k] += w * y[k] * ly
                    rz[k] += w * y[k] * lz
                    xx[k] += w * lx * lx
                    xy[k] += w * lx * ly
                    xz[k] += w * lx * lz
                    yy[k] += w * ly * ly
                    yz[k] += w * ly * lz
                    zz[k] += w * lz * lz
            for k in range(pack):
                fit = fit_pixel(symmetric(xx[k], xy[k], xz[k], yy[k], yz[k], zz[k]), wp.vec3(rx[k], ry[k], rz[k]),
                                squares[k], int(count[k]))
                bx[k] = fit.b[0]
                by[k] = fit.b[1]
                bz[k] = fit.b[2]
                reach[k] = wp.max(CAUCHY_SCALE * wp.length(fit.b), 1.0e-30)
                across[k] = fit.across
                code[k] = fit.status

        # the weights that the fit used, for the albedo, and how well it predicts every lit light, for the confidence
        misfit = float_pack()
        for light in range(light_count):
            at = start + light * light_stride
            y = readings[at]
            weight = float_pack()
            if wp.static(near):
                tx = toward[0, at]
                ty = toward[1, at]
                tz = toward[2, at]
            else:
                lx, ly, lz = lights[light][0], lights[light][1], lights[light][2]
            for k in range(pack):
                if wp.static(near):
                    lx, ly, lz = tx[k], ty[k], tz[k]
                off = (y[k] - (bx[k] * lx + by[k] * ly + bz[k] * lz)) / reach[k]
                kept = wp.where(y[k] > dark_low[k], 1.0, 0.0) * wp.where(y[k] <= bright_high[k], 1.0, 0.0)
                weight[k] = kept / (1.0 + off * off)
                misfit[k] += wp.where(y[k] > shadow[k], wp.min(off * off, wp.static(1.0 / CAUCHY_SCALE**2)), 0.0)
            readings[at] = weight
        nx, ny, nz = float_pack(), float_pack(), float_pack()
        sure, error = float_pack(), float_pack()
        for k in range(pack):
            if code[k] == OK:
                n = wp.normalize(wp.vec3(bx[k], by[k], bz[k]))
                nx[k] = n[0]
                ny[k] = n[1]
                nz[k] = n[2]
                squared = misfit[k] * wp.static(CAUCHY_SCALE**2)
                sure[k] = confidence_of(across[k], squared, lit[k])
                error[k] = wp.sqrt(squared / lit[k])
        normal[0, p] = nx
        normal[1, p] = ny
        normal[2, p] = nz
        confidence[p] = sure
        residual[p] = error
        status[p] = code

    return robust_kernel
