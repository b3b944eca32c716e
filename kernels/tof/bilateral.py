"""Joint bilateral filter: a plane through neighbours that look the same and lie near, weighed by how well each is known.

The plain filter averages; where an edge of the guide cuts the window in two, the average of a slope lies to one side of the pixel and the
edge is drawn into the depth. A plane has no such error.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.status import Status
from kernels.tof.flying import require_image

GUIDE_RELATIVE = 0.15
"""Relative difference of the guide at which a neighbour counts exp(-½): albedo edges differ by more, noise by less."""
RANGE_SIGMAS = 3.0
"""Standard deviations of the difference of two ranges at which a neighbour counts exp(-½)."""
LEAST_STEP = 0.02
"""Part of the range at which it does so however well both are known: slopes are surfaces too."""
LEAST_DETERMINANT = 1e-3
"""Of the plane's matrix, over that of independent unit spreads: below it the neighbours lie on a line, and are averaged."""
LEAST_VARIANCE = 1e-12
"""m²: a micrometre, so that noise-free pixels have a weight."""

_OK = int(Status.OK)

wp.set_module_options({"enable_backward": False})


class Smoothed(NamedTuple):
    """[rows · cols] on the device; pixels that were not OK keep what they had."""

    range: wp.array  # [pixel] float32 metres
    sigma: wp.array  # [pixel] float32 metres: of the fit, for independent errors of the neighbours


def smooth(ranges: wp.array, sigma: wp.array, guide: wp.array, status: wp.array, rows: int, cols: int, *, radius: int = 2,
           spatial_px: float = 1.5) -> Smoothed:
    """Put each range on the plane through its neighbours.

    Args:
        ranges, sigma: [rows · cols] float32 metres, padded or not.
        guide: [rows · cols] float32, above zero where OK: the image whose edges are kept (amplitude or passive intensity).
        status: [rows · cols] int32; only OK pixels are changed and count.
        rows, cols: of the image.
        radius: pixels of the window.
        spatial_px: standard deviation of the Gaussian over the window, pixels.

    Returns:
        Ranges and their standard deviations. Invalid pixels stay invalid: nothing is filled in.

    Raises:
        ArrayError: sizes do not match, or an option is not above zero.

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
    planes = [wp.zeros(size, dtype=wp.float32, device=device) for _ in range(4)]
    devices.launch(_frame_kernel, size, [ranges, sigma, guide, status, rows, cols, radius, pitch], planes, device=device)
    result = [wp.zeros((rows, whole), dtype=wp.float32, device=device) for _ in range(2)]
    distance = np.arange(-radius, radius + 1)
    falloff = np.exp(-0.5 * (distance[:, None] ** 2 + distance**2) / spatial_px**2)
    devices.launch(smooth_kernel(pack), rows * whole // pack, [
        *(_every_place(plane, pack) for plane in planes), radius, pitch, whole // pack,
        wp.array(falloff.astype(np.float32).reshape(-1), dtype=wp.float32, device=device)],
        [as_packs(array, device) for array in result], device=device)
    return Smoothed(*((array if whole == cols else array[:, :cols].contiguous()).reshape((rows * cols,)) for array in result))


def _every_place(plane: wp.array, pack: int) -> wp.array:
    """The same memory as packs that begin at every value and overlap; the caller keeps the plane."""
    return wp.array(ptr=plane.ptr, shape=(plane.shape[0] - pack + 1,), strides=(4,), dtype=pack_type(pack, wp.float32),
                    device=plane.device, copy=False)


@wp.kernel(module="unique")
def _frame_kernel(first: int,
                  ranges: wp.array(dtype=wp.float32),
                  sigma: wp.array(dtype=wp.float32),
                  guide: wp.array(dtype=wp.float32),
                  status: wp.array(dtype=wp.int32),
                  rows: int,
                  cols: int,
                  radius: int,
                  pitch: int,
                  # outputs
                  place: wp.array(dtype=wp.float32),
                  variance: wp.array(dtype=wp.float32),
                  known: wp.array(dtype=wp.float32),  # 1 / variance; 0 where not OK and in the frame around the image
                  look: wp.array(dtype=wp.float32)):
    t = first + wp.tid()
    r = t // pitch - radius
    c = t - (t // pitch) * pitch - radius
    v = float(1.0)
    inside = r >= 0 and c >= 0 and r < rows and c < cols
    look[t] = 1.0
    if inside:
        p = r * cols + c
        place[t] = ranges[p]
        look[t] = guide[p]
        v = sigma[p] * sigma[p] + LEAST_VARIANCE
        if status[p] == _OK:
            known[t] = 1.0 / v
    variance[t] = v


def frame_kernel(pack: int) -> Any:
    """For the test that compiles it; single pixels whatever the pack."""
    return _frame_kernel


@cache
def smooth_kernel(pack: int) -> Any:
    """The kernel for packs of this many pixels; public for the test that compiles it for CUDA."""
    float_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def plane_kernel(first: int,
                     place: wp.array(dtype=float_pack),  # [place] overlapping packs of the framed image
                     variance: wp.array(dtype=float_pack),
                     known: wp.array(dtype=float_pack),
                     look: wp.array(dtype=float_pack),
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
        k0 = known[here]
        step2 = float_pack()
        for k in range(pack):
            step2[k] = (LEAST_STEP * d[k]) * (LEAST_STEP * d[k]) + RANGE_SIGMAS * RANGE_SIGMAS * v0[k]
        m00, m01, m02, m11, m12, m22 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()  # Σ w
        n00, n01, n02, n11, n12, n22 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()  # Σ w² v
        t0, t1, t2 = float_pack(), float_pack(), float_pack()  # Σ w (range - d)
        for i in range(-radius, radius + 1):
            for j in range(-radius, radius + 1):
                q = here + i * pitch + j
                dq = place[q]
                vq = variance[q]
                kq = known[q]
                gq = look[q]
                f = falloff[(i + radius) * (2 * radius + 1) + j + radius]
                x, y = float(j), float(i)
                for k in range(pack):
                    away = dq[k] - d[k]
                    ratio = (gq[k] - g0[k]) / (GUIDE_RELATIVE * wp.max(wp.max(gq[k], g0[k]), 1.0e-30))
                    unlike = ratio * ratio + away * away / (RANGE_SIGMAS * RANGE_SIGMAS * vq[k] + step2[k])
                    like = wp.max(1.0 - unlike * 0.03125, 0.0)  # (1 - u/32)^16, exp(-u/2) but for its tail: the same for a whole pack
                    like = like * like
                    like = like * like
                    like = like * like
                    like = like * like * f
                    w = like * v0[k] * kq[k]
                    u = like * v0[k] * w
                    wx, wy, ux, uy = w * x, w * y, u * x, u * y
                    m00[k] += w
                    m01[k] += wx
                    m02[k] += wy
                    m11[k] += wx * x
                    m12[k] += wx * y
                    m22[k] += wy * y
                    t0[k] += w * away
                    t1[k] += wx * away
                    t2[k] += wy * away
                    n00[k] += u
                    n01[k] += ux
                    n02[k] += uy
                    n11[k] += ux * x
                    n12[k] += ux * y
                    n22[k] += uy * y
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
