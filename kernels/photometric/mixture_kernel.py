"""The kernel of the mixture fit: for each pixel of a pack and each pair of given materials the abundance of the first and the albedo, by
re-weighted least squares under their bounds, and the best pair."""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.logarithm import log_of
from kernels.packs import channels_type, pack_type
from kernels.photometric.lobes import Reflectance
from kernels.photometric.material_kernel import COMMON_ROUNDS, REWEIGHTINGS
from kernels.photometric.robust_weights import LOG_GROUP, WEIGHT_ROWS, plain_weights, weigh

MIXED_ROWS = 6
"""Values that scratch memory holds for each light beside the reflectance and the weights: in each channel, what the lobe of the second
material reads, and how much more that of the first reads."""


@once
def mixture_kernel(lanes: int, reflectance: Reflectance) -> Any:
    """Return the kernel for one width of packs and one kind of light.

    Args:
        lanes: pixels of a pack.
        reflectance: expected readings.
    """
    held, prepare, respond, lambertian = reflectance
    write_weights = plain_weights(lanes)
    lane_type = pack_type(lanes, wp.float32)
    channels = channels_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def mix_kernel(first: int,
                   colour: wp.array2d(dtype=lane_type),  # [3, P · L] radiance / irradiance
                   toward: wp.array2d(dtype=lane_type),  # [3, P · L]
                   table: wp.array3d(dtype=float),  # [cells, L, columns]
                   level: wp.array(dtype=lane_type),  # [P]
                   view: wp.array2d(dtype=lane_type),  # [3, P]
                   normal: wp.array2d(dtype=lane_type),  # [3, P]
                   noise: wp.vec2,  # s0, s1
                   shadow: wp.vec2,  # r²/σ² of equal cost, depth
                   form: wp.vec2,  # diffuse roughness, slope
                   pairs: wp.array2d(dtype=wp.vec4),  # [pairs, 2] F0 and roughness
                   light_count: int,
                   pack_stride: int,
                   light_stride: int,
                   scratch_pack: int,
                   scratch_step: int,
                   # outputs
                   scratch: wp.array(dtype=lane_type),  # [P · L · (held + WEIGHT_ROWS + MIXED_ROWS)]
                   fitted: wp.array2d(dtype=lane_type)):  # [6, P] albedo, abundance of the first material, pair, cost
        p = first + wp.tid()
        vx = view[0, p]
        vy = view[1, p]
        vz = view[2, p]
        nx = normal[0, p]
        ny = normal[1, p]
        nz = normal[2, p]
        bright = level[p]
        start = p * pack_stride
        base = p * scratch_pack
        light_step = wp.static(held + WEIGHT_ROWS + MIXED_ROWS) * scratch_step
        weight_rows = base + held * scratch_step
        prepare(toward, table, form, nx, ny, nz, vx, vy, vz, start, light_count, light_stride, base, light_step, scratch_step, scratch)
        write_weights(colour, bright, noise, start, light_count, light_stride, weight_rows, light_step, scratch_step, scratch)
        best_cost, best_share, best_pair = lane_type(1.0e30), lane_type(), lane_type()
        best_rho = channels()
        for pair in range(pairs.shape[0]):
            one, two = pairs[pair, 0], pairs[pair, 1]
            rough_one, rough_two = lane_type(one[3]), lane_type(two[3])
            respond(table, nx, ny, nz, vx, vy, vz, rough_two, light_count, base, light_step, scratch_step, scratch)
            for light in range(light_count):
                at = base + light * light_step
                fs_two = scratch[at + scratch_step]
                fixed_two = scratch[at + 2 * scratch_step]
                for c in range(3):
                    mixed = lane_type()
                    for k in range(lanes):
                        mixed[k] = two[c] * fs_two[k] + fixed_two[k]
                    scratch[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch_step] = mixed
            respond(table, nx, ny, nz, vx, vy, vz, rough_one, light_count, base, light_step, scratch_step, scratch)
            for light in range(light_count):
                at = base + light * light_step
                fs = scratch[at + scratch_step]
                fixed = scratch[at + 2 * scratch_step]
                for c in range(3):
                    mixed = scratch[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch_step]
                    for k in range(lanes):
                        mixed[k] = one[c] * fs[k] + fixed[k] - mixed[k]
                    scratch[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch_step] = mixed
            rho, share = channels(), lane_type()
            cost, product = lane_type(), lane_type()
            for turn in range(wp.static(REWEIGHTINGS + 1)):
                heeded = wp.where(turn == 0, 0.0, 1.0)  # at first nothing is known of the misfit
                dd = lane_type()
                cost, product = lane_type(), lane_type(1.0)
                ds, ss, rd, rs = channels(), channels(), channels(), channels()
                for light in range(light_count):
                    element = start + light * light_stride
                    at = base + light * light_step
                    fd = scratch[at]
                    plain = scratch[at + held * scratch_step]
                    off2, shining, expected, w = lane_type(), lane_type(), lane_type(), lane_type()
                    for c in range(3):
                        y = colour[c, element]
                        inverse = scratch[at + (held + 1 + c) * scratch_step]
                        below = scratch[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch_step]
                        apart = scratch[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch_step]
                        for k in range(lanes):
                            predicted = rho[c, k] * fd[k] + below[k] + share[k] * apart[k]
                            off = (y[k] - predicted) * inverse[k]
                            off2[k] += off * off
                            shining[k] += y[k]
                            expected[k] += predicted
                    for k in range(lanes):
                        weight, factor = weigh(shining[k], expected[k], heeded * off2[k], plain[k], shadow)
                        w[k] = weight
                        product[k] = product[k] * factor
                        dd[k] += weight * fd[k] * fd[k]
                    if turn == wp.static(REWEIGHTINGS) and light % LOG_GROUP == LOG_GROUP - 1:
                        for k in range(lanes):
                            cost[k] += log_of(product[k])
                            product[k] = 1.0
                    for c in range(3):
                        y = colour[c, element]
                        below = scratch[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch_step]
                        apart = scratch[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch_step]
                        for k in range(lanes):
                            left = y[k] - below[k]
                            wa = w[k] * apart[k]
                            ds[c, k] += wa * fd[k]
                            ss[c, k] += wa * apart[k]
                            rd[c, k] += w[k] * fd[k] * left
                            rs[c, k] += wa * left
                if turn < wp.static(REWEIGHTINGS):
                    for k in range(lanes):
                        common = float(0.0)
                        for _round in range(COMMON_ROUNDS):
                            # it explains what the diffuse lobe cannot in channels with albedo above 0, and everything in the others
                            top, bottom, whole = float(0.0), float(0.0), float(0.0)
                            for c in range(3):
                                shared = wp.where(rd[c, k] > common * ds[c, k], ds[c, k] / wp.max(dd[k], 1.0e-20), 0.0)
                                top += rs[c, k] - shared * rd[c, k]
                                bottom += ss[c, k] - shared * ds[c, k]
                                whole += ss[c, k]
                            common = wp.where(bottom > 1.0e-6 * whole, wp.clamp(top / wp.max(bottom, 1.0e-20), 0.0, 1.0), 0.0)
                        share[k] = common
                        for c in range(3):
                            rho[c, k] = wp.max(rd[c, k] - common * ds[c, k], 0.0) / wp.max(dd[k], 1.0e-20)
            for k in range(lanes):
                cost[k] += log_of(product[k])
            for k in range(lanes):
                better = cost[k] < best_cost[k]
                best_cost[k] = wp.where(better, cost[k], best_cost[k])
                best_share[k] = wp.where(better, share[k], best_share[k])
                best_pair[k] = wp.where(better, float(pair), best_pair[k])
                for c in range(3):
                    best_rho[c, k] = wp.where(better, rho[c, k], best_rho[c, k])
        closest = lambertian(toward, form, nx, ny, nz, vx, vy, vz, p * pack_stride, light_count, light_stride)
        for c in range(3):
            out = lane_type()
            for k in range(lanes):
                out[k] = best_rho[c, k] * closest[k]
            fitted[c, p] = out
        fitted[3, p] = best_share
        fitted[4, p] = best_pair
        fitted[5, p] = best_cost

    return mix_kernel
