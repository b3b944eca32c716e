"""Joint refinement of normal, roughness, albedo and F0 by Levenberg-Marquardt, on readings that one GGX lobe explains.

The search's mixture of fixed lobes is safe on surfaces of any kind, and as coarse as its lobes: on a surface whose one lobe is that of
Relit's BRDF, a metal above all, that lobe with the roughness of the pixel is sharper. So the whole model is fitted from
where the search ended: two tilts of the normal and the roughness by Gauss-Newton steps on the readings re-weighted as in the search,
with the six linear unknowns, albedo and F0 of three channels, eliminated from every step (variable projection).

Source: Levenberg-Marquardt with eliminated linear parameters after Golub and Pereyra, "Separable nonlinear least squares", Inverse
Problems 2003; Cauchy weights as in hypotheses.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import log_of
from kernels.microfacet import INVERSE_PI, diffuse_with_slopes, ggx_with_slopes, masking_root, masking_slope, schlick
from kernels.packs import channels_type, pack_type
from kernels.photometric.model.candidates import LEAST_NZ, tangents
from kernels.photometric.model.robust_weights import LOG_GROUP, WEIGHT_ROWS, Criteria, plain_weights, weigh
from kernels.photometric.model.samples import Samples, per_pixel, samples_type, scratch_memory, scratch_type, to_host
from kernels.photometric.search.hypotheses import LobeShape, criteria

LINEAR_TURNS = 2
"""Rounds of the robust linear fit before the first step."""
STEPS = 12
"""Number of steps, including those that are undone."""
LONGEST_TILT, LONGEST_BEND = 0.05, 0.1
"""Largest change of the normal, radians, and of the roughness in one step."""
DAMPING, DAMPING_UP, DAMPING_DOWN = 0.3, 8.0, 0.3
"""Initial damping of Levenberg-Marquardt, and the factors on it after a step that raised and one that lowered the cost. With an initial
damping of 0.01 the cost of real and path-traced objects ends up to two per cent higher, with 1.0 that of metals one per cent."""
LEAST_ROUGHNESS = 0.05
"""Least roughness: a narrower lobe falls between the lights of any rig."""

OPEN = 1.0e6
"""Variance of a normal that the readings leave open, squared radians per unit of noise."""
HELD = WEIGHT_ROWS + 2
"""Values that scratch memory holds for each light: its weights, h·v and Schlick's rise."""


class Refinement(NamedTuple):
    """Refined normal and material of each sampled pixel."""

    normal: np.ndarray  # [n, 3] float32, unit
    roughness: np.ndarray  # [n] float32
    cost: np.ndarray  # [n] float32, per light, as of the material fit
    openness: np.ndarray  # [n] float32, variance of the normal per unit of noise, both tilts together, squared radians


def refine(samples: Samples, normal: np.ndarray, roughness: np.ndarray, *, shape: LobeShape) -> Refinement:
    """Refine the normal and material of sampled pixels under lights of one direction each; waits for the device.

    The result is the best fit met on the way, never of higher cost than the first.
    `normal`: [n, 3] unit normals, within a few degrees of the truth. `roughness`: [n] of the material fit at these normals."""
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    refined = wp.empty((6, packs), dtype=pack_type(lanes, wp.float32), device=device)
    start = np.concatenate([normal, roughness[:, None]], axis=1)
    scratch = scratch_memory(samples, HELD)
    devices.launch(_refine_kernel(lanes), packs,
                   [samples.arrays, per_pixel(samples, start), criteria(None, shape)], [scratch, refined], device=device)
    values = to_host(samples, refined)
    return Refinement(values[:, :3], values[:, 3], values[:, 4] / samples.light_count, values[:, 5])


@wp.func
def active(dd: float, ds: float, ss: float, rd: float, rs: float):
    """Return which of two non-negative unknowns, albedo and F0, are above 0 in the least-squares fit: 1.0 or 0.0 of each."""
    bottom = dd * ss - ds * ds
    safe = bottom > 1.0e-6 * dd * ss
    both = safe and ss * rd >= ds * rs and dd * rs >= ds * rd
    gain_d = wp.max(rd, 0.0) * wp.max(rd, 0.0) * ss
    gain_s = wp.max(rs, 0.0) * wp.max(rs, 0.0) * dd
    first = wp.where(gain_d >= gain_s, 1.0, 0.0)
    return wp.where(both, 1.0, first), wp.where(both, 1.0, 1.0 - first)


