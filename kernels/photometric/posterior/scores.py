"""Costs of chosen candidate normals: how well lobes of a table, mixed without negative or impossibly bright parts, explain the readings.

Where `hypotheses` keeps the best candidate, this keeps the cost of each, for a posterior over normals (`posterior`). The noise is
each pixel's own, and the weight of a lobe is bounded: without a bound, the faint tail of a mirrored source, made bright enough, explains
a single reading from anywhere.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type, vector_at
from kernels.photometric.model.candidates import candidate_packs
from kernels.photometric.model.lobes import Lobes
from kernels.photometric.model.samples import Samples, per_pixel, samples_type, scratch_memory, scratch_type, to_host
from kernels.photometric.model.tabulated_lobes import tabulated_lobes

REACH = 6.0
"""Residual in units of the noise at which the cost of a reading turns from square to logarithm: noise stays below, interreflection and what
the lobes cannot express do not."""
SHADOW_DEPTH, SHADOW_COST = 0.3, 400.0
"""Fraction of its prediction below which a reading may be a cast shadow, and r²/σ² that such a reading then costs: as much as a residual of
20 σ, because a mirror's dark readings say where it does not look, and would say nothing if shadows were cheap."""
BRIGHT = 0.3
"""Fraction of the brightest reading of a pixel above which a reading tells the relative noise, and below which the absolute one."""
REWEIGHTINGS = 4
"""Rounds of the robust fit."""
SHADOWED = 0.1
"""Weight in the fit of a reading far below its prediction: it bounds the radiance and hardly measures it."""
LEAST_GRAM = 1.0e-8
"""Least precision-weighted square of a lobe that is divided by: a fainter lobe meets no light, and its weight stays at its bound."""
SWEEPS = 40
"""Coordinate sweeps of each bounded solve."""


class Scores(NamedTuple):
    """Cost of each candidate of each sampled pixel, and what the candidate at the centre leaves unexplained."""

    cost: np.ndarray  # [candidates, n] float32: Σ r²/σ² over the readings, logarithmic beyond REACH
    lit: np.ndarray  # [n] float32: readings above three times their noise
    bright: np.ndarray  # [n, 2] float32: bright readings, and the sum of their squared relative residuals
    dim: np.ndarray  # [n, 2] float32: dim readings, and the sum of their squared residuals over the level


def score_normals(samples: Samples, centre: np.ndarray, offsets: np.ndarray, *, noise: np.ndarray, table: wp.array,
                  bound: np.ndarray) -> Scores:
    """Return the cost of candidates around the unit normal [n, 3] of each sampled pixel; waits for the device.

    Args:
        offsets: [candidates, 4] of `candidates.rings`; the first is the centre.
        noise: [n, 2] standard deviation of a reading: constant part and part of the reading, both relative to the pixel's level.
        table: [cells, lights, lobes] of response_table.search_table or of a reference ball.
        bound: [lobes] largest weight of each lobe, in the units of the readings.
    """
    count = samples.pixel_count
    if centre.shape != (count, 3) or noise.shape != (count, 2):
        raise ArrayError(f"centre is {centre.shape}, noise {noise.shape}: give one normal and two numbers for each of the {count} pixels")
    if table.shape[1] != samples.light_count or bound.shape != (table.shape[2],):
        raise ArrayError(f"table is {table.shape}, bound {bound.shape}, the samples have {samples.light_count} lights: "
                         "tabulate those of the samples, and give one bound for each lobe")
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    lane_type = pack_type(lanes, wp.float32)
    lobes = tabulated_lobes(lanes, table.shape[2])
    cost = wp.empty((len(offsets), packs), dtype=lane_type, device=device)
    misfit = wp.empty((5, packs), dtype=lane_type, device=device)
    devices.launch(_score_kernel(lanes, lobes), packs,
                   [samples.arrays, table, per_pixel(samples, centre), per_pixel(samples, noise),
                    wp.array(bound, dtype=wp.float32, device=device), wp.array(offsets, dtype=wp.vec4, device=device)],
                   [scratch_memory(samples, lobes.held), cost, misfit], device=device, uneven=True)
    rest = to_host(samples, misfit)
    return Scores(to_host(samples, cost).T, rest[:, 0], rest[:, 1:3], rest[:, 3:5])


