"""Normals by hypothesis and test: each candidate normal is judged by how well a non-negative mixture of lobes explains the
readings.

For a candidate the readings are expected to be Σ x_k f_k(l), x ≥ 0, with f_0 a diffuse lobe and the others GGX lobes of fixed widths. The
mixture is fitted by re-weighted non-negative least squares with Cauchy weights relative to the noise σ = s0 + s1 · reading, and the
candidate's cost is Σ log(1 + r²/σ²) over the lights. A light that reads far below its prediction is in cast shadow, which has a fixed cost:
any candidate may be shadowed, but no reading may be brighter than the lobes of the candidate. Candidates are rings about the best normal so
far, coarse to fine. Where the readings decide little, a prior may draw candidates to the normal of a simpler method.

Source: hypothesised normals after Hui and Sankaranarayanan, "Shape and spatially-varying reflectance estimation from virtual
exemplars", TPAMI 2017; here with analytic lobes in place of measured materials, and robust.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.logarithm import log_of
from kernels.packs import pack_type
from kernels.photometric.lobes import Lobes, direction_lobes
from kernels.photometric.samples import Samples, per_pixel, scratch_memory, to_host
from kernels.photometric.tabulated_lobes import tabulated_lobes

SHADOW_TRUST = 0.1
"""Weight in the fit of a reading that is zero or far below its prediction: such a reading bounds the radiance and hardly measures it."""
LOG_GROUP, LARGEST_SQUARE = 6, 1e6
"""Lights whose 1 + r²/σ² are multiplied before one logarithm is taken, and the largest r²/σ²: their product stays in range."""
LEAST_NZ = 0.02
"""Least cosine between a candidate and the viewer: a visible surface faces the viewer."""


@dataclass(frozen=True, kw_only=True)
class Diffuse:
    """Shape of the diffuse lobe, shared by the pixels of a material."""

    rough: float = -1.0
    """Roughness of Burley's lobe, 0…1; a value below 0 selects Lambert's lobe."""
    slope: float = 0.0
    """Slope s of a further factor 1 + s · (1 - n·l)."""


@dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """How candidates are judged."""

    noise_floor: float = 0.1
    """Noise s0 of every reading, relative to the pixel's level: it covers the part of a good pixel that the lobes cannot explain."""
    noise_slope: float = 0.02
    """Relative noise s1 of bright readings."""
    shadow_cost: float = 1.0
    """Cost of a reading that counts as cast shadow; 1.0 is the cost of a residual of 1.3 σ."""
    shadow_depth: float = 0.3
    """Fraction of its prediction below which a reading may be a cast shadow."""


@dataclass(frozen=True, kw_only=True)
class RingOptions(SearchOptions):
    """How candidates on rings are judged, and how far the mixture of each is fitted."""

    reweightings: int = 5
    """Rounds of the robust fit; with three, normals are 0.1° worse on real data."""
    sweeps: int = 12
    """Coordinate sweeps of each non-negative solve."""

    @classmethod
    def of(cls, options: SearchOptions, *, reweightings: int = 5) -> "RingOptions":
        """Return options that judge alike, with a number of rounds of the robust fit."""
        return cls(noise_floor=options.noise_floor, noise_slope=options.noise_slope, shadow_cost=options.shadow_cost,
                   shadow_depth=options.shadow_depth, reweightings=reweightings)


def criteria(options: SearchOptions, shape: Diffuse) -> list[Any]:
    """Return what the kernels judge by, as they take it: s0 and s1; r²/σ² of the cost of a shadow, and its depth; the diffuse lobe."""
    return [wp.vec2(options.noise_floor, options.noise_slope), wp.vec2(math.expm1(options.shadow_cost), options.shadow_depth),
            wp.vec2(shape.rough, shape.slope)]


PRIOR_DEGREES = 10.0
"""Angle from the normal of a prior at which its cost begins to grow as a logarithm: far candidates that explain the readings stay
possible."""


class Prior(NamedTuple):
    """What is expected of the normals before the readings are judged."""

    normal: np.ndarray  # [n, 3] float32, unit
    strength: float
    """A candidate at angle a from the normal costs strength · log(1 + (a / PRIOR_DEGREES)²) more, on the sum over the lights."""


