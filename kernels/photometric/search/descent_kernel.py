"""The kernel of `descent`: the turns of one pack of pixels, all lights in each."""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.elementary import log_of
from kernels.microfacet import diffuse_with_slopes, ggx_with_slopes, masking_root, masking_slope, schlick, short_tails
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.candidates import LEAST_NZ, tangents
from kernels.photometric.model.lobes import LOBE_SCALE, LOBES, MIXTURE, MIXTURE_F0
from kernels.photometric.model.robust_weights import LARGEST_SQUARE, LOG_GROUP, Criteria, weigh_grey
from kernels.photometric.model.samples import samples_type

SWEEPS = 8
"""Coordinate sweeps of the non-negative solve in each turn, from the weights of the turn before."""
LONGEST = 0.15
"""Longest step, radians."""
DAMPING, DAMPING_UP, DAMPING_DOWN, LEAST_DAMPING = 0.01, 8.0, 0.2, 1e-5
"""Initial damping relative to the curvature, the factors on it after a step that raised and one that lowered the cost, and its least."""
INERTIA = 0.1
"""Part of its curvature with which a weight of a GGX lobe is held where it was in the turn before. Lobes are much alike, and freely moved
their weights follow each other and the tilt into the noise: normals of path-traced paint were 0.09 degrees worse without it."""
LEAST_PIVOT = 1e-4
"""Part of its curvature that a weight must keep beside the weights before it to be eliminated: lobes much alike count as one."""
UNKNOWNS = MIXTURE + 2
"""Weights and two tilts."""
TILT, OTHER = MIXTURE, MIXTURE + 1


@wp.func
def entry(row: int, column: int):
    """Return the place of an element of a symmetric matrix, row ≥ column, in the list of its lower triangle."""
    return row * (row + 1) / 2 + column


@wp.func
def moved_by(n: wp.vec3, along: wp.vec3, across: wp.vec3, v: wp.vec3) -> wp.vec3:
    """Return the unit normal moved by a step along its tangents, and along the view v where it would look away from the viewer."""
    mx = n[0] + along[0] + across[0]
    my = n[1] + along[1] + across[1]
    mz = n[2] + along[2] + across[2]
    size = wp.sqrt(mx * mx + my * my + mz * mz)
    lift = wp.max(LEAST_NZ - (mx * v[0] + my * v[1] + mz * v[2]) / size, 0.0)
    mx = mx / size + lift * v[0]
    my = my / size + lift * v[1]
    mz = mz / size + lift * v[2]
    unit = 1.0 / wp.sqrt(mx * mx + my * my + mz * mz)
    return wp.vec3(mx * unit, my * unit, mz * unit)


@wp.func
def damped_step(s00: float, s01: float, s11: float, y0: float, y1: float, damping: float, moves: float):
    """Return the damped Newton step of two tilts, LONGEST at most, from their normal equations s t = y; 0 where `moves` is 0.0."""
    heavier = damping * (s00 + s11) + 1.0e-20
    d00 = s00 + heavier
    d11 = s11 + heavier
    determinant = d00 * d11 - s01 * s01
    scale = moves * wp.where(determinant > 0.0, 1.0, 0.0) / wp.max(determinant, 1.0e-30)
    along = (d11 * y0 - s01 * y1) * scale
    across = (d00 * y1 - s01 * y0) * scale
    shorter = wp.min(1.0, LONGEST / wp.max(wp.sqrt(along * along + across * across), 1.0e-20))
    return along * shorter, across * shorter


