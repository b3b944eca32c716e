"""Photometric stereo that rejects shadows and highlights per pixel: middle brightness ranks of the lit lights, Cauchy weights.

Per pixel: a light whose reading is under a tenth of the bright end is in shadow; of the lit ones the darkest fifth (grazing,
penumbra, interreflection) and the brightest three tenths (highlights) are set aside; the rest is solved by least squares,
re-weighted against what still does not fit. On a Lambertian surface the middle ranks are exact; on real materials they are
the part of the reflectance that is closest to it. The variance of such an estimate is Σ ψ² / (mean ψ')² over the number of
readings, with the influence function ψ = w · residual (Huber and Ronchetti, chapter 6): rejected readings add nothing to it.

Source: position thresholding after Shi, Tan, Matsushita and Ikeuchi, "Bi-polynomial modeling of low-frequency reflectances",
TPAMI 2014, section 5; Cauchy weights as in robust regression (Huber and Ronchetti, "Robust Statistics", 2009, chapter 7).
"""

from typing import Any

import numpy as np
import warp as wp

from kernels.device import once
from kernels.normal_equations import add_reading, fit_pixel, symmetric
from kernels.packs import Band, pack_type
from kernels.photometric.lambertian.lambert import NormalArrays, NormalFit, run_normal_kernel, write_normal
from kernels.photometric.lambertian.near import NearLights, directions_in
from kernels.photometric.lambertian.readings import Readings

BRIGHT_FRACTION = 0.1
"""Fraction of the lights whose readings exceed the bright end of a pixel, so that single highlights lie above it."""
ONE_HIGHLIGHT = 5
"""Least number of readings of which one exceeds the bright end in any case: the light of one highlight leaves what determines a normal and
checks it."""
OUTSHINES = 1.5
"""Brightness, over that of the next reading, from which on readings that would be in shadow beside it agree with no fit: the tail of a
metal's highlight passes for plaster. On plaster with metal parts under 6 to 14 lights, as many normals are beyond five σ as where one
highlight makes shadows of all others; with 2, two fifths more."""
TIED = 1e-4
"""Part by which a reading must exceed a bound that is no rank's value: exactly a tenth, as eight bits often are, is shadow."""
SHADOW_FRACTION = 0.1
"""Fraction of the bright end below which a reading is in shadow, attached or cast."""
DARK_RANKS = 0.2
"""Fraction of the lit lights set aside at the dark end."""
BRIGHT_RANKS = 0.3
"""Fraction of the lit lights set aside at the bright end."""
KEPT_AT_LEAST = 8
"""Least number of lights that are kept when ranks are set aside: fewer determine the normal too loosely."""
CAUCHY_SCALE = 0.05
"""Residual, relative to |b|, at which a reading's weight is halved; the relative noise of a good capture is below it."""
AGREES = 0.08
"""Residual, relative to |b|, at which a reading agrees half with the fit: nearly all do under a noise of 5 %, and few by chance."""
EXPECTED, MISSING = 0.35, 0.3
"""Least reading, relative to |b|, that the fit expects of a reading in shadow which contradicts it, and part of it that is not reached: a
cast shadow, or a fit to the lights that fall on another side of the surface."""
LEAST_SLOPE = 0.25
"""Least mean slope of the influence function that counts: large residuals leave hardly any, and dividing by it amplifies noise."""
REWEIGHTINGS = 5
"""Rounds of re-weighting; after five, the normal moves by less than 0.01° on real data."""
RANGE = 2.0**-26
"""Least value that the bright end can have, as a part of the brightest reading: a lamp mirrored in a black surface is 2²⁰ times brighter
than it."""
HALVINGS_OF_RATIO = 6
"""Bisection steps that halve the logarithm of the ratio between the bounds of a rank's value: 2²⁶ becomes 1.33, however bright the
highlight."""
BISECTIONS = 18
"""Number of all bisection steps. Those after HALVINGS_OF_RATIO halve the difference and find the value to a relative 10⁻⁴, below the
rounding of half values."""


