"""The kernel of the material fit: albedo, F0 and roughness of each pixel of a pack, by re-weighted non-negative least squares at each
roughness that is tried, and the best of them."""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.elementary import log_of
from kernels.packs import channels_type, pack_type, vector_at
from kernels.photometric.model.lobes import Reflectance
from kernels.photometric.model.robust_weights import LOG_GROUP, Criteria, plain_weights, weigh
from kernels.photometric.model.samples import samples_type, scratch_type

ROUGHNESS_FIRST, ROUGHNESS_STEP, ROUGHNESS_COUNT = 0.1, 0.075, 13
"""First value, step and length of the grid of roughness, 0.1 to 1: a lobe below 0.1 is narrower than the spacing of the lights of any
rig."""
HALVINGS = 3
"""Number of times that the step about the best roughness is halved: to a resolution of 0.01."""
REWEIGHTINGS, WARM_REWEIGHTINGS = 4, 2
"""Rounds of the robust fit at the first roughness, and at those that follow, which begin with the weights of the one before or of the best:
three rounds change no error by more than a hundredth of itself. Each roughness begins anew under extended lights, whose tables have a
surface without a lobe beside those with one, and in pixels that are searched again because their F0 is an outlier."""
COMMON_ROUNDS = 3
"""Rounds of the fit of an F0 that the channels share. Each round fixes which channels have an albedo above 0; after three this no longer
changes."""

TINTED = wp.constant(0)
"""Fit mode with free roughness and an own F0 for each channel, as metals need."""
NEUTRAL = wp.constant(1)
"""Fit mode with free roughness and one F0 up to a bound, for dielectrics, whose highlights have the colour of the light."""
GIVEN = wp.constant(2)
"""Fit mode in which F0 and roughness are given and the albedo alone is fitted."""
GIVEN_F0 = wp.constant(3)
"""Fit mode with free roughness and an F0 that is given."""
METALLIC = wp.constant(4)
"""Fit mode with free roughness, a base colour and how metallic the surface is: of base colour b and metalness m the albedo is (1 - m) b and
F0 (1 - m) F + m b, with the given F0 F of a dielectric."""
METALNESS_COUNT, METALNESS_HALVINGS = 9, 4
"""Number of values of metalness that are tried from 0 to 1, and of times that their step is halved about the best: to 0.008."""


@wp.func
def common_weight(dd: float, ds: wp.vec3, ss: wp.vec3, rd: wp.vec3, rs: wp.vec3, most: float) -> float:
    """Return the weight, from 0 to `most`, that three channels share beside an albedo of at least 0 in each.

    It explains what the diffuse lobe cannot in channels with albedo above 0, and everything in the others.

    Args: sums over the lights: dd, ds, ss of products of the diffuse lobe and the other, rd, rs of readings and either, by channel.
    """
    common = float(0.0)  # a literal could not change inside the loop
    for _ in range(COMMON_ROUNDS):
        top, bottom, whole = float(0.0), float(0.0), float(0.0)
        for c in range(3):
            shared = wp.where(rd[c] > common * ds[c], ds[c] / wp.max(dd, 1.0e-20), 0.0)
            top += rs[c] - shared * rd[c]
            bottom += ss[c] - shared * ds[c]
            whole += ss[c]
        common = wp.where(bottom > 1.0e-6 * whole, wp.clamp(top / wp.max(bottom, 1.0e-20), 0.0, most), 0.0)
    return common


@wp.func
def metallic_base(m: float, f: float, closest: float, dd: float, ds: float, ss: float, rd: float, rs: float):
    """Return the base colour of one channel at metalness m, 0…1, and what the squared misfit is beside that of f = 0 and no base.

    Args: f of the dielectric; closest is the albedo of the Lambertian lobe for a diffuse weight of one; sums as in `common_weight`.
    """
    diffuse, dielectric = (1.0 - m) / wp.max(closest, 1.0e-3), (1.0 - m) * f
    top = diffuse * rd + m * rs - dielectric * (diffuse * ds + m * ss)
    bottom = diffuse * diffuse * dd + 2.0 * diffuse * m * ds + m * m * ss
    base = wp.clamp(top / wp.max(bottom, 1.0e-20), 0.0, 1.0)
    return base, dielectric * (dielectric * ss - 2.0 * rs) + base * (base * bottom - 2.0 * top)


