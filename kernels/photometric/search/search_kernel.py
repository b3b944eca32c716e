"""The kernel of the hypothesis search: each candidate normal of a pack of pixels, all lights for each."""

from typing import Any, Literal

import warp as wp

from kernels.device import once
from kernels.elementary import log_of
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.candidates import candidate_packs, tangents
from kernels.photometric.model.lobes import Lobes
from kernels.photometric.model.robust_weights import LARGEST_SQUARE, LOG_GROUP, Criteria, weigh_grey
from kernels.photometric.model.samples import samples_type, scratch_type

REWEIGHTINGS, SURVEY_REWEIGHTINGS = 5, 2
"""Rounds of the robust fit of each candidate: with three, normals are 0.1° worse on real data; of the survey, which then descends."""
SWEEPS, SAMPLING_SWEEPS = 12, 30
"""Coordinate sweeps of each non-negative solve; under wide lights, whose lobes are much alike."""


@once
def search_type(lanes: int) -> Any:
    """Return the Warp struct of what a search finds."""
    lane_type = pack_type(lanes, wp.float32)

    @wp.struct
    class SearchArrays:
        normal: wp.array2d(dtype=lane_type)  # [3, P] in: start, out: best
        cost: wp.array(dtype=lane_type)  # [P]
        weights: wp.array2d(dtype=lane_type)  # [lobes, P]
        costs: wp.array2d(dtype=lane_type)  # [candidates, P]

    return SearchArrays