@once
def _score_kernel(lanes: int, lobes: Lobes) -> Any:
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    mixture, _, relaxation, _, fill = lobes
    candidates_at = candidate_packs(lanes)
    coefficients = wp.types.matrix(shape=(mixture, lanes), dtype=wp.float32)
    gram = wp.types.matrix(shape=(mixture * (mixture + 1) // 2, lanes), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def score_kernel(first: int,
                     samples: samples_struct,
                     table: wp.array3d(dtype=float),  # [cells, L, lobes]
                     centre: wp.array2d(dtype=lane_type),  # [3, P]
                     noise: wp.array2d(dtype=lane_type),  # [2, P]
                     bound: wp.array(dtype=float),  # [lobes]
                     offsets: wp.array(dtype=wp.vec4),  # [candidates]
                     # outputs
                     scratch: scratch_struct,  # what the lobes hold
                     cost: wp.array2d(dtype=lane_type),  # [candidates, P]
                     misfit: wp.array2d(dtype=lane_type)):  # [5, P] lit; bright readings, squares; dim readings, squares
        p = first + wp.tid()
        vx, vy, vz = vector_at(samples.view, p)
        cx, cy, cz = vector_at(centre, p)
        floor = noise[0, p]
        slope = noise[1, p]
        unit = samples.level[p]
        brightest = lane_type()
        for light in range(samples.light_count):
            reading = samples.grey[p * samples.pack_stride + light * samples.light_stride]
            for k in range(lanes):
                brightest[k] = wp.max(brightest[k], reading[k])
        x = coefficients()
        for candidate in range(offsets.shape[0]):
            nx, ny, nz = candidates_at(cx, cy, cz, offsets[candidate], vx, vy, vz)
            fill(samples, table, wp.vec4(), nx, ny, nz, p, scratch)
            total, lit, bright, bright2, dim, dim2 = lane_type(), lane_type(), lane_type(), lane_type(), lane_type(), lane_type()
            for turn in range(REWEIGHTINGS + 1):
                g = gram()
                r = coefficients()
                for light in range(samples.light_count):
                    at = p * scratch.pack_stride + light * scratch.light_stride
                    reading = samples.grey[p * samples.pack_stride + light * samples.light_stride]
                    predicted, w = lane_type(), lane_type()
                    for a in range(mixture):
                        f = scratch.values[at + a * scratch.step]
                        for k in range(lanes):
                            predicted[k] += f[k] * x[a, k]
                    for k in range(lanes):
                        y = wp.max(reading[k], 0.0)
                        given = wp.where(reading[k] >= 0.0, 1.0, 0.0)
                        precision = given / (floor[k] * floor[k] + slope[k] * slope[k] * y * y)
                        off = y - predicted[k]
                        off2 = wp.where(turn == 0, 0.0, off * off * precision)
                        dark = y < SHADOW_DEPTH * predicted[k] and off2 > SHADOW_COST
                        w[k] = wp.where(dark, SHADOWED, 1.0) * precision / (1.0 + off2 * wp.static(1.0 / REACH**2))
                        if turn == REWEIGHTINGS:
                            off2 = wp.where(dark, SHADOW_COST, off2)
                            total[k] += wp.static(REACH**2) * wp.log(1.0 + off2 * wp.static(1.0 / REACH**2))
                            if candidate == 0:
                                off = wp.where(dark, 0.0, off) * given
                                shines = wp.where(y > BRIGHT * brightest[k], given, 0.0)
                                lit[k] += wp.where(y * y * precision > 9.0, 1.0, 0.0)
                                bright[k] += shines
                                bright2[k] += shines * off * off / wp.max(y * y, 1.0e-20)
                                dim[k] += given - shines
                                dim2[k] += (given - shines) * off * off
                    if turn < REWEIGHTINGS:
                        for a in range(mixture):
                            f = scratch.values[at + a * scratch.step]
                            wf = lane_type()
                            for k in range(lanes):
                                wf[k] = w[k] * f[k]
                                r[a, k] += wf[k] * wp.max(reading[k], 0.0)
                            for b in range(a + 1):
                                h = scratch.values[at + b * scratch.step]
                                for k in range(lanes):
                                    g[a * (a + 1) / 2 + b, k] += wf[k] * h[k]
                if turn < REWEIGHTINGS:
                    for _ in range(SWEEPS):
                        for a in range(mixture):
                            for k in range(lanes):
                                rest = r[a, k]
                                for b in range(mixture):
                                    high = wp.max(a, b)
                                    rest -= g[high * (high + 1) / 2 + wp.min(a, b), k] * x[b, k]
                                move = relaxation * rest / wp.max(g[a * (a + 1) / 2 + a, k], LEAST_GRAM)
                                x[a, k] = wp.clamp(x[a, k] + move, 0.0, bound[a] / unit[k])
            cost[candidate, p] = total
            if candidate == 0:
                misfit[0, p] = lit
                misfit[1, p] = bright
                misfit[2, p] = bright2
                misfit[3, p] = dim
                misfit[4, p] = dim2

    return score_kernel