def solve_robust(band: Band, readings: Readings, directions: np.ndarray, near_lights: NearLights | None = None) -> NormalFit:
    """Estimate normals from the lights that, at each pixel, are neither shadow nor highlight; not synchronised on CUDA.

    Args:
        readings: its grey readings; on return each holds the weight, 0…1, that the light had in the fit.
        directions: [lights, 3] unit, from the surface to the light; padding is ignored.
        near_lights: directions and falloff per pixel, in place of `directions`, where some light is near.
    """
    return run_normal_kernel(_robust_kernel, band, readings, directions, near_lights)


@wp.func
def middle_of(low: float, high: float, step: int) -> float:
    """Return where a bisection divides the range at step `step`: the first steps take the geometric mean, so that a highlight does not use
    up all of them."""
    return wp.where(step < HALVINGS_OF_RATIO, wp.sqrt(low) * wp.sqrt(high), 0.5 * (low + high))


@wp.func
def halve(middle: float, above: bool, low: wp.ref[float], high: wp.ref[float]):
    """Keep the part of the range above its middle where `above` is true, else the part below."""
    low = wp.where(above, middle, low)
    high = wp.where(above, high, middle)


@wp.func
def kept_weight(y: float, off: float, darkest: float, brightest: float) -> float:
    """Return the Cauchy weight of a reading whose residual is `off` scales, 0 for a reading outside the kept ranks."""
    return wp.where(y > darkest, 1.0, 0.0) * wp.where(y <= brightest, 1.0, 0.0) / (1.0 + off * off)