@once
def search_kernel(lanes: int, lobes: Lobes, reweightings: Literal[REWEIGHTINGS, SURVEY_REWEIGHTINGS],
                  sweeps: Literal[SWEEPS, SAMPLING_SWEEPS]) -> Any:
    """Return the kernel for one width of packs and one mixture.
    `reweightings`: rounds of the robust fit of each candidate. `sweeps`: coordinate sweeps of each non-negative solve."""
    lane_type, samples_struct, scratch_struct, search_struct = (pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes),
                                                                search_type(lanes))
    mixture, _, relaxation, prepare, fill = lobes
    candidates_at = candidate_packs(lanes)
    coefficients = wp.types.matrix(shape=(mixture, lanes), dtype=wp.float32)
    gram = wp.types.matrix(shape=(mixture * (mixture + 1) // 2, lanes), dtype=wp.float32)
    triples = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)
    square = wp.types.matrix(shape=(mixture * mixture, lanes), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def judge_kernel(first: int,
                     samples: samples_struct,
                     table: wp.array3d(dtype=float),  # [cells, L, lobes]
                     offsets: wp.array(dtype=wp.vec4),  # [candidates]
                     radius: float,  # sine of the only ring's angle, 0 where there are several
                     drawn: wp.array2d(dtype=lane_type),  # [3, P] normal of the prior
                     pull: wp.vec2,  # its strength, and 1 / rad² of its angle
                     criteria: Criteria,
                     # outputs
                     scratch: scratch_struct,  # what the lobes hold
                     found: search_struct):
        p = first + wp.tid()
        vx, vy, vz = vector_at(samples.view, p)
        noise = criteria.noise
        shadow = criteria.shadow
        light_count = samples.light_count
        start = p * samples.pack_stride
        base = p * scratch.pack_stride
        prepare(samples, p, scratch)
        cx, cy, cz = vector_at(found.normal, p)
        best, bx, by, bz = lane_type(1.0e30), lane_type(), lane_type(), lane_type()
        centre, ring, slope_x, slope_y = lane_type(), lane_type(), lane_type(), lane_type()
        ux, uy, uz = vector_at(drawn, p)
        x_found = coefficients()
        for candidate in range(offsets.shape[0]):
            o = offsets[candidate]
            nx, ny, nz = candidates_at(cx, cy, cz, o, vx, vy, vz)
            fill(samples, table, criteria.form, nx, ny, nz, p, scratch)
            # the robust non-negative mixture
            x_best = coefficients()
            total, product = lane_type(), lane_type(1.0)
            for turn in range(reweightings + 1):
                g = gram()
                r = coefficients()
                total, product = lane_type(), lane_type(1.0)
                for triple in range((light_count + 2) / 3):  # so that the sums are read and written for every third light
                    w = triples()
                    for j in range(3):
                        light = wp.min(3 * triple + j, light_count - 1)
                        inside = wp.where(3 * triple + j < light_count, 1.0, 0.0)
                        at = base + light * scratch.light_stride
                        reading = samples.grey[start + light * samples.light_stride]
                        predicted = lane_type()
                        for a in range(mixture):
                            f = scratch.values[at + a * scratch.step]
                            for k in range(lanes):
                                predicted[k] += f[k] * x_best[a, k]
                        for k in range(lanes):
                            sigma = 1.0 / (noise[0] + noise[1] * wp.max(reading[k], 0.0))
                            off = (reading[k] - predicted[k]) * sigma
                            off2 = wp.where(turn == 0, 0.0, wp.min(off * off, LARGEST_SQUARE))
                            given = inside * wp.where(reading[k] >= 0.0, 1.0, 0.0)
                            weight, factor = weigh_grey(reading[k], predicted[k], off2, given, sigma, shadow)
                            w[j, k] = weight
                            product[k] = product[k] * factor
                    if turn == reweightings and triple % wp.static(LOG_GROUP // 3) == wp.static(LOG_GROUP // 3 - 1):
                        for k in range(lanes):
                            total[k] += log_of(product[k])
                            product[k] = 1.0
                    if turn < reweightings:
                        second = wp.min(3 * triple + 1, light_count - 1)
                        third = wp.min(3 * triple + 2, light_count - 1)
                        at0 = base + 3 * triple * scratch.light_stride
                        at1 = base + second * scratch.light_stride
                        at2 = base + third * scratch.light_stride
                        y0 = samples.grey[start + 3 * triple * samples.light_stride]
                        y1 = samples.grey[start + second * samples.light_stride]
                        y2 = samples.grey[start + third * samples.light_stride]
                        for a in range(mixture):
                            f0 = scratch.values[at0 + a * scratch.step]
                            f1 = scratch.values[at1 + a * scratch.step]
                            f2 = scratch.values[at2 + a * scratch.step]
                            for k in range(lanes):
                                f0[k] = w[0, k] * f0[k]
                                f1[k] = w[1, k] * f1[k]
                                f2[k] = w[2, k] * f2[k]
                                r[a, k] += f0[k] * y0[k] + f1[k] * y1[k] + f2[k] * y2[k]
                            row = a * (a + 1) / 2
                            for b in range(a + 1):
                                h0 = scratch.values[at0 + b * scratch.step]
                                h1 = scratch.values[at1 + b * scratch.step]
                                h2 = scratch.values[at2 + b * scratch.step]
                                for k in range(lanes):
                                    g[row + b, k] += f0[k] * h0[k] + f1[k] * h1[k] + f2[k] * h2[k]
                if turn < reweightings:
                    pivots = coefficients()
                    whole = square()
                    for a in range(mixture):
                        row = a * (a + 1) / 2
                        for b in range(a + 1):
                            for k in range(lanes):
                                whole[a * mixture + b, k] = g[row + b, k]
                                whole[b * mixture + a, k] = g[row + b, k]
                        for k in range(lanes):
                            pivots[a, k] = relaxation / (whole[a * mixture + a, k] + 1.0e-8)
                    for _ in range(sweeps):
                        for a in range(mixture):
                            rest = lane_type()
                            for k in range(lanes):
                                rest[k] = r[a, k]
                            for b in range(mixture):
                                for k in range(lanes):
                                    rest[k] -= whole[a * mixture + b, k] * x_best[b, k]
                            for k in range(lanes):
                                x_best[a, k] = wp.max(x_best[a, k] + rest[k] * pivots[a, k], 0.0)
            for k in range(lanes):
                away = 2.0 - 2.0 * (nx[k] * ux[k] + ny[k] * uy[k] + nz[k] * uz[k])
                total[k] += log_of(product[k]) + pull[0] * log_of(1.0 + pull[1] * wp.max(away, 0.0))
            found.costs[candidate, p] = total
            for k in range(lanes):
                around = wp.where(candidate > 0, total[k], 0.0)
                ring[k] += around
                slope_x[k] += around * o[2]
                slope_y[k] += around * o[3]
                centre[k] = wp.where(candidate == 0, total[k], centre[k])
                better = total[k] < best[k]
                for a in range(mixture):
                    x_found[a, k] = wp.where(better, x_best[a, k], x_found[a, k])
                best[k] = wp.where(better, total[k], best[k])
                bx[k] = wp.where(better, nx[k], bx[k])
                by[k] = wp.where(better, ny[k], by[k])
                bz[k] = wp.where(better, nz[k], bz[k])
        share = lane_type()
        for k in range(lanes):
            members = wp.max(float(offsets.shape[0] - 1), 1.0)
            rise = ring[k] / members - centre[k]
            # Newton's step on the paraboloid through centre and ring, in radii; never beyond the ring
            move_x = -slope_x[k] / (members * wp.max(rise, 1.0e-12))
            move_y = -slope_y[k] / (members * wp.max(rise, 1.0e-12))
            far = wp.max(wp.sqrt(move_x * move_x + move_y * move_y), 1.0)
            n = wp.vec3(cx[k], cy[k], cz[k])
            tangent, other = tangents(n)
            moved = n + radius * (move_x * tangent + move_y * other) / far
            moved = moved * (1.0 / wp.sqrt(wp.dot(moved, moved)))
            if radius > 0.0 and rise > 0.0:
                bx[k] = moved[0]
                by[k] = moved[1]
                bz[k] = moved[2]
            share[k] = best[k] / float(light_count)
        found.normal[0, p] = bx
        found.normal[1, p] = by
        found.normal[2, p] = bz
        found.cost[p] = share
        for a in range(mixture):
            for k in range(lanes):
                share[k] = x_found[a, k]
            found.weights[a, p] = share

    return judge_kernel