@wp.func
def solve_symmetric(m00: float, m01: float, m02: float, m11: float, m12: float, m22: float, b: wp.vec3):
    """Return the solution of a symmetric positive definite 3 × 3 system; 0 where it is not one."""
    c00, c01, c02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    bottom = m00 * c00 + m01 * c01 + m02 * c02
    c11, c12, c22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    x = wp.vec3(c00 * b[0] + c01 * b[1] + c02 * b[2], c01 * b[0] + c11 * b[1] + c12 * b[2], c02 * b[0] + c12 * b[1] + c22 * b[2])
    sound = m00 > 0.0 and m11 > 0.0 and m22 > 0.0 and bottom > 1.0e-6 * m00 * m11 * m22
    return wp.where(sound, x / wp.max(bottom, 1.0e-30), wp.vec3())


@wp.func
def tilt_variance(m00: float, m01: float, m02: float, m11: float, m12: float, m22: float):
    """Return the sum of the first two diagonal elements of the inverse of a symmetric 3 × 3 matrix; OPEN where it is not positive."""
    c00 = m11 * m22 - m12 * m12
    c11 = m00 * m22 - m02 * m02
    bottom = m00 * c00 + m01 * (m02 * m12 - m01 * m22) + m02 * (m01 * m12 - m02 * m11)
    sound = m22 > 0.0 and c00 > 0.0 and c11 > 0.0 and bottom > 1.0e-6 * m00 * m11 * m22
    return wp.where(sound, (c00 + c11) / wp.max(bottom, 1.0e-30), OPEN)


