"""Joint bilateral filter: a plane is fitted through neighbours that look the same and lie near, each weighted by its precision.

The plain filter averages; where an edge of the guide cuts the window in two, the average of a slope lies to one side of the pixel and the
edge is drawn into the depth. A plane has no such error.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.status import Status
from kernels.tof.continuous.flying import require_image

GUIDE_RELATIVE = 0.15
"""Relative difference of the guide at which a neighbour's weight is exp(-½): albedo edges differ by more, noise by less."""
RANGE_SIGMAS = 3.0
"""Difference of two ranges, in its standard deviations, at which a neighbour's weight is exp(-½)."""
LEAST_STEP = 0.02
"""Least difference of two ranges, as a part of the range, at which a neighbour's weight is exp(-½), however precise both are: neighbours on
a slope differ too."""
LEAST_DETERMINANT = 1e-3
"""Least determinant of the plane's matrix, relative to that of independent unit spreads: below it the neighbours lie on a line and are
averaged."""
LEAST_VARIANCE = 1e-12
"""Least variance of a range, m²: that of a micrometre, so that noise-free pixels have a finite weight."""
LEAST_GUIDE = 1e-30
"""Least value of the guide, so that its reciprocal is finite where nothing was measured."""
CUTOFF = 32.0
"""Distance u at which a weight becomes 0: (1 - u/32)^16 replaces exp(-u/2) and differs from it by 2 % of a weight at most. It takes a few
operations for a whole pack."""

_OK = int(Status.OK)


class Smoothed(NamedTuple):
    """Smoothed image, [rows · cols] on the device; pixels that were not OK keep what they had."""

    range: wp.array  # [pixel] float32 metres
    sigma: wp.array  # [pixel] float32 metres: of the fit, for independent errors of the neighbours