@wp.func
def metalness(f: float, closest: float, dd: float, ds: float, ss: float, rd: wp.vec3, rs: wp.vec3) -> float:
    """Return the metalness, 0…1, that three channels share beside a base colour of each."""
    best, least, middle = float(0.0), float(1.0e30), float(0.5)
    step = float(1.0 / (float(METALNESS_COUNT) - 1.0))
    for trial in range(METALNESS_COUNT + 2 * METALNESS_HALVINGS):
        late = trial - METALNESS_COUNT
        if late >= 0 and late % 2 == 0:
            step, middle = step * 0.5, best
        m = wp.where(late < 0, step * float(trial), wp.clamp(middle + wp.where(late % 2 == 0, step, -step), 0.0, 1.0))
        total = float(0.0)
        for c in range(3):
            _, misfit = metallic_base(m, f, closest, dd, ds, ss, rd[c], rs[c])
            total += misfit
        if total < least:
            best, least = m, total
    return best


@once
def material_kernel(lanes: int, reflectance: Reflectance, bare: bool) -> Any:
    """Return the kernel for one width of packs and one kind of light; `bare`: a surface without a specular lobe is a candidate too."""
    held, prepare, respond, lambertian = reflectance
    write_weights = plain_weights(lanes)
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    channels = channels_type(lanes)
    bare_trials = int(bare)
    searched = bare_trials + ROUGHNESS_COUNT + 2 * HALVINGS

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def fit_kernel(first: int,
                   samples: samples_struct,
                   table: wp.array3d(dtype=float),  # [cells, L, columns]
                   normal: wp.array2d(dtype=lane_type),  # [3, P]
                   criteria: Criteria,
                   freedom: int,
                   anew: int,  # 1: each roughness begins with the weights of readings without misfit
                   known: wp.vec4,  # F0 and roughness, where they are given; else the bound of a common F0, last
                   # outputs
                   scratch: scratch_struct,  # held + WEIGHT_ROWS values a light
                   fitted: wp.array2d(dtype=lane_type)):  # [8, P] albedo, F0, roughness, cost
        p = first + wp.tid()
        nx, ny, nz = vector_at(normal, p)
        prepare(samples, table, criteria.form, nx, ny, nz, p, scratch)
        write_weights(samples, criteria.noise, p, held, scratch)
        closest = lambertian(samples, criteria.form, nx, ny, nz, p)
        best_cost, best_rough = lane_type(1.0e30), lane_type()
        best_rho, best_f0 = channels(), channels()
        rho, f0 = channels(), channels()
        step = float(ROUGHNESS_STEP)
        trials = wp.where(freedom == GIVEN, 1, searched)
        for trial in range(trials):
            # no lobe at all where that is a candidate, the grid, then two trials a halving on either side of the best
            grid = trial - bare_trials
            late = grid - ROUGHNESS_COUNT
            if late >= 0 and late % 2 == 0:
                step = step * 0.5
            rough = lane_type()
            for k in range(lanes):
                side = wp.where(late % 2 == 0, step, -step)
                around = wp.clamp(best_rough[k] + side, wp.static(0.5 * ROUGHNESS_FIRST), 1.0)
                tried = wp.where(late < 0, wp.where(grid < 0, 0.0, ROUGHNESS_FIRST + ROUGHNESS_STEP * float(grid)), around)
                rough[k] = wp.where(freedom == GIVEN, known[3], tried)
            for c in range(3):
                for k in range(lanes):
                    rho[c, k] = wp.where(late == 0, best_rho[c, k], rho[c, k])
                    f0[c, k] = wp.where(late == 0, best_f0[c, k], f0[c, k])
            respond(samples, table, nx, ny, nz, rough, p, scratch)
            cost, product = lane_type(), lane_type()
            cold = wp.where(trial * (1 - anew) * wp.static(int(not bare)) == 0, 1, 0)
            rounds = wp.where(cold == 1, wp.static(REWEIGHTINGS), wp.static(WARM_REWEIGHTINGS))
            for turn in range(rounds + 1):
                heeded = wp.where(cold * wp.where(turn == 0, 1, 0) == 1, 0.0, 1.0)  # at first nothing is known of the misfit
                dd, ds, ss = lane_type(), lane_type(), lane_type()
                rd, rs = channels(), channels()
                cost, product = lane_type(), lane_type(1.0)
                for light in range(samples.light_count):
                    element = p * samples.pack_stride + light * samples.light_stride
                    at = p * scratch.pack_stride + light * scratch.light_stride
                    fd = scratch.values[at]
                    fs = scratch.values[at + scratch.step]
                    fixed = scratch.values[at + 2 * scratch.step]
                    plain = scratch.values[at + held * scratch.step]
                    off2, shining, expected, wd, ws = lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
                    for c in range(3):
                        y = samples.colour[c, element]
                        inverse = scratch.values[at + (held + 1 + c) * scratch.step]
                        for k in range(lanes):
                            predicted = rho[c, k] * fd[k] + f0[c, k] * fs[k] + fixed[k]
                            off = (y[k] - predicted) * inverse[k]
                            off2[k] += off * off
                            shining[k] += y[k]
                            expected[k] += predicted
                    for k in range(lanes):
                        w, factor = weigh(shining[k], expected[k], heeded * off2[k], plain[k], criteria.shadow)
                        product[k] = product[k] * factor
                        wd[k] = w * fd[k]
                        ws[k] = w * fs[k]
                        dd[k] += wd[k] * fd[k]
                        ds[k] += wd[k] * fs[k]
                        ss[k] += ws[k] * fs[k]
                    for c in range(3):
                        y = samples.colour[c, element]
                        for k in range(lanes):
                            left = y[k] - fixed[k]
                            rd[c, k] += wd[k] * left
                            rs[c, k] += ws[k] * left
                    if turn == rounds and light % LOG_GROUP == LOG_GROUP - 1:
                        for k in range(lanes):
                            cost[k] += log_of(product[k])
                            product[k] = 1.0
                if turn < rounds and freedom == TINTED:
                    for c in range(3):
                        for k in range(lanes):
                            # two non-negative unknowns: the free solution, or the better one alone
                            bottom = dd[k] * ss[k] - ds[k] * ds[k]
                            safe = bottom > 1.0e-6 * dd[k] * ss[k]
                            a = (ss[k] * rd[c, k] - ds[k] * rs[c, k]) / wp.where(safe, bottom, 1.0)
                            b = (dd[k] * rs[c, k] - ds[k] * rd[c, k]) / wp.where(safe, bottom, 1.0)
                            only_a = wp.max(rd[c, k], 0.0) / wp.max(dd[k], 1.0e-20)
                            only_b = wp.clamp(wp.max(rs[c, k], 0.0) / wp.max(ss[k], 1.0e-20), 0.0, 1.0)
                            gain_a = only_a * (2.0 * rd[c, k] - only_a * dd[k])
                            gain_b = only_b * (2.0 * rs[c, k] - only_b * ss[k])
                            both = wp.where(safe, 1, 0) * wp.where(a >= 0.0, 1, 0) * wp.where(b >= 0.0, 1, 0)
                            full = wp.where(b > 1.0, 1, 0)  # F0 at its bound: the albedo takes what is left
                            rest = wp.max(rd[c, k] - ds[k], 0.0) / wp.max(dd[k], 1.0e-20)
                            alone_a = wp.where(gain_a >= gain_b, only_a, 0.0)
                            alone_b = wp.where(gain_a >= gain_b, 0.0, only_b)
                            rho[c, k] = wp.where(both == 1, wp.where(full == 1, rest, a), alone_a)
                            f0[c, k] = wp.where(both == 1, wp.min(b, 1.0), alone_b)
                if turn < rounds and freedom == METALLIC:
                    for k in range(lanes):
                        m = metalness(known[0], closest[k], dd[k], ds[k], ss[k], wp.vec3(rd[0, k], rd[1, k], rd[2, k]),
                                      wp.vec3(rs[0, k], rs[1, k], rs[2, k]))
                        for c in range(3):
                            base, _ = metallic_base(m, known[0], closest[k], dd[k], ds[k], ss[k], rd[c, k], rs[c, k])
                            rho[c, k] = (1.0 - m) * base / wp.max(closest[k], 1.0e-3)
                            f0[c, k] = (1.0 - m) * known[0] + m * base
                if turn < rounds and freedom != TINTED and freedom != METALLIC:
                    for k in range(lanes):
                        common = float(0.0)
                        if freedom == NEUTRAL:
                            common = common_weight(dd[k], wp.vec3(ds[k]), wp.vec3(ss[k]), wp.vec3(rd[0, k], rd[1, k], rd[2, k]),
                                                   wp.vec3(rs[0, k], rs[1, k], rs[2, k]), known[3])
                        for c in range(3):
                            shine = wp.where(freedom == NEUTRAL, common, known[c])
                            f0[c, k] = shine
                            rho[c, k] = wp.max(rd[c, k] - shine * ds[k], 0.0) / wp.max(dd[k], 1.0e-20)
            for k in range(lanes):
                cost[k] += log_of(product[k])
            for k in range(lanes):
                better = cost[k] < best_cost[k]
                best_cost[k] = wp.where(better, cost[k], best_cost[k])
                best_rough[k] = wp.where(better, rough[k], best_rough[k])
                for c in range(3):
                    best_rho[c, k] = wp.where(better, rho[c, k], best_rho[c, k])
                    best_f0[c, k] = wp.where(better, f0[c, k], best_f0[c, k])
        for c in range(3):
            out = lane_type()
            for k in range(lanes):
                out[k] = best_rho[c, k] * closest[k]
            fitted[c, p] = out
            for k in range(lanes):
                out[k] = best_f0[c, k]
            fitted[3 + c, p] = out
        fitted[6, p] = best_rough
        fitted[7, p] = best_cost

    return fit_kernel
