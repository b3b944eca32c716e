"""The kernel of the mixture fit: for each pixel of a pack and each pair of given materials the abundance of the first and the albedo, by
re-weighted least squares under their bounds, and the best pair."""

from typing import Any

import warp as wp

from kernels.device import once
from kernels.logarithm import log_of
from kernels.packs import channels_type, pack_type
from kernels.photometric.lobes import Reflectance
from kernels.photometric.material_kernel import REWEIGHTINGS, common_weight
from kernels.photometric.robust_weights import LOG_GROUP, WEIGHT_ROWS, Criteria, plain_weights, weigh
from kernels.photometric.samples import samples_type, scratch_type

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
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    channels = channels_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def mix_kernel(first: int,
                   samples: samples_struct,
                   table: wp.array3d(dtype=float),  # [cells, L, columns]
                   normal: wp.array2d(dtype=lane_type),  # [3, P]
                   criteria: Criteria,
                   pairs: wp.array2d(dtype=wp.vec4),  # [pairs, 2] F0 and roughness
                   # outputs
                   scratch: scratch_struct,  # held + WEIGHT_ROWS + MIXED_ROWS values a light
                   fitted: wp.array2d(dtype=lane_type)):  # [6, P] albedo, abundance of the first material, pair, cost
        p = first + wp.tid()
        nx = normal[0, p]
        ny = normal[1, p]
        nz = normal[2, p]
        prepare(samples, table, criteria.form, nx, ny, nz, p, scratch)
        write_weights(samples, criteria.noise, p, held, scratch)
        best_cost, best_share, best_pair = lane_type(1.0e30), lane_type(), lane_type()
        best_rho = channels()
        for pair in range(pairs.shape[0]):
            one, two = pairs[pair, 0], pairs[pair, 1]
            rough_one, rough_two = lane_type(one[3]), lane_type(two[3])
            respond(samples, table, nx, ny, nz, rough_two, p, scratch)
            for light in range(samples.light_count):
                at = p * scratch.pack_stride + light * scratch.light_stride
                fs_two = scratch.values[at + scratch.step]
                fixed_two = scratch.values[at + 2 * scratch.step]
                for c in range(3):
                    mixed = lane_type()
                    for k in range(lanes):
                        mixed[k] = two[c] * fs_two[k] + fixed_two[k]
                    scratch.values[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch.step] = mixed
            respond(samples, table, nx, ny, nz, rough_one, p, scratch)
            for light in range(samples.light_count):
                at = p * scratch.pack_stride + light * scratch.light_stride
                fs = scratch.values[at + scratch.step]
                fixed = scratch.values[at + 2 * scratch.step]
                for c in range(3):
                    mixed = scratch.values[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch.step]
                    for k in range(lanes):
                        mixed[k] = one[c] * fs[k] + fixed[k] - mixed[k]
                    scratch.values[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch.step] = mixed
            rho, share = channels(), lane_type()
            cost, product = lane_type(), lane_type()
            for turn in range(wp.static(REWEIGHTINGS + 1)):
                heeded = wp.where(turn == 0, 0.0, 1.0)  # at first nothing is known of the misfit
                dd = lane_type()
                cost, product = lane_type(), lane_type(1.0)
                ds, ss, rd, rs = channels(), channels(), channels(), channels()
                for light in range(samples.light_count):
                    element = p * samples.pack_stride + light * samples.light_stride
                    at = p * scratch.pack_stride + light * scratch.light_stride
                    fd = scratch.values[at]
                    plain = scratch.values[at + held * scratch.step]
                    off2, shining, expected, w = lane_type(), lane_type(), lane_type(), lane_type()
                    for c in range(3):
                        y = samples.colour[c, element]
                        inverse = scratch.values[at + (held + 1 + c) * scratch.step]
                        below = scratch.values[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch.step]
                        apart = scratch.values[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch.step]
                        for k in range(lanes):
                            predicted = rho[c, k] * fd[k] + below[k] + share[k] * apart[k]
                            off = (y[k] - predicted) * inverse[k]
                            off2[k] += off * off
                            shining[k] += y[k]
                            expected[k] += predicted
                    for k in range(lanes):
                        weight, factor = weigh(shining[k], expected[k], heeded * off2[k], plain[k], criteria.shadow)
                        w[k] = weight
                        product[k] = product[k] * factor
                        dd[k] += weight * fd[k] * fd[k]
                    if turn == wp.static(REWEIGHTINGS) and light % LOG_GROUP == LOG_GROUP - 1:
                        for k in range(lanes):
                            cost[k] += log_of(product[k])
                            product[k] = 1.0
                    for c in range(3):
                        y = samples.colour[c, element]
                        below = scratch.values[at + (wp.static(held + WEIGHT_ROWS) + c) * scratch.step]
                        apart = scratch.values[at + (wp.static(held + WEIGHT_ROWS + 3) + c) * scratch.step]
                        for k in range(lanes):
                            left = y[k] - below[k]
                            wa = w[k] * apart[k]
                            ds[c, k] += wa * fd[k]
                            ss[c, k] += wa * apart[k]
                            rd[c, k] += w[k] * fd[k] * left
                            rs[c, k] += wa * left
                if turn < wp.static(REWEIGHTINGS):
                    for k in range(lanes):
                        common = common_weight(dd[k], wp.vec3(ds[0, k], ds[1, k], ds[2, k]), wp.vec3(ss[0, k], ss[1, k], ss[2, k]),
                                               wp.vec3(rd[0, k], rd[1, k], rd[2, k]), wp.vec3(rs[0, k], rs[1, k], rs[2, k]), 1.0)
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
        closest = lambertian(samples, criteria.form, nx, ny, nz, p)
        for c in range(3):
            out = lane_type()
            for k in range(lanes):
                out[k] = best_rho[c, k] * closest[k]
            fitted[c, p] = out
        fitted[3, p] = best_share
        fitted[4, p] = best_pair
        fitted[5, p] = best_cost

    return mix_kernel