@once
def _refine_kernel(lanes: int) -> Any:
    write_weights = plain_weights(lanes)
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    channels = channels_type(lanes)
    triples = wp.types.matrix(shape=(9, lanes), dtype=wp.float32)  # [3 · channel + unknown]
    squares = wp.types.matrix(shape=(6, lanes), dtype=wp.float32)  # 00 01 02 11 12 22

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def refine_kernel(first: int,
                      samples: samples_struct,
                      start: wp.array2d(dtype=lane_type),  # [4, P] normal, roughness
                      criteria: Criteria,
                      # outputs
                      scratch: scratch_struct,  # HELD values a light
                      refined: wp.array2d(dtype=lane_type)):  # [6, P] normal, roughness, cost, openness
        p = first + wp.tid()
        vx = samples.view[0, p]
        vy = samples.view[1, p]
        vz = samples.view[2, p]
        nx = start[0, p]
        ny = start[1, p]
        nz = start[2, p]
        rough = start[3, p]
        write_weights(samples, criteria.noise, p, 0, scratch)
        shadow = criteria.shadow
        form = criteria.form
        colour = samples.colour
        toward = samples.toward
        values = scratch.values
        light_stride = samples.light_stride
        light_step = scratch.light_stride
        step = scratch.step
        first_light = p * samples.pack_stride
        base = p * scratch.pack_stride
        for light in range(samples.light_count):
            element = first_light + light * light_stride
            lx = toward[0, element]
            ly = toward[1, element]
            lz = toward[2, element]
            hv, rise = lane_type(), lane_type()
            for k in range(lanes):
                hv[k] = wp.sqrt(wp.max(0.5 + 0.5 * (lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]), 2.5e-7))
                rise[k] = schlick(hv[k])
            at = base + light * light_step
            values[at + WEIGHT_ROWS * step] = hv
            values[at + wp.static(WEIGHT_ROWS + 1) * step] = rise
        best, damping, again, openness = lane_type(1.0e30), lane_type(DAMPING), lane_type(), lane_type(OPEN)
        best_x, best_y, best_z, best_rough = lane_type(), lane_type(), lane_type(), lane_type()
        rho, f0, best_rho, best_f0 = channels(), channels(), channels(), channels()
        for turn in range(wp.static(LINEAR_TURNS + STEPS + 1)):
            ax, ay, az, ox, oy, oz = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            nv, va, vo, alpha, view_root, view_slope = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                tangent, other = tangents(wp.vec3(nx[k], ny[k], nz[k]))
                ax[k] = tangent[0]
                ay[k] = tangent[1]
                az[k] = tangent[2]
                ox[k] = other[0]
                oy[k] = other[1]
                oz[k] = other[2]
            for k in range(lanes):
                nv[k] = wp.max(nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k], 1.0e-3)
                va[k] = ax[k] * vx[k] + ay[k] * vy[k] + az[k] * vz[k]
                vo[k] = ox[k] * vx[k] + oy[k] * vy[k] + oz[k] * vz[k]
                alpha[k] = rough[k] * rough[k]
                view_root[k] = masking_root(nv[k], alpha[k])
                view_slope[k] = masking_slope(nv[k], alpha[k], view_root[k])
            heeded = wp.where(turn == 0, 0.0, 1.0)  # at first nothing is known of the misfit
            cost, product = lane_type(), lane_type(1.0)
            dd, ds, ss = lane_type(), lane_type(), lane_type()
            rd, rs = channels(), channels()
            jd, js, jy = triples(), triples(), triples()
            jj = squares()
            for light in range(samples.light_count):
                element = first_light + light * light_stride
                at = base + light * light_step
                lx = toward[0, element]
                ly = toward[1, element]
                lz = toward[2, element]
                hv = values[at + WEIGHT_ROWS * step]
                rise = values[at + wp.static(WEIGHT_ROWS + 1) * step]
                # responses, and their derivatives by the two tilts and the roughness
                fd, fs, fixed, d0, d1 = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
                s0, s1, s2 = lane_type(), lane_type(), lane_type()
                for k in range(lanes):
                    inverse = 0.5 / hv[k]  # 1 / |l + v|
                    cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                    la = ax[k] * lx[k] + ay[k] * ly[k] + az[k] * lz[k]
                    lo = ox[k] * lx[k] + oy[k] * ly[k] + oz[k] * lz[k]
                    nl = wp.max(cosine, 0.0)
                    lobe, by_h, by_l, by_v, by_a2 = ggx_with_slopes(nl, nv[k], (cosine + nv[k]) * inverse, alpha[k], view_root[k],
                                                                     view_slope[k])
                    value, on_l, on_v = diffuse_with_slopes(nl, nv[k], hv[k] * hv[k], form)
                    fd[k] = INVERSE_PI * value
                    d0[k] = INVERSE_PI * (on_l * la + on_v * va[k])
                    d1[k] = INVERSE_PI * (on_l * lo + on_v * vo[k])
                    fixed[k] = rise[k] * lobe
                    fs[k] = lobe - fixed[k]
                    s0[k] = by_h * (la + va[k]) * inverse + by_l * la + by_v * va[k]
                    s1[k] = by_h * (lo + vo[k]) * inverse + by_l * lo + by_v * vo[k]
                    s2[k] = by_a2 * 4.0 * alpha[k] * rough[k]
                plain = values[at]
                off2, shining, expected, w = lane_type(), lane_type(), lane_type(), lane_type()
                for c in range(3):
                    y = colour[c, element]
                    inverse_sigma = values[at + (1 + c) * step]
                    for k in range(lanes):
                        predicted = rho[c, k] * fd[k] + f0[c, k] * fs[k] + fixed[k]
                        off = (y[k] - predicted) * inverse_sigma[k]
                        off2[k] += off * off
                        shining[k] += y[k]
                        expected[k] += predicted
                wd, ws = lane_type(), lane_type()
                for k in range(lanes):
                    weight, factor = weigh(shining[k], expected[k], heeded * off2[k], plain[k], shadow)
                    w[k] = weight
                    product[k] = product[k] * factor
                    wd[k] = weight * fd[k]
                    ws[k] = weight * fs[k]
                    dd[k] += wd[k] * fd[k]
                    ds[k] += wd[k] * fs[k]
                    ss[k] += ws[k] * fs[k]
                if light % LOG_GROUP == LOG_GROUP - 1:
                    for k in range(lanes):
                        cost[k] += log_of(product[k])
                        product[k] = 1.0
                for c in range(3):
                    y = colour[c, element]
                    for k in range(lanes):
                        left = y[k] - fixed[k]
                        shine = f0[c, k] * (1.0 - rise[k]) + rise[k]
                        rd[c, k] += wd[k] * left
                        rs[c, k] += ws[k] * left
                        j0 = rho[c, k] * d0[k] + shine * s0[k]
                        j1 = rho[c, k] * d1[k] + shine * s1[k]
                        j2 = shine * s2[k]
                        jd[3 * c, k] += j0 * wd[k]
                        jd[3 * c + 1, k] += j1 * wd[k]
                        jd[3 * c + 2, k] += j2 * wd[k]
                        js[3 * c, k] += j0 * ws[k]
                        js[3 * c + 1, k] += j1 * ws[k]
                        js[3 * c + 2, k] += j2 * ws[k]
                        wj0 = w[k] * j0
                        wj1 = w[k] * j1
                        wj2 = w[k] * j2
                        jy[3 * c, k] += wj0 * left
                        jy[3 * c + 1, k] += wj1 * left
                        jy[3 * c + 2, k] += wj2 * left
                        jj[0, k] += wj0 * j0
                        jj[1, k] += wj0 * j1
                        jj[2, k] += wj0 * j2
                        jj[3, k] += wj1 * j1
                        jj[4, k] += wj1 * j2
                        jj[5, k] += wj2 * j2
            for k in range(lanes):
                cost[k] += log_of(product[k])
            for k in range(lanes):
                if turn >= LINEAR_TURNS and cost[k] >= best[k] and again[k] == 0.0:
                    # the step cost more: back to the best, and a shorter one from there in the next turn
                    again[k] = 1.0
                    damping[k] = damping[k] * DAMPING_UP
                    nx[k] = best_x[k]
                    ny[k] = best_y[k]
                    nz[k] = best_z[k]
                    rough[k] = best_rough[k]
                    for c in range(3):
                        rho[c, k] = best_rho[c, k]
                        f0[c, k] = best_f0[c, k]
                else:
                    if turn >= LINEAR_TURNS:
                        damping[k] = wp.where(again[k] == 0.0, wp.max(damping[k] * DAMPING_DOWN, 1.0e-6), damping[k])
                        again[k] = 0.0
                        best[k] = cost[k]
                        best_x[k] = nx[k]
                        best_y[k] = ny[k]
                        best_z[k] = nz[k]
                        best_rough[k] = rough[k]
                        for c in range(3):
                            best_rho[c, k] = rho[c, k]
                            best_f0[c, k] = f0[c, k]
                    # normal equations of the step, albedo and then F0 of each channel eliminated
                    m00, m01, m02 = jj[0, k], jj[1, k], jj[2, k]
                    m11, m12, m22 = jj[3, k], jj[4, k], jj[5, k]
                    right = wp.vec3()
                    for c in range(3):
                        d_on, s_on = active(dd[k], ds[k], ss[k], rd[c, k], rs[c, k])
                        e = wp.vec3(jd[3 * c, k], jd[3 * c + 1, k], jd[3 * c + 2, k]) * d_on
                        inverse = d_on / wp.max(dd[k], 1.0e-20)
                        h = wp.vec3(js[3 * c, k], js[3 * c + 1, k], js[3 * c + 2, k]) - (inverse * ds[k]) * e
                        below = ss[k] - inverse * ds[k] * ds[k]
                        further = s_on / wp.max(below, 1.0e-20)
                        m00 -= inverse * e[0] * e[0] + further * h[0] * h[0]
                        m01 -= inverse * e[0] * e[1] + further * h[0] * h[1]
                        m02 -= inverse * e[0] * e[2] + further * h[0] * h[2]
                        m11 -= inverse * e[1] * e[1] + further * h[1] * h[1]
                        m12 -= inverse * e[1] * e[2] + further * h[1] * h[2]
                        m22 -= inverse * e[2] * e[2] + further * h[2] * h[2]
                        right += wp.vec3(jy[3 * c, k], jy[3 * c + 1, k], jy[3 * c + 2, k])
                        right -= (inverse * rd[c, k]) * e + (further * (rs[c, k] - inverse * ds[k] * rd[c, k])) * h
                    openness[k] = tilt_variance(m00, m01, m02, m11, m12, m22)
                    heavier = 1.0 + damping[k]
                    move = solve_symmetric(heavier * m00, m01, m02, heavier * m11, m12, heavier * m22, right)
                    move = wp.where(turn < LINEAR_TURNS, wp.vec3(), move)
                    length = wp.sqrt(move[0] * move[0] + move[1] * move[1])
                    bend = wp.max(wp.abs(move[2]), 1.0e-20)
                    move = move * wp.min(1.0, wp.min(LONGEST_TILT / wp.max(length, 1.0e-20), LONGEST_BEND / bend))
                    for c in range(3):
                        d_on, s_on = active(dd[k], ds[k], ss[k], rd[c, k], rs[c, k])
                        d_rest = rd[c, k] - (jd[3 * c, k] * move[0] + jd[3 * c + 1, k] * move[1] + jd[3 * c + 2, k] * move[2])
                        s_rest = rs[c, k] - (js[3 * c, k] * move[0] + js[3 * c + 1, k] * move[1] + js[3 * c + 2, k] * move[2])
                        inverse = d_on / wp.max(dd[k], 1.0e-20)
                        below = wp.max(ss[k] - inverse * ds[k] * ds[k], 1.0e-20)
                        shine = wp.clamp(s_on * (s_rest - inverse * ds[k] * d_rest) / below, 0.0, 1.0)
                        f0[c, k] = shine
                        rho[c, k] = wp.max(inverse * (d_rest - ds[k] * shine), 0.0)
                    n = wp.vec3(nx[k], ny[k], nz[k])
                    a, b = tangents(n)
                    n = n + move[0] * a + move[1] * b
                    v = wp.vec3(vx[k], vy[k], vz[k])
                    n = wp.normalize(n + wp.max(LEAST_NZ - wp.dot(n, v), 0.0) * v)
                    nx[k] = n[0]
                    ny[k] = n[1]
                    nz[k] = n[2]
                    rough[k] = wp.clamp(rough[k] + move[2], LEAST_ROUGHNESS, 1.0)
        refined[0, p] = best_x
        refined[1, p] = best_y
        refined[2, p] = best_z
        refined[3, p] = best_rough
        refined[4, p] = best
        unit = samples.level[p]
        for k in range(lanes):
            openness[k] *= 3.0 * unit[k] * unit[k]  # weights are relative to the level, and those of the mean of three channels
        refined[5, p] = openness

    return refine_kernel
