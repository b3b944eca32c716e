"""The responses of each pixel to the sphere of light, from spherical gradient frames.

Under L(ω) = mean + dipole·ω a pixel's radiance is mean · M₀ + dipole · M, whatever its reflectance: M₀ = ∫ R dω is its radiance
under the full sphere, M = ∫ R ω dω under L = ω, with R the reflectance times the cosine and the visibility. Gradient frames
(mean 1/2, dipole ±e_a/2) and full frames (mean 1) are rows of that linear system; here it is solved by least squares.

Source: Ma, Hawkins, Peers, Chabert, Weiss and Debevec, "Rapid Acquisition of Specular and Diffuse Normal Maps from Polarized
Spherical Gradient Illumination", EGSR 2007, section 3; complements: Wilson et al., "Temporal Upsampling of Performance
Geometry Using Photometric Alignment", TOG 2010, section 3.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, channels_type, pack_type, zeros
from kernels.status import DARK, OK, TOO_FEW_LIGHTS

LARGEST_HALF = 65504.0
"""Largest half: a stored value above it, or a NaN, was not measured."""
MIN_PIVOT = 0.1
"""Least pivot of M₀'s equation after elimination: it is at least 1/2 with a pair of opposite gradients or a full frame, and 0 when M₀ is
not determined."""


class Moments(NamedTuple):
    """Responses of a band; the last axis is pixels, padded to whole packs. Only pixels with status OK have values."""

    values: wp.array  # [12, pixels] float32, radiance: row 4·channel + i, i = 0 for M₀, 1…3 for M along x, y, z
    variance: wp.array  # [pixels] float32, of a component of M (mean over axes) when a reading has variance one
    residual: wp.array  # [pixels] float32, RMS of the grey readings about the fit, over the grey M₀
    spare: wp.array  # [pixels] float32, readings beyond the four unknowns
    tilt: wp.array  # [pixels] float32, radians that a highlight which is still inside may tilt the normal by
    status: wp.array  # [pixels] int32, kernels.status.Status


def fit_moments(band: Band, rows: np.ndarray, scale: np.ndarray, grey_weights: tuple[float, float, float]) -> Moments:
    """Fit the responses M₀ and M: least squares of radiance = mean · M₀ + dipole · M in each channel; not synchronised on CUDA.

    A reading of zero or below is a measurement here (a mirror that shows the dark end of a gradient reads zero); a saturated one, or one
    that is not finite in every channel, is not.
    `rows`: [lights, 4] mean and dipole of each frame, along one axis at most; 0 for frames that do not take part. `scale`: [lights]
    radiance of a stored 1.0. `grey_weights`: of the channels, for the residual; they add up to one."""
    band.require_channels(3)
    if rows.shape != (band.frame_count, 4) or scale.shape != (band.frame_count,):
        raise ArrayError(f"rows are {rows.shape}, scale {scale.shape}, the band has {band.frame_count} lights: give one for each")
    if (np.count_nonzero(rows[:, 1:], axis=1) > 1).any():
        raise ArrayError("rows hold a gradient along several axes: give each frame one axis")
    frames = np.flatnonzero(rows.any(axis=1))
    if len(frames) == 0:
        raise ArrayError("rows are all zero: give the mean and dipole of the gradient frames")
    device, count = band.device, band.pixel_count
    fit = Moments(zeros(count, wp.float32, device, rows=12), *(zeros(count, wp.float32, device) for _ in range(4)),
                  zeros(count, wp.int32, device))
    devices.launch(_moments_kernel(devices.pack_width(device)), band.packs,
                   [band.values, band.saturated, wp.array(frames, dtype=wp.int32, device=device),
                    wp.array(rows[frames], dtype=wp.vec4, device=device), wp.array(scale[frames], dtype=wp.float32, device=device),
                    wp.vec3(*grey_weights)],
                   [fit.values, fit.variance, fit.residual, fit.spare, fit.status], device=device)
    return fit


@once
def _moments_kernel(pack: int) -> Any:
    half_pack, byte_pack = pack_type(pack, wp.float16), pack_type(pack, wp.uint8)
    float_pack, int_pack, channels = pack_type(pack, wp.float32), pack_type(pack, wp.int32), channels_type(pack)
    load, load_byte = pack_load(pack, wp.float16), pack_load(pack, wp.uint8)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def moments_kernel(first: int,
                       values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                       saturated: wp.array2d(dtype=byte_pack),  # [L / 8, P] bits
                       frames: wp.array(dtype=int),  # [F] lights of the stack that take part
                       rows: wp.array(dtype=wp.vec4),  # [F] mean, dipole
                       scale: wp.array(dtype=float),  # [F]
                       grey: wp.vec3,
                       # outputs
                       moments: wp.array2d(dtype=float),  # [12, N]
                       variance: wp.array(dtype=float),  # [N]
                       residual: wp.array(dtype=float),  # [N]
                       spare: wp.array(dtype=float),  # [N]
                       status: wp.array(dtype=int)):  # [N]
        p = first + wp.tid()
        lights = values.shape[0] / 3

        # normal equations: shared by the channels, then the right-hand side of each
        count, g00 = float_pack(), float_pack()
        g0x, g0y, g0z, gxx, gyy, gzz = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        m0, mx, my, mz = channels(), channels(), channels(), channels()  # right-hand sides, and then M₀ and M
        for frame in range(frames.shape[0]):
            light = frames[frame]
            red = load(values, light, p)
            green = load(values, lights + light, p)
            blue = load(values, 2 * lights + light, p)
            bits = load_byte(saturated, light / 8, p)
            shift = light % 8
            unit = scale[frame]
            mean, x, y, z = rows[frame][0], rows[frame][1], rows[frame][2], rows[frame][3]
            used = float_pack()
            for k in range(pack):
                top = wp.max(wp.max(wp.abs(float(red[k])), wp.abs(float(green[k]))), wp.abs(float(blue[k])))
                total = float(red[k]) + float(green[k]) + float(blue[k])
                clear = ((int(bits[k]) >> shift) & 1) == 0
                # a maximum may pass over a NaN, a sum does not
                w = wp.where(clear and top <= LARGEST_HALF and total == total, 1.0, 0.0)
                used[k] = w
                count[k] += w
                g00[k] += w * mean * mean
                g0x[k] += w * mean * x
                g0y[k] += w * mean * y
                g0z[k] += w * mean * z
                gxx[k] += w * x * x
                gyy[k] += w * y * y
                gzz[k] += w * z * z
            for c in range(3):
                reading = load(values, c * lights + light, p)
                for k in range(pack):
                    value = wp.where(used[k] > 0.0, unit * float(reading[k]), 0.0)
                    m0[c, k] += mean * value
                    mx[c, k] += x * value
                    my[c, k] += y * value
                    mz[c, k] += z * value

        code = int_pack()
        for k in range(pack):
            g0 = wp.vec3(g0x[k], g0y[k], g0z[k])
            gg = wp.vec3(gxx[k], gyy[k], gzz[k])
            known = wp.min(gg) > 0.0
            gg = wp.where(known, gg, wp.vec3(1.0, 1.0, 1.0))
            u = wp.cw_div(g0, gg)
            pivot = g00[k] - wp.dot(u, g0)
            known = known and pivot > MIN_PIVOT
            pivot = wp.where(known, pivot, 1.0)
            on = wp.where(known, 1.0, 0.0)
            for c in range(3):  # no frame has a gradient along two axes, so that each axis is eliminated on its own
                r = wp.vec3(mx[c, k], my[c, k], mz[c, k])
                first_moment = (m0[c, k] - wp.dot(u, r)) / pivot
                m = wp.cw_div(r - first_moment * g0, gg)
                m0[c, k] = on * first_moment
                mx[c, k] = on * m[0]
                my[c, k] = on * m[1]
                mz[c, k] = on * m[2]
            lit = grey[0] * m0[0, k] + grey[1] * m0[1, k] + grey[2] * m0[2, k] > 0.0
            code[k] = wp.where(known, wp.where(lit, OK, DARK), TOO_FEW_LIGHTS)
            if code[k] == OK:
                variance[p * pack + k] = (1.0 / gg[0] + 1.0 / gg[1] + 1.0 / gg[2] + wp.dot(u, u) / pivot) / 3.0
                spare[p * pack + k] = count[k] - 4.0

        # how well the fit says what was read
        squares = float_pack()
        for frame in range(frames.shape[0]):
            light = frames[frame]
            cut = load_byte(saturated, light / 8, p)
            shift = light % 8
            unit = scale[frame]
            mean, x, y, z = rows[frame][0], rows[frame][1], rows[frame][2], rows[frame][3]
            read, told = float_pack(), float_pack()
            for c in range(3):
                reading = load(values, c * lights + light, p)
                for k in range(pack):
                    read[k] += grey[c] * float(reading[k])
                    told[k] += grey[c] * (mean * m0[c, k] + x * mx[c, k] + y * my[c, k] + z * mz[c, k])
            for k in range(pack):
                off = wp.where(((int(cut[k]) >> shift) & 1) == 0, unit * read[k] - told[k], 0.0)
                squares[k] += wp.where(wp.abs(off) < wp.inf, off * off, 0.0)
        for k in range(pack):
            pixel = p * pack + k
            status[pixel] = code[k]
            if code[k] == OK:
                level = grey[0] * m0[0, k] + grey[1] * m0[1, k] + grey[2] * m0[2, k]
                residual[pixel] = wp.min(wp.sqrt(squares[k] / count[k]) / level, LARGEST_HALF)  # of noise about black: kept as half
                for c in range(3):
                    moments[4 * c, pixel] = m0[c, k]
                    moments[4 * c + 1, pixel] = mx[c, k]
                    moments[4 * c + 2, pixel] = my[c, k]
                    moments[4 * c + 3, pixel] = mz[c, k]

    return moments_kernel