def prior_pull(prior: Prior | None) -> Any:
    """Return the strength of a prior and 1 / rad² of its angle, as the kernels take them; the strength is 0 where there is none."""
    return wp.vec2(0.0 if prior is None else prior.strength, 1.0 / math.radians(PRIOR_DEGREES) ** 2)


class Search(NamedTuple):
    """Best candidate of each sampled pixel."""

    normal: np.ndarray  # [n, 3] float32, unit
    cost: np.ndarray  # [n] float32, per light
    weights: np.ndarray  # [n, lobes] float32, of the mixture, for readings relative to the pixel's level
    survey: wp.array  # [candidates, packs] float packs, on the device: cost of each candidate of the first rings, summed over the lights


def rings(degrees: tuple[float, ...], last_count: int) -> np.ndarray:
    """Return the offsets of candidates from a centre: the centre, then rings.

    Returns:
        [candidates, 4] float32: sine and cosine of the angle from the centre, cosine and sine of the azimuth.
    """
    offsets = [(0.0, 1.0, 1.0, 0.0)]
    for index, angle in enumerate(degrees):
        count = max(6, int(last_count * min(1.0, 1.2 * angle / degrees[-1])))
        for step in range(count):
            azimuth = 2 * math.pi * step / count + 0.5 * index  # rings do not line up
            offsets.append((math.sin(math.radians(angle)), math.cos(math.radians(angle)), math.cos(azimuth), math.sin(azimuth)))
    return np.array(offsets, dtype=np.float32)


def search_normals(samples: Samples, start: np.ndarray, *, shape: Diffuse,
                   wide: tuple[tuple[float, ...], int],
                   fine: tuple[tuple[tuple[float, ...], int], ...] = (), options: RingOptions | None = None,
                   table: wp.array | None = None, prior: Prior | None = None) -> Search:
    """Find the candidate normal of least cost for each sampled pixel.

    Args:
        samples: their readings.
        start: [n, 3] unit normals to begin from.
        shape: of the diffuse lobe.
        wide: radii of the first rings, about the start, in degrees, and the number of candidates on the last of them.
        fine: the same of the rings that follow, each about the best candidate so far.
        options: how candidates are judged.
        table: [cells, lights, lobes] of response_table.search_table or a reference_table, in place of the samples' directions;
            its diffuse lobe is what it is, whatever the shape.
        prior: normals that candidates are drawn to, of which the costs include the cost; None: none.

    Returns:
        The best candidates. Waits for the device.

    Raises:
        ArrayError: shapes that do not fit.
    """
    options = options or RingOptions()
    if start.shape != (samples.pixel_count, 3):
        raise ArrayError(f"start is {start.shape}: give one normal for each of the {samples.pixel_count} pixels")
    if table is not None and table.shape[1] != samples.light_count:
        raise ArrayError(f"table has {table.shape[1]} lights, the samples {samples.light_count}: tabulate those of the samples")
    device, lanes, packs, lights = samples.device, samples.lanes, samples.packs, samples.light_count
    lane_type = pack_type(lanes, wp.float32)
    normal = per_pixel(samples, start)
    cost = wp.empty(packs, dtype=lane_type, device=device)
    drawn = per_pixel(samples, start if prior is None else prior.normal)
    lobes = direction_lobes(lanes) if table is None else tabulated_lobes(lanes, table.shape[2])
    weights = wp.empty((lobes.count, packs), dtype=lane_type, device=device)
    table = wp.empty((0, 0, 0), dtype=wp.float32, device=device) if table is None else table
    scratch, strides = scratch_memory(samples, lobes.held)
    survey = None
    for degrees, count in (wide, *fine):
        offsets = wp.array(rings(degrees, count), dtype=wp.vec4, device=device)
        costs = wp.empty((offsets.shape[0], packs), dtype=lane_type, device=device)
        survey = costs if survey is None else survey
        radius = math.sin(math.radians(degrees[0])) if len(degrees) == 1 else 0.0
        devices.launch(_search_kernel(lanes, lobes, options.reweightings, options.sweeps), packs,
                       [samples.grey, samples.toward, table, samples.view, offsets, radius, drawn, prior_pull(prior),
                        *criteria(options, shape), lights, samples.pack_stride, samples.light_stride, *strides],
                       [scratch, normal, cost, weights, costs], device=device, uneven=True)
    return Search(to_host(samples, normal), to_host(samples, cost), to_host(samples, weights), survey)