@once
def _robust_kernel(pack: int, near: bool = False) -> Any:
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)
    directions_of, apart = directions_in(pack, near)

    @wp.kernel(enable_backward=False, module="unique")
    def robust_kernel(first: int,
                      lights: wp.array(dtype=wp.vec3),  # [L]
                      toward: wp.array2d(dtype=float_pack),  # [3, P · L] in place of lights, if near
                      pack_stride: int,
                      light_stride: int,
                      # outputs
                      readings: wp.array(dtype=float_pack),  # in: readings, out: weights
                      fit: NormalArrays):
        p = first + wp.tid()
        light_count = lights.shape[0]
        start = p * pack_stride

        # the bright end: the value that a tenth of the readings, or one, exceed, by bisection
        top, given = float_pack(), float_pack()
        for light in range(light_count):
            y = readings[start + light * light_stride]
            for k in range(pack):
                top[k] = wp.max(top[k], y[k])
                given[k] += wp.where(y[k] > 0.0, 1.0, 0.0)
        low, high, middle, outshining = float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            low[k] = RANGE * top[k]
            high[k] = top[k]
            one = wp.where(given[k] >= float(ONE_HIGHLIGHT), 1.0, 0.0)
            outshining[k] = wp.max(BRIGHT_FRACTION * given[k] - 0.5, one)
        for step in range(BISECTIONS):
            above = float_pack()
            for k in range(pack):
                middle[k] = middle_of(low[k], high[k], step)
            for light in range(light_count):
                y = readings[start + light * light_stride]
                for k in range(pack):
                    above[k] += wp.where(y[k] > middle[k], 1.0, 0.0)
            for k in range(pack):
                halve(middle[k], above[k] > outshining[k], low[k], high[k])

        # among the lit lights, the values between which the kept ranks lie
        shadow, sure, lit = float_pack(), float_pack(), float_pack()
        for k in range(pack):
            shadow[k] = SHADOW_FRACTION * high[k]
            outshone = BRIGHT_FRACTION * given[k] - 0.5 < 1.0 and top[k] > OUTSHINES * high[k]
            sure[k] = wp.where(outshone, wp.static(SHADOW_FRACTION * (1.0 + TIED)) * top[k], shadow[k])
        for light in range(light_count):
            y = readings[start + light * light_stride]
            for k in range(pack):
                lit[k] += wp.where(y[k] > shadow[k], 1.0, 0.0)
        keep_dark, keep_bright = float_pack(), float_pack()
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
            above_dark, above_bright = float_pack(), float_pack()
            for k in range(pack):
                dark_middle[k] = middle_of(dark_low[k], dark_high[k], step)
                bright_middle[k] = middle_of(bright_low[k], bright_high[k], step)
            for light in range(light_count):
                y = readings[start + light * light_stride]
                for k in range(pack):
                    above_dark[k] += wp.where(y[k] > dark_middle[k], 1.0, 0.0)
                    above_bright[k] += wp.where(y[k] > bright_middle[k], 1.0, 0.0)
            for k in range(pack):
                halve(dark_middle[k], above_dark[k] >= keep_dark[k], dark_low[k], dark_high[k])
                halve(bright_middle[k], above_bright[k] > keep_bright[k], bright_low[k], bright_high[k])

        # least squares on the kept ranks, re-weighted
        bx, by, bz, across, code = float_pack(), float_pack(), float_pack(), float_pack(), int_pack()
        reach = float_pack(1.0e30)  # residual at which a weight is halved; infinite in the first round
        for _ in range(REWEIGHTINGS + 1):
            xx, xy, xz, yy, yz, zz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            rx, ry, rz, squares, count = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            for light in range(light_count):
                at = start + light * light_stride
                y = readings[at]
                lx, ly, lz = directions_of(lights, toward, light, at)
                for k in range(pack):
                    off = (y[k] - (bx[k] * lx[apart * k] + by[k] * ly[apart * k] + bz[k] * lz[apart * k])) / reach[k]
                    count[k] += kept_weight(y[k], 0.0, dark_low[k], bright_high[k])
                    add_reading(y[k], kept_weight(y[k], off, dark_low[k], bright_high[k]), lx[apart * k], ly[apart * k], lz[apart * k],
                                xx[k], xy[k], xz[k], yy[k], yz[k], zz[k], rx[k], ry[k], rz[k], squares[k])
            for k in range(pack):
                found = fit_pixel(symmetric(xx[k], xy[k], xz[k], yy[k], yz[k], zz[k]), wp.vec3(rx[k], ry[k], rz[k]),
                                  squares[k], int(count[k]))
                bx[k] = found.b[0]
                by[k] = found.b[1]
                bz[k] = found.b[2]
                reach[k] = wp.max(CAUCHY_SCALE * wp.length(found.b), 1.0e-30)
                across[k] = found.across
                code[k] = found.status

        # the weights that the fit used, for the albedo, and what they and the residuals say about the error of the normal
        weights, slopes, inside, influence = float_pack(), float_pack(), float_pack(), float_pack()
        checks, agreeing = float_pack(-3.0), float_pack(-3.0)
        for light in range(light_count):
            at = start + light * light_stride
            y = readings[at]
            weight = float_pack()
            lx, ly, lz = directions_of(lights, toward, light, at)
            for k in range(pack):
                expected = bx[k] * lx[apart * k] + by[k] * ly[apart * k] + bz[k] * lz[apart * k]
                off = (y[k] - expected) / reach[k]
                w = kept_weight(y[k], off, dark_low[k], bright_high[k])
                weight[k] = w
                weights[k] += w
                slopes[k] += w * (2.0 * w - 1.0)
                inside[k] += w * off * off
                influence[k] += w * w * off * off
                if y[k] > shadow[k]:
                    checks[k] += 1.0
                    square = wp.static((CAUCHY_SCALE / AGREES)**2) * off * off
                    agreeing[k] += wp.where(y[k] > sure[k], 1.0 / (1.0 + square * square), 0.0)
                elif y[k] > 0.0 and y[k] < MISSING * expected and expected > wp.static(EXPECTED / CAUCHY_SCALE) * reach[k]:
                    checks[k] += 1.0
            readings[at] = weight
        for k in range(pack):
            share = wp.max(slopes[k] / wp.max(weights[k], 1.0e-30), LEAST_SLOPE)
            write_normal(p * pack + k, wp.vec3(bx[k], by[k], bz[k]), code[k],
                         CAUCHY_SCALE * wp.sqrt(inside[k] / wp.max(weights[k], 1.0e-30)), across[k],
                         wp.static(CAUCHY_SCALE**2) * influence[k] / (share * share), wp.max(weights[k] - 3.0, 0.0),
                         wp.max(checks[k], 0.0), wp.max(agreeing[k], 0.0), fit)

    return robust_kernel