@once
def descent_kernel(lanes: int) -> Any:
    """Return the kernel for one width of packs."""
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)
    mixture = wp.types.matrix(shape=(MIXTURE, lanes), dtype=wp.float32)
    rows = wp.types.matrix(shape=(UNKNOWNS, lanes), dtype=wp.float32)
    triangle = wp.types.matrix(shape=(UNKNOWNS * (UNKNOWNS + 1) // 2, lanes), dtype=wp.float32)
    widths = wp.types.vector(length=len(LOBES), dtype=wp.float32)
    gloss = len(LOBES)

    @wp.func
    def eliminated(x: mixture, g: triangle, r: rows):
        """Return the L D Lᵀ of normal equations without the weights above 0, those at 0 having no row, and their right-hand side."""
        on, y = rows(), rows()
        left = triangle()
        for a in range(UNKNOWNS):
            for k in range(lanes):
                on[a, k] = 1.0
        for a in range(MIXTURE):
            for k in range(lanes):
                on[a, k] = wp.where(x[a, k] > 0.0, 1.0, 0.0)
        for a in range(UNKNOWNS):
            for k in range(lanes):
                y[a, k] = on[a, k] * r[a, k]
            for b in range(a + 1):
                for k in range(lanes):
                    left[entry(a, b), k] = on[a, k] * on[b, k] * g[entry(a, b), k]
        for b in range(MIXTURE):
            inverse_pivot = lane_type()
            for k in range(lanes):
                pivot = left[entry(b, b), k]
                inverse_pivot[k] = wp.where(pivot > LEAST_PIVOT * g[entry(b, b), k], 1.0 / wp.max(pivot, 1.0e-30), 0.0)
            for a in range(b + 1, UNKNOWNS):
                share = lane_type()
                for k in range(lanes):
                    share[k] = left[entry(a, b), k] * inverse_pivot[k]
                    y[a, k] -= share[k] * y[b, k]
                for c in range(b + 1, a + 1):
                    for k in range(lanes):
                        left[entry(a, c), k] -= share[k] * left[entry(c, b), k]
        return left, y

    @wp.func
    def mixed(x: mixture, g: triangle, r: rows, pivots: mixture):
        """Return the weights after SWEEPS coordinate sweeps of the non-negative solve."""
        sweeps = int(SWEEPS)  # a literal would be unrolled
        for _ in range(sweeps):
            for a in range(MIXTURE):
                rest = lane_type()
                for k in range(lanes):
                    rest[k] = r[a, k]
                for b in range(MIXTURE):
                    for k in range(lanes):
                        rest[k] -= g[entry(wp.max(a, b), wp.min(a, b)), k] * x[b, k]
                for k in range(lanes):
                    x[a, k] = wp.max(x[a, k] + rest[k] * pivots[a, k], 0.0)
        return x

    # on CUDA every element must have a register of its own, on the CPU the lanes are what the compiler unrolls
    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0 if lanes > 1 else 2 * UNKNOWNS})
    def descend_kernel(first: int,
                       samples: samples_struct,
                       drawn: wp.array2d(dtype=lane_type),  # [3, P] normal of the prior
                       pull: wp.vec2,  # its strength, and 1 / rad² of its angle
                       criteria: Criteria,
                       soft: wp.vec2,  # factor on σ² in the first turn, and its own factor from turn to turn
                       turns: wp.vec2i,  # softened ones, and all
                       # outputs
                       normal: wp.array2d(dtype=lane_type),  # [3, P] in: start, out: best
                       weights: wp.array2d(dtype=lane_type),  # [lobes, P] in: start, out: of the best
                       found: wp.array2d(dtype=lane_type)):  # [3, P] cost, curvature, swing
        p = first + wp.tid()
        alphas = widths(wp.static(LOBES[0]), wp.static(LOBES[1]), wp.static(LOBES[2]), wp.static(LOBES[3]), wp.static(LOBES[4]))
        vx, vy, vz = vector_at(samples.view, p)
        ux, uy, uz = vector_at(drawn, p)
        nx, ny, nz = vector_at(normal, p)
        bx, by, bz = lane_type(), lane_type(), lane_type()
        best, damping, undone = lane_type(1.0e30), lane_type(DAMPING), lane_type()
        curvature, swing = lane_type(), lane_type()
        x, x_best = mixture(), mixture()
        for a in range(MIXTURE):
            given_weight = weights[a, p]
            for k in range(lanes):
                x[a, k] = given_weight[k]
        variance = float(soft[0])  # relative to that of the noise
        for turn in range(turns[1]):
            narrow = 1.0 / wp.max(variance, 1.0)
            variance = variance * soft[1]
            judged = wp.where(turn >= turns[0], 1.0, 0.0)
            free = wp.where(turn >= wp.min(turns[0], 1), 1.0, 0.0)  # the first turn without weights finds them alone
            ax, ay, az, ox, oy, oz = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            nv, va, vo = lane_type(), lane_type(), lane_type()
            known = lane_type(judged)  # above 0 where there are weights; before any are found, no reading is a misfit
            for k in range(lanes):
                tangent, other = tangents(wp.vec3(nx[k], ny[k], nz[k]))
                ax[k] = tangent[0]
                ay[k] = tangent[1]
                az[k] = tangent[2]
                ox[k] = other[0]
                oy[k] = other[1]
                oz[k] = other[2]
            view_root, view_slope = mixture(), mixture()
            for k in range(lanes):
                nv[k] = nx[k] * vx[k] + ny[k] * vy[k] + nz[k] * vz[k]
                va[k] = ax[k] * vx[k] + ay[k] * vy[k] + az[k] * vz[k]
                vo[k] = ox[k] * vx[k] + oy[k] * vy[k] + oz[k] * vz[k]
            for a in range(gloss):
                for k in range(lanes):
                    view_root[a, k] = masking_root(nv[k], alphas[a])
                    view_slope[a, k] = masking_slope(nv[k], alphas[a], view_root[a, k])
            for a in range(MIXTURE):
                for k in range(lanes):
                    known[k] = wp.max(known[k], x[a, k])
            # normal equations of weights and tilts, and the cost
            total, product = lane_type(), lane_type(1.0)
            g = triangle()
            r = rows()
            for light in range(samples.light_count):
                at = p * samples.pack_stride + light * samples.light_stride
                reading = samples.grey[at]
                lx, ly, lz = vector_at(samples.toward, at)
                nl, la, lo, nh, inverse, fresnel = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
                by_h, by_l, by_v, predicted, w = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
                f = rows()
                for k in range(lanes):
                    lv = lx[k] * vx[k] + ly[k] * vy[k] + lz[k] * vz[k]
                    hv2 = wp.max(0.5 + 0.5 * lv, 2.5e-7)
                    hv = wp.sqrt(hv2)
                    inverse[k] = 0.5 / hv  # 1 / |l + v|
                    fresnel[k] = LOBE_SCALE * (MIXTURE_F0 + (1.0 - MIXTURE_F0) * schlick(hv))
                    cosine = nx[k] * lx[k] + ny[k] * ly[k] + nz[k] * lz[k]
                    la[k] = ax[k] * lx[k] + ay[k] * ly[k] + az[k] * lz[k]
                    lo[k] = ox[k] * lx[k] + oy[k] * ly[k] + oz[k] * lz[k]
                    nl[k] = wp.max(cosine, 0.0)
                    nh[k] = (cosine + nv[k]) * inverse[k]
                    value, on_l, on_v = diffuse_with_slopes(nl[k], nv[k], hv2, criteria.form)
                    f[0, k] = value
                    predicted[k] = x[0, k] * value
                    by_l[k] = x[0, k] * on_l
                    by_v[k] = x[0, k] * on_v
                for a in range(gloss):
                    fall, on_fall = lane_type(1.0), lane_type()
                    if criteria.form[2] > 0.0:
                        for k in range(lanes):
                            short, on_short = short_tails(nh[k], alphas[a])
                            fall[k] = short
                            on_fall[k] = on_short
                    for k in range(lanes):
                        lobe, on_h, along_l, along_v, _ = ggx_with_slopes(nl[k], nv[k], nh[k], alphas[a], view_root[a, k],
                                                                                     view_slope[a, k])
                        scaled = fresnel[k] * fall[k] * x[1 + a, k]
                        f[1 + a, k] = fresnel[k] * fall[k] * lobe
                        predicted[k] += scaled * lobe
                        by_h[k] += scaled * on_h + fresnel[k] * on_fall[k] * x[1 + a, k] * lobe
                        by_l[k] += scaled * along_l
                        by_v[k] += scaled * along_v
                for k in range(lanes):
                    f[TILT, k] = by_h[k] * (la[k] + va[k]) * inverse[k] + by_l[k] * la[k] + by_v[k] * va[k]
                    f[OTHER, k] = by_h[k] * (lo[k] + vo[k]) * inverse[k] + by_l[k] * lo[k] + by_v[k] * vo[k]
                    sigma = 1.0 / (criteria.noise[0] + criteria.noise[1] * wp.max(reading[k], 0.0))
                    off = (reading[k] - predicted[k]) * sigma
                    off2 = wp.where(known[k] > 0.0, wp.min(off * off * narrow, LARGEST_SQUARE), 0.0)
                    given = wp.where(reading[k] >= 0.0, 1.0, 0.0)
                    weight, factor = weigh_grey(reading[k], predicted[k], off2, given, sigma, criteria.shadow)
                    w[k] = weight
                    product[k] = product[k] * factor
                if light % LOG_GROUP == LOG_GROUP - 1:
                    for k in range(lanes):
                        total[k] += log_of(product[k])
                        product[k] = 1.0
                for a in range(UNKNOWNS):
                    wf = lane_type()
                    for k in range(lanes):
                        wf[k] = w[k] * f[a, k]
                        r[a, k] += wf[k] * reading[k]
                    for b in range(a + 1):
                        for k in range(lanes):
                            g[entry(a, b), k] += wf[k] * f[b, k]
            for a in range(1, MIXTURE):
                for k in range(lanes):
                    r[a, k] += INERTIA * g[entry(a, a), k] * x[a, k]
                    g[entry(a, a), k] = (1.0 + INERTIA) * g[entry(a, a), k]
            worse = lane_type()
            for k in range(lanes):
                away = wp.max(2.0 - 2.0 * (nx[k] * ux[k] + ny[k] * uy[k] + nz[k] * uz[k]), 0.0)
                total[k] += log_of(product[k]) + pull[0] * log_of(1.0 + pull[1] * away)
                draw = pull[0] * pull[1] / (1.0 + pull[1] * away)
                g[entry(TILT, TILT), k] += draw
                g[entry(OTHER, OTHER), k] += draw
                r[TILT, k] += draw * (ux[k] * ax[k] + uy[k] * ay[k] + uz[k] * az[k])
                r[OTHER, k] += draw * (ux[k] * ox[k] + uy[k] * oy[k] + uz[k] * oz[k])
                worse[k] = judged * wp.where(total[k] >= best[k], 1.0, 0.0) * wp.where(undone[k] == 0.0, 1.0, 0.0)
            left, y = eliminated(x, g, r)
            # keep what costs less, go back from what costs more, and step
            step_a, step_o = lane_type(), lane_type()
            for k in range(lanes):
                s00 = left[entry(TILT, TILT), k]
                s01 = left[entry(OTHER, TILT), k]
                s11 = left[entry(OTHER, OTHER), k]
                back = worse[k] > 0.0
                kept = judged * (1.0 - worse[k]) > 0.0
                eased = wp.where(undone[k] == 0.0, wp.max(damping[k] * DAMPING_DOWN, LEAST_DAMPING), damping[k])
                damping[k] = wp.where(back, damping[k] * DAMPING_UP, wp.where(kept, eased, damping[k]))
                undone[k] = worse[k]
                best[k] = wp.where(kept, total[k], best[k])
                bx[k] = wp.where(kept, nx[k], bx[k])
                by[k] = wp.where(kept, ny[k], by[k])
                bz[k] = wp.where(kept, nz[k], bz[k])
                nx[k] = wp.where(back, bx[k], nx[k])
                ny[k] = wp.where(back, by[k], ny[k])
                nz[k] = wp.where(back, bz[k], nz[k])
                curvature[k] = wp.where(kept, 0.5 * (s00 + s11), curvature[k])
                swing[k] = wp.where(kept, wp.sqrt(0.25 * (s00 - s11) * (s00 - s11) + s01 * s01), swing[k])
                along, across = damped_step(s00, s01, s11, y[TILT, k], y[OTHER, k], damping[k], free * (1.0 - worse[k]))
                step_a[k] = along
                step_o[k] = across
            pivots = mixture()
            for a in range(MIXTURE):
                for k in range(lanes):
                    kept = judged * (1.0 - worse[k]) > 0.0
                    x_best[a, k] = wp.where(kept, x[a, k], x_best[a, k])
                    x[a, k] = wp.where(worse[k] > 0.0, x_best[a, k], x[a, k])
                    pivots[a, k] = (1.0 - worse[k]) / (g[entry(a, a), k] + 1.0e-8)
                    r[a, k] -= g[entry(TILT, a), k] * step_a[k] + g[entry(OTHER, a), k] * step_o[k]
            x = mixed(x, g, r, pivots)
            for k in range(lanes):
                one = step_a[k] * wp.vec3(ax[k], ay[k], az[k])
                two = step_o[k] * wp.vec3(ox[k], oy[k], oz[k])
                n = moved_by(wp.vec3(nx[k], ny[k], nz[k]), one, two, wp.vec3(vx[k], vy[k], vz[k]))
                nx[k] = n[0]
                ny[k] = n[1]
                nz[k] = n[2]
        for k in range(lanes):
            best[k] = best[k] / float(samples.light_count)
            curvature[k] = curvature[k] / float(samples.light_count)
            swing[k] = swing[k] / float(samples.light_count)
        normal[0, p] = bx
        normal[1, p] = by
        normal[2, p] = bz
        found[0, p] = best
        found[1, p] = curvature
        found[2, p] = swing
        for a in range(MIXTURE):
            kept_weight = lane_type()
            for k in range(lanes):
                kept_weight[k] = x_best[a, k]
            weights[a, p] = kept_weight

    return descend_kernel