def smooth(ranges: wp.array, sigma: wp.array, guide: wp.array, status: wp.array, rows: int, cols: int, *, radius: int = 2,
           spatial_px: float = 1.5) -> Smoothed:
    """Smooth ranges: put each on the plane through its neighbours. Invalid pixels stay invalid: nothing is filled in.

    Args:
        ranges, sigma: [rows · cols] float32 metres, padded or not.
        guide: [rows · cols] float32, above zero where OK: the image whose edges are kept (amplitude or passive intensity).
        status: [rows · cols] int32; only OK pixels are changed and count.
        radius: pixels of the window.
        spatial_px: standard deviation of the Gaussian over the window, pixels.

    Source:
        Petschnigg et al., "Digital photography with flash and no-flash image pairs", SIGGRAPH 2004 (joint bilateral); of
        first order as Elad, IEEE TIP 11(10), 2002; inverse variances make the fit maximum likelihood.
    """
    require_image(ranges, sigma, guide, status, rows=rows, cols=cols)
    if radius < 1 or not (np.isfinite(spatial_px) and spatial_px > 0):
        raise ArrayError(f"the window has radius {radius} and deviation {spatial_px} px: give a radius from 1 and a deviation above zero")
    device = str(ranges.device)
    pack = devices.pack_width(device)
    whole = -(-cols // pack) * pack
    pitch, size = whole + 2 * radius, (rows + 2 * radius) * (whole + 2 * radius)
    planes = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(5)]
    part = math.gcd(cols, pack)  # packs that fill a row and no more
    devices.launch(frame_kernel(part), rows * cols // part, [
        *(_packs(array, part, part, rows * cols // part) for array in (ranges, sigma, guide, status)), cols // part, radius, pitch],
        [_packs(plane, part, 1, size - part + 1) for plane in planes], device=device)
    result = [wp.empty((rows, whole), dtype=wp.float32, device=device) for _ in range(2)]  # the kernel writes every pixel
    distance = np.arange(-radius, radius + 1)
    falloff = np.exp(-0.5 * (distance[:, None] ** 2 + distance**2) / spatial_px**2)
    devices.launch(smooth_kernel(pack), rows * whole // pack, [
        *(_packs(plane, pack, 1, size - pack + 1) for plane in planes), radius, pitch, whole // pack,
        wp.array(falloff.reshape(-1), dtype=wp.float32, device=device)],
        [as_packs(array, device) for array in result], device=device)
    return Smoothed(*((array if whole == cols else array[:, :cols].contiguous()).reshape((rows * cols,)) for array in result))


def _packs(array: wp.array, pack: int, step: int, count: int) -> wp.array:
    """The same memory as packs that begin at every `step` values and overlap where a pack is longer; the caller keeps the array."""
    if not array.is_contiguous:
        raise ArrayError(f"an array of shape {array.shape} is a slice with gaps: give contiguous ones")
    return wp.array(ptr=array.ptr, shape=(count,), strides=(4 * step,), dtype=pack_type(pack, array.dtype), device=array.device, copy=False)


@once
def frame_kernel(pack: int) -> Any:
    """Return the kernel for packs of this many pixels, which divide a row."""
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def inset_kernel(first: int,
                     ranges: wp.array(dtype=float_pack),
                     sigma: wp.array(dtype=float_pack),
                     guide: wp.array(dtype=float_pack),
                     status: wp.array(dtype=int_pack),
                     packs: int,  # of a row
                     radius: int,
                     pitch: int,
                     # outputs, zeros in the frame around the image
                     place: wp.array(dtype=float_pack),
                     variance: wp.array(dtype=float_pack),
                     known: wp.array(dtype=float_pack),  # 1 / variance; 0 where not OK
                     look: wp.array(dtype=float_pack),
                     look_inverse: wp.array(dtype=float_pack)):
        t = first + wp.tid()
        r = t // packs
        q = (r + radius) * pitch + radius + (t - r * packs) * pack
        s = sigma[t]
        g = guide[t]
        code = status[t]
        v, sure, seen, inverse = float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            v[k] = s[k] * s[k] + LEAST_VARIANCE
            sure[k] = wp.where(code[k] == _OK, 1.0 / v[k], 0.0)
            seen[k] = wp.max(g[k], LEAST_GUIDE)
            inverse[k] = 1.0 / seen[k]
        place[q] = ranges[t]
        variance[q] = v
        known[q] = sure
        look[q] = seen
        look_inverse[q] = inverse

    return inset_kernel


@once
def smooth_kernel(pack: int) -> Any:
    """Return the kernel for packs of this many pixels."""
    float_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def plane_kernel(first: int,
                     place: wp.array(dtype=float_pack),  # [place] overlapping packs of the framed image
                     variance: wp.array(dtype=float_pack),
                     known: wp.array(dtype=float_pack),
                     look: wp.array(dtype=float_pack),
                     look_inverse: wp.array(dtype=float_pack),
                     radius: int,
                     pitch: int,
                     packs: int,  # of a row
                     falloff: wp.array(dtype=wp.float32),  # [(2 radius + 1)²]
                     # outputs
                     smoothed: wp.array2d(dtype=float_pack),  # [rows, packs]
                     smoothed_sigma: wp.array2d(dtype=float_pack)):
        t = first + wp.tid()
        r = t // packs
        c = t - r * packs
        here = (r + radius) * pitch + c * pack + radius
        d = place[here]
        v0 = variance[here]
        g0 = look[here]
        h0 = look_inverse[here]
        k0 = known[here]
        step2 = float_pack()
        for k in range(pack):
            step2[k] = CUTOFF * ((LEAST_STEP * d[k]) * (LEAST_STEP * d[k]) + RANGE_SIGMAS * RANGE_SIGMAS * v0[k])
        m00, m01, m02, m11, m12, m22 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()  # Σ w
        n00, n01, n02, n11, n12, n22 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()  # Σ w² v
        t0, t1, t2 = float_pack(), float_pack(), float_pack()  # Σ w (range - d)
        for i in range(-radius, radius + 1):
            w0, w1, w2, u0, u1, u2 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()  # of one row
            s0, s1 = float_pack(), float_pack()
            y = float(i)
            for j in range(-radius, radius + 1):
                q = here + i * pitch + j
                dq = place[q]
                kq = known[q]
                gq = look[q]
                hq = look_inverse[q]
                f = falloff[(i + radius) * (2 * radius + 1) + j + radius]
                x = float(j)
                for k in range(pack):
                    away = dq[k] - d[k]
                    up, down = gq[k] * h0[k], g0[k] * hq[k]
                    ratio = 1.0 - wp.where(up < down, up, down)  # difference of the guide over the larger of the two, without a division
                    unlike = ratio * ratio * (1.0 / (CUTOFF * GUIDE_RELATIVE * GUIDE_RELATIVE)) \
                        + away * away * kq[k] / (CUTOFF * RANGE_SIGMAS * RANGE_SIGMAS + step2[k] * kq[k])  # over CUTOFF
                    like = wp.max(1.0 - unlike, 0.0)
                    like = like * like
                    like = like * like
                    like = like * like
                    like = like * like * f * v0[k]
                    w = like * kq[k]
                    u = like * w
                    w0[k] += w
                    w1[k] += w * x
                    w2[k] += w * x * x
                    u0[k] += u
                    u1[k] += u * x
                    u2[k] += u * x * x
                    s0[k] += w * away
                    s1[k] += w * away * x
            for k in range(pack):
                m00[k] += w0[k]
                m01[k] += w1[k]
                m02[k] += w0[k] * y
                m11[k] += w2[k]
                m12[k] += w1[k] * y
                m22[k] += w0[k] * y * y
                n00[k] += u0[k]
                n01[k] += u1[k]
                n02[k] += u0[k] * y
                n11[k] += u2[k]
                n12[k] += u1[k] * y
                n22[k] += u0[k] * y * y
                t0[k] += s0[k]
                t1[k] += s1[k]
                t2[k] += s0[k] * y
        out, spread = float_pack(), float_pack()
        for k in range(pack):
            a = m11[k] * m22[k] - m12[k] * m12[k]
            b = m02[k] * m12[k] - m01[k] * m22[k]
            e = m01[k] * m12[k] - m02[k] * m11[k]
            determinant = m00[k] * a + m01[k] * b + m02[k] * e
            total = wp.max(m00[k], 1.0e-30)
            line = determinant <= LEAST_DETERMINANT * total * total * total
            safe = wp.max(determinant, 1.0e-30)
            a = wp.where(line, 1.0 / total, a / safe)
            b = wp.where(line, 0.0, b / safe)
            e = wp.where(line, 0.0, e / safe)
            moved = a * t0[k] + b * t1[k] + e * t2[k]
            v = a * a * n00[k] + b * b * n11[k] + e * e * n22[k] + 2.0 * (a * b * n01[k] + a * e * n02[k] + b * e * n12[k])
            out[k] = wp.where(k0[k] > 0.0, d[k] + moved, d[k])
            spread[k] = wp.sqrt(wp.where(k0[k] > 0.0, v, v0[k] - LEAST_VARIANCE))
        smoothed[r, c] = out
        smoothed_sigma[r, c] = spread

    return plane_kernel
