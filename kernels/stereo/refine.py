"""Disparity to a fraction of a pixel: the window around a pixel is laid over the other image by least squares.

Around each pixel the disparity is a plane, d + a x + b y, and the other camera may have another gain and offset in each frame; d, a and
b are those of the least sum of squared differences. Only pixels of the window whose own disparity lies near that plane take part, so that
a window at an edge of depth looks at one side of it. What remains of the differences gives the standard deviation.

Source: Lucas and Kanade, "An iterative image registration technique with an application to stereo vision", IJCAI 1981; gain and offset are
eliminated as in Golub and Pereyra's variable projection (SIAM J. Numer. Anal. 10(2), 1973), with Kaufman's approximation.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import new_array, pack_type
from kernels.stereo.cost import sliding

LANES_CPU, LANES_CUDA = 16, 1
"""Columns of the window that a thread takes together: on the CPU all nine, as SIMD."""
REACH = 4
"""Half side of the window: 9 × 9 pixels."""
CENTRE = 1
"""Half side of the middle of the window, whose differences tell whether the pixel itself belongs to the plane."""
STEPS = 2
"""Gauss-Newton steps."""
NEAR_PX = 1.25
"""Pixels take part whose disparity lies this near to the plane."""
LEAST_SHARE = 0.3
"""Least part of the window that must take part."""
SLOPE_SIGMA = 0.25
"""Standard deviation of slopes before any measurement, pixels of disparity a pixel: keeps them bounded where the window is narrow."""
EXACT = 1.0e-8
"""Least part of the squared contrast that is taken for noise: float32 cannot show a better fit."""
MOST_SLOPE = 0.45
"""Largest slope along a row: at the side of the window the plane then lies less than two pixels from its middle."""
MOST_STEP_PX = 0.5
"""Largest change of the disparity in one step."""

SHIFTS = 2
"""Most whole pixels by which a place of the plane may lie from that of its middle."""


class Refined(NamedTuple):
    """Refined disparities of a band of rows; 0 where there is none."""

    disparity: wp.array  # [rows, cols] float32
    slope_x: wp.array  # [rows, cols] float32, change of the disparity from column to column
    slope_y: wp.array  # [rows, cols] float32, from row to row
    sigma: wp.array  # [rows, cols] float32, standard deviation of the disparity; 0 where nothing was found
    misfit: wp.array  # [rows, cols] float32, differences in the window over the contrast of the window, root mean squares
    centre: wp.array  # [rows, cols] float32, the same in the middle of the window
    contrast: wp.array  # [rows, cols] float32, standard deviation of the left readings in the window


def refine(
    left: np.ndarray,  # [frames, rows, cols] float32, rectified
    right: np.ndarray,  # [frames, rows, right cols] float32
    disparity: np.ndarray,  # [rows, cols] float32, good to a pixel or so; NaN where there is none
    *, device: str,
) -> Refined:
    """Refine the disparities of a band of rows; not synchronised on CUDA."""
    _frames, rows, cols = left.shape
    lanes = LANES_CPU if device == "cpu" else LANES_CUDA
    side = lanes + REACH + SHIFTS + 4
    around = (0, 0), (0, 0), (side, side)
    images = [wp.array(np.pad(image, around, mode="edge").astype(np.float32, copy=False), dtype=wp.float32, device=device)
              for image in (left, right)]
    start = wp.array(np.pad(disparity, ((0, 0), (side, side)), constant_values=np.nan).astype(np.float32, copy=False), dtype=wp.float32,
                     device=device)
    found = Refined(*(new_array((rows, cols), wp.float32, device, cleared=True) for _ in range(7)))
    devices.launch(_refine_kernel(lanes), rows * cols, [*(sliding(image, lanes) for image in images), *images, sliding(start, lanes), start,
                                                        cols, right.shape[2], side], list(found), device=device, uneven=True)
    return found


@wp.func
def shifted(shift: float, a: float, b: float, c: float, d: float, e: float):
    """Return the value that lies `shift` pixels from c, of five neighbours."""
    return wp.where(shift < -1.5, a, wp.where(shift < -0.5, b, wp.where(shift < 0.5, c, wp.where(shift < 1.5, d, e))))


@once
def _refine_kernel(lanes: int) -> Any:
    lane = pack_type(lanes, wp.float32)
    width = 2 * REACH + 1
    blocks = -(-width // lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def refine_kernel(first: int,
                      left: wp.array(dtype=lane, ndim=3),  # [F, R, side + C + side] overlapping packs
                      right: wp.array(dtype=lane, ndim=3),  # [F, R, side + C' + side] overlapping packs
                      left_each: wp.array(dtype=wp.float32, ndim=3),  # [F, R, side + C + side]
                      right_each: wp.array(dtype=wp.float32, ndim=3),  # [F, R, side + C' + side]
                      near: wp.array(dtype=lane, ndim=2),  # [R, side + C + side] overlapping packs of disparities
                      start: wp.array(dtype=wp.float32, ndim=2),  # [R, side + C + side]
                      cols: int,
                      other_cols: int,
                      side: int,
                      # outputs
                      disparity: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      slope_x: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      slope_y: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      sigma: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      misfit: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      centre: wp.array(dtype=wp.float32, ndim=2),  # [R, C]
                      contrast: wp.array(dtype=wp.float32, ndim=2)):  # [R, C]
        i = first + wp.tid()
        frames = left.shape[0]
        rows = left.shape[1]
        r = i // cols
        c = i - r * cols
        plane = wp.vec3(start[r, side + c], 0.0, 0.0)  # disparity, slopes
        good = plane[0] == plane[0]
        step = wp.int32(0)
        while good and step <= STEPS:
            normal = wp.mat33()
            slope = wp.vec3()
            rest = float(0.0)
            spread = float(0.0)
            middle = float(0.0)
            count = float(0.0)
            for f in range(frames):
                n = float(0.0)
                sl = float(0.0)
                sw = float(0.0)
                sll = float(0.0)
                slw = float(0.0)
                sww = float(0.0)
                sg = wp.vec3()
                sgl = wp.vec3()
                sgw = wp.vec3()
                sgg = wp.mat33()
                base = left_each[f, r, side + c]
                for block in range(blocks):
                    lead = block * lanes - REACH
                    v_n = lane()
                    v_l = lane()
                    v_w = lane()
                    v_ll = lane()
                    v_lw = lane()
                    v_ww = lane()
                    v_g = lane()
                    v_gl = lane()
                    v_gw = lane()
                    v_gg = lane()
                    v_yg = lane()
                    v_ygl = lane()
                    v_ygw = lane()
                    v_ygg = lane()
                    v_yygg = lane()
                    for dy in range(wp.max(-REACH, -r), wp.min(REACH, rows - 1 - r) + 1):
                        down = float(dy)
                        at = float(c) - plane[0] - plane[2] * down
                        whole = wp.floor(at)
                        t0 = at - whole
                        x = int(whole)
                        if x >= REACH + SHIFTS + 1 and x < other_cols - REACH - SHIFTS - 2:
                            begin = side + x + lead
                            a0 = right[f, r + dy, begin - 3]
                            a1 = right[f, r + dy, begin - 2]
                            a2 = right[f, r + dy, begin - 1]
                            a3 = right[f, r + dy, begin]
                            a4 = right[f, r + dy, begin + 1]
                            a5 = right[f, r + dy, begin + 2]
                            a6 = right[f, r + dy, begin + 3]
                            a7 = right[f, r + dy, begin + 4]
                            values = left[f, r + dy, side + c + lead]
                            known = near[r + dy, side + c + lead]
                            for k in range(lanes):
                                dx = float(lead + k)
                                off = wp.abs(known[k] - (plane[0] + plane[1] * dx + plane[2] * down))
                                m = wp.where(off < NEAR_PX, 1.0, 0.0)
                                m = wp.where(lead + k <= REACH, m, 0.0)
                                place = t0 - plane[1] * dx
                                s = wp.floor(place)
                                t = place - s
                                p0 = shifted(s, a0[k], a1[k], a2[k], a3[k], a4[k])
                                p1 = shifted(s, a1[k], a2[k], a3[k], a4[k], a5[k])
                                p2 = shifted(s, a2[k], a3[k], a4[k], a5[k], a6[k])
                                p3 = shifted(s, a3[k], a4[k], a5[k], a6[k], a7[k])
                                e1 = 0.5 * (p2 - p0)
                                e2 = p0 - 2.5 * p1 + 2.0 * p2 - 0.5 * p3
                                e3 = 0.5 * (p3 - p0) + 1.5 * (p1 - p2)
                                w = m * (p1 + t * (e1 + t * (e2 + t * e3)) - base)
                                g = -m * (e1 + t * (2.0 * e2 + 3.0 * t * e3))
                                ours = m * (values[k] - base)
                                gg = g * g
                                gl = g * ours
                                gw = g * w
                                v_n[k] = v_n[k] + m
                                v_l[k] = v_l[k] + ours
                                v_w[k] = v_w[k] + w
                                v_ll[k] = v_ll[k] + ours * ours
                                v_lw[k] = v_lw[k] + ours * w
                                v_ww[k] = v_ww[k] + w * w
                                v_g[k] = v_g[k] + g
                                v_gl[k] = v_gl[k] + gl
                                v_gw[k] = v_gw[k] + gw
                                v_gg[k] = v_gg[k] + gg
                                v_yg[k] = v_yg[k] + down * g
                                v_ygl[k] = v_ygl[k] + down * gl
                                v_ygw[k] = v_ygw[k] + down * gw
                                v_ygg[k] = v_ygg[k] + down * gg
                                v_yygg[k] = v_yygg[k] + down * down * gg
                    for k in range(lanes):
                        dx = float(lead + k)
                        n += v_n[k]
                        sl += v_l[k]
                        sw += v_w[k]
                        sll += v_ll[k]
                        slw += v_lw[k]
                        sww += v_ww[k]
                        sg += wp.vec3(v_g[k], dx * v_g[k], v_yg[k])
                        sgl += wp.vec3(v_gl[k], dx * v_gl[k], v_ygl[k])
                        sgw += wp.vec3(v_gw[k], dx * v_gw[k], v_ygw[k])
                        xgg = dx * v_gg[k]
                        xygg = dx * v_ygg[k]
                        sgg += wp.mat33(v_gg[k], xgg, v_ygg[k], xgg, dx * xgg, xygg, v_ygg[k], xygg, v_yygg[k])
                good = good and n >= LEAST_SHARE * float(width * width)
                if good:
                    cll = sll - sl * sl / n
                    clw = slw - sl * sw / n
                    cww = sww - sw * sw / n
                    cgl = sgl - sg * (sl / n)
                    cgw = sgw - sg * (sw / n)
                    cgg = sgg - wp.outer(sg, sg) / n
                    good = cww > 1.0e-12 and clw > 0.0
                    if good:
                        gain = clw / cww
                        normal += (cgg - wp.outer(cgw, cgw) / cww) * (gain * gain)
                        slope += (cgl - cgw * gain) * gain
                        rest += wp.max(cll - clw * gain, 0.0)
                        spread += cll
                        count += n
                        if step == STEPS:
                            offset = base + (sl - gain * sw) / n - gain * base
                            for oy in range(-CENTRE, CENTRE + 1):
                                y = wp.clamp(r + oy, 0, rows - 1)
                                for ox in range(-CENTRE, CENTRE + 1):
                                    at = float(c + ox) - plane[0] - plane[1] * float(ox) - plane[2] * float(oy)
                                    whole = wp.floor(at)
                                    t = at - whole
                                    x = side + wp.clamp(int(whole), 1, other_cols - 3)
                                    p0 = right_each[f, y, x - 1]
                                    p1 = right_each[f, y, x]
                                    p2 = right_each[f, y, x + 1]
                                    p3 = right_each[f, y, x + 2]
                                    w = p1 + 0.5 * t * (p2 - p0 + t * (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3
                                                                       + t * (3.0 * (p1 - p2) + p3 - p0)))
                                    off = left_each[f, y, side + c + ox] - gain * w - offset
                                    middle += off * off
            if good:
                free = wp.max(count - 2.0 * float(frames) - 3.0, 1.0)
                variance = wp.max(rest, EXACT * spread) / free
                held = variance / (SLOPE_SIGMA * SLOPE_SIGMA)
                normal += wp.diag(wp.vec3(1.0e-12, held, held))
                slope = slope - wp.vec3(0.0, held * plane[1], held * plane[2])
                inverse = wp.inverse(normal)
                if step < STEPS:
                    change = inverse * slope
                    plane = wp.vec3(plane[0] + wp.clamp(change[0], -MOST_STEP_PX, MOST_STEP_PX),
                                    wp.clamp(plane[1] + change[1], -MOST_SLOPE, MOST_SLOPE), plane[2] + change[2])
                elif inverse[0, 0] > 0.0:
                    disparity[r, c] = plane[0]
                    slope_x[r, c] = plane[1]
                    slope_y[r, c] = plane[2]
                    sigma[r, c] = wp.sqrt(variance * inverse[0, 0])
                    misfit[r, c] = wp.sqrt(rest / wp.max(spread, 1.0e-20))
                    size = float(frames * (2 * CENTRE + 1) * (2 * CENTRE + 1))
                    centre[r, c] = wp.sqrt(middle / size / wp.max(spread / count, 1.0e-20))
                    contrast[r, c] = wp.sqrt(spread / count)
            step += 1

    return refine_kernel