@wp.func
def tangents(n: wp.vec3):
    """Return two unit vectors that are perpendicular to a unit normal and to each other."""
    up = wp.where(wp.abs(n[2]) < 0.9, wp.vec3(0.0, 0.0, 1.0), wp.vec3(1.0, 0.0, 0.0))
    tangent = wp.normalize(wp.cross(up, n))
    return tangent, wp.cross(n, tangent)


@wp.func
def candidate_at(n: wp.vec3, offset: wp.vec4, v: wp.vec3):
    """Return the unit normal at an offset of `rings` from n, moved along the view v where it would look away from the viewer."""
    tangent, other = tangents(n)
    moved = offset[1] * n + offset[0] * (offset[2] * tangent + offset[3] * other)
    moved += wp.max(LEAST_NZ - wp.dot(moved, v), 0.0) * v
    return moved * (1.0 / wp.sqrt(wp.dot(moved, moved)))


@once
def _search_kernel(lanes: int, lobes: Lobes, reweightings: int, sweeps: int) -> Any:
    lane_type = pack_type(lanes, wp.float32)
    mixture, held, relaxation, prepare, fill = lobes
    coefficients = wp.types.matrix(shape=(mixture, lanes), dtype=wp.float32)
    gram = wp.types.matrix(shape=(mixture * (mixture + 1) // 2, lanes), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def search_kernel(first: int,
                      grey: wp.array(dtype=lane_type),  # [P · L] readings / level
                      toward: wp.array2d(dtype=lane_type),  # [3, P · L]
                      table: wp.array3d(dtype=float),  # [cells, L, lobes]
                      view: wp.array2d(dtype=lane_type),  # [3, P]
                      offsets: wp.array(dtype=wp.vec4),  # [candidates]
                      radius: float,  # sine of the only ring's angle, 0 where there are several
                      drawn: wp.array2d(dtype=lane_type),  # [3, P] normal of the prior
                      pull: wp.vec2,  # its strength, and 1 / rad² of its angle
                      noise: wp.vec2,  # s0, s1
                      shadow: wp.vec2,  # r²/σ² of equal cost, depth
                      form: wp.vec2,  # diffuse roughness, slope
                      light_count: int,
                      pack_stride: int,
                      light_stride: int,
                      scratch_pack: int,
                      scratch_step: int,
                      # outputs
                      scratch: wp.array(dtype=lane_type),  # [P · L · held]
                      normal: wp.array2d(dtype=lane_type),  # [3, P] in: start, out: best
                      cost: wp.array(dtype=lane_type),  # [P]
                      weights: wp.array2d(dtype=lane_type),  # [lobes, P]
                      costs: wp.array2d(dtype=lane_type)):  # [candidates, P]
        p = first + wp.tid()
        vx = view[0, p]
        vy = view[1, p]
        vz = view[2, p]
        start = p * pack_stride
        base = p * scratch_pack
        prepare(toward, vx, vy, vz, start, light_count, light_stride, base, scratch_step, scratch)
        cx = normal[0, p]
        cy = normal[1, p]
        cz = normal[2, p]
        best, bx, by, bz = lane_type(1.0e30), lane_type(), lane_type(), lane_type()
        centre, ring, slope_x, slope_y = lane_type(), lane_type(), lane_type(), lane_type()
        ux = drawn[0, p]
        uy = drawn[1, p]
        uz = drawn[2, p]
        found = coefficients()
        for candidate in range(offsets.shape[0]):
            o = offsets[candidate]
            nx, ny, nz = lane_type(), lane_type(), lane_type()
            for k in range(lanes):
                n = candidate_at(wp.vec3(cx[k], cy[k], cz[k]), o, wp.vec3(vx[k], vy[k], vz[k]))
                nx[k] = n[0]
                ny[k] = n[1]
                nz[k] = n[2]
            fill(toward, table, form, nx, ny, nz, vx, vy, vz, start, light_count, light_stride, base, scratch_step, scratch)
            # the robust non-negative mixture
            x_best = coefficients()
            total, product = lane_type(), lane_type(1.0)
            for turn in range(reweightings + 1):
                g = gram()
                r = coefficients()
                total, product = lane_type(), lane_type(1.0)
                for light in range(light_count):
                    at = base + light * held * scratch_step
                    reading = grey[start + light * light_stride]
                    predicted, w = lane_type(), lane_type()
                    for a in range(mixture):
                        f = scratch[at + a * scratch_step]
                        for k in range(lanes):
                            predicted[k] += f[k] * x_best[a, k]
                    for k in range(lanes):
                        sigma = 1.0 / (noise[0] + noise[1] * wp.max(reading[k], 0.0))
                        off = (reading[k] - predicted[k]) * sigma
                        off2 = wp.where(turn == 0, 0.0, wp.min(off * off, LARGEST_SQUARE))
                        dark = wp.where(reading[k] < shadow[1] * predicted[k], 1, 0) * wp.where(off2 > shadow[0], 1, 0)
                        given = wp.where(reading[k] >= 0.0, 1.0, 0.0)
                        trust = wp.where(reading[k] > 0.0, wp.where(dark == 1, SHADOW_TRUST, 1.0), SHADOW_TRUST)
                        w[k] = given * trust * sigma * sigma / (1.0 + off2)
                        product[k] = product[k] * (1.0 + given * wp.where(dark == 1, shadow[0], off2))
                    if turn == reweightings and light % LOG_GROUP == LOG_GROUP - 1:
                        for k in range(lanes):
                            total[k] += log_of(product[k])
                            product[k] = 1.0
                    if turn < reweightings:
                        for a in range(mixture):
                            f = scratch[at + a * scratch_step]
                            wf = lane_type()
                            for k in range(lanes):
                                wf[k] = w[k] * f[k]
                                r[a, k] += wf[k] * reading[k]
                            for b in range(a + 1):
                                h = scratch[at + b * scratch_step]
                                for k in range(lanes):
                                    g[a * (a + 1) / 2 + b, k] += wf[k] * h[k]
                if turn < reweightings:
                    pivots = coefficients()
                    for a in range(mixture):
                        for k in range(lanes):
                            pivots[a, k] = relaxation / (g[a * (a + 1) / 2 + a, k] + 1.0e-8)
                    for _ in range(sweeps):
                        for a in range(mixture):
                            rest = lane_type()
                            for k in range(lanes):
                                rest[k] = r[a, k]
                            for b in range(mixture):
                                high = wp.max(a, b)
                                row = high * (high + 1) / 2 + wp.min(a, b)
                                for k in range(lanes):
                                    rest[k] -= g[row, k] * x_best[b, k]
                            for k in range(lanes):
                                x_best[a, k] = wp.max(x_best[a, k] + rest[k] * pivots[a, k], 0.0)
            for k in range(lanes):
                away = 2.0 - 2.0 * (nx[k] * ux[k] + ny[k] * uy[k] + nz[k] * uz[k])
                total[k] += log_of(product[k]) + pull[0] * log_of(1.0 + pull[1] * wp.max(away, 0.0))
            costs[candidate, p] = total
            for k in range(lanes):
                around = wp.where(candidate > 0, total[k], 0.0)
                ring[k] += around
                slope_x[k] += around * o[2]
                slope_y[k] += around * o[3]
                centre[k] = wp.where(candidate == 0, total[k], centre[k])
                better = total[k] < best[k]
                for a in range(mixture):
                    found[a, k] = wp.where(better, x_best[a, k], found[a, k])
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
        normal[0, p] = bx
        normal[1, p] = by
        normal[2, p] = bz
        cost[p] = share
        for a in range(mixture):
            for k in range(lanes):
                share[k] = found[a, k]
            weights[a, p] = share

    return search_kernel
