"""Material of pixels with known normals: diffuse albedo, F0 and roughness of the contract's BRDF, by a search over roughness.

For each roughness the readings of a channel are linear in albedo ρ and F0: y = ρ f_d + F0 (1 - s) f_s + s f_s, with f_d the
diffuse lobe, f_s the GGX lobe without Fresnel and s Schlick's rise; both are fitted by re-weighted non-negative least squares,
three channels on their own. The roughness of least cost is taken from a grid and halved steps about its best.
"""

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.photometric.hypotheses import SHADOW_TRUST, Diffuse, SearchOptions
from kernels.photometric.lobes import Reflectance, direction_reflectance
from kernels.photometric.response_table import COLUMNS
from kernels.photometric.samples import Samples, per_pixel, to_host
from kernels.photometric.tabulated_lobes import tabulated_reflectance

ROUGHNESS_FIRST, ROUGHNESS_STEP, ROUGHNESS_COUNT = 0.1, 0.075, 13
"""Grid of roughness, 0.1 to 1; below 0.1 a lobe is narrower than lights of any rig are apart."""
HALVINGS = 3
"""Of the step about the best: to a resolution of 0.01."""
REWEIGHTINGS = 4
"""Rounds of the robust fit at each roughness."""


class Material(NamedTuple):
    """What was fitted for each sampled pixel."""

    diffuse_albedo: np.ndarray  # [n, 3] float32
    specular: np.ndarray  # [n, 3] float32, F0, 0…1
    roughness: np.ndarray  # [n] float32
    cost: np.ndarray  # [n] float32, per light, as of the search


def fit_material(samples: Samples, normal: np.ndarray, *, shape: Diffuse,
                 options: SearchOptions | None = None, table: wp.array | None = None) -> Material:
    """Fit the material of sampled pixels.

    Args:
        samples: their readings.
        normal: [n, 3] unit normals.
        shape: of the diffuse lobe.
        options: noise and shadows, as in the search.
        table: of response_table, for lights that are not of one direction each; its diffuse lobe is Lambert's whatever the shape.

    Returns:
        The materials. The albedo is that of the Lambertian lobe closest to the fitted diffuse lobe under the capture's lights, so
        that an asset renders as fitted. With a table a surface without any specular lobe is a candidate too, because lights
        behind the rim tell it from one of F0 = 0, whose Fresnel rise shines there; it has F0 = 0 and roughness 1.
        Waits for the device.

    Raises:
        ArrayError: a table of other lights.
    """
    options = options or SearchOptions()
    if table is not None and table.shape[1:] != (samples.light_count, COLUMNS):
        raise ArrayError(f"table is {table.shape}, the samples have {samples.light_count} lights: give their response table")
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    lane_type = pack_type(lanes, wp.float32)
    reflectance = direction_reflectance(lanes) if table is None else tabulated_reflectance(lanes)
    fitted = wp.empty((8, packs), dtype=lane_type, device=device)
    responses = wp.empty((0, 0, 0), dtype=wp.float32, device=device) if table is None else table
    devices.launch(_material_kernel(lanes, reflectance, table is not None), packs,
                   [samples.colour, samples.toward, responses, samples.level, samples.view, per_pixel(samples, normal),
                    wp.vec2(options.noise_floor, options.noise_slope),
                    wp.vec2(math.expm1(options.shadow_cost), options.shadow_depth),
                    wp.vec2(shape.rough, shape.slope), samples.light_count, samples.pack_stride, samples.light_stride],
                   [fitted], device=device)
    values = to_host(samples, fitted)
    return Material(values[:, :3], values[:, 3:6], np.where(values[:, 6] > 0, values[:, 6], 1).astype(np.float32),
                    values[:, 7] / samples.light_count)


@cache
def _material_kernel(lanes: int, reflectance: Reflectance, bare: bool) -> Any:
    respond, lambertian = reflectance
    lane_type = pack_type(lanes, wp.float32)
    channels = wp.types.matrix(shape=(3, lanes), dtype=wp.float32)
    bare_trials = int(bare)
    trials = bare_trials + ROUGHNESS_COUNT + 2 * HALVINGS

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def material_kernel(first: int,
                        colour: wp.array2d(dtype=lane_type),  # [3, P · L] radiance / irradiance
                        toward: wp.array2d(dtype=lane_type),  # [3, P · L]
                        table: wp.array3d(dtype=float),  # [cells, L, columns]
                        level: wp.array(dtype=lane_type),  # [P]
                        view: wp.array2d(dtype=lane_type),  # [3, P]
                        normal: wp.array2d(dtype=lane_type),  # [3, P]
                        noise: wp.vec2,  # s0, s1
                        shadow: wp.vec2,  # r²/σ² of equal cost, depth
                        form: wp.vec2,  # diffuse roughness, slope
                        light_count: int,
                        pack_stride: int,
                        light_stride: int,
                        # outputs
                        fitted: wp.array2d(dtype=lane_type)):  # [8, P] albedo, F0, roughness, cost
        p = first + wp.tid()
        vx, vy, vz = view[0, p], view[1, p], view[2, p]
        nx, ny, nz = normal[0, p], normal[1, p], normal[2, p]
        bright = level[p]
        best_cost, best_rough = lane_type(), lane_type()
        best_rho, best_f0 = channels(), channels()
        for k in range(lanes):
            best_cost[k] = 1.0e30
        step = float(ROUGHNESS_STEP)
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
                rough[k] = wp.where(late < 0, wp.where(grid < 0, 0.0, ROUGHNESS_FIRST + ROUGHNESS_STEP * float(grid)), around)
            rho, f0 = channels(), channels()
            cost = lane_type()
            for turn in range(wp.static(REWEIGHTINGS + 1)):
                dd, ds, ss, rd, rs = channels(), channels(), channels(), channels(), channels()
                cost = lane_type()
                for light in range(light_count):
                    at = p * pack_stride + light * light_stride
                    fd, fs, fixed = respond(toward, table, form, nx, ny, nz, vx, vy, vz, rough, at, light)
                    # one weight a light for all channels: a shadow is one in each of them
                    off2, shining, expected, w = lane_type(), lane_type(), lane_type(), lane_type()
                    for c in range(3):
                        y = colour[c, at]
                        for k in range(lanes):
                            predicted = rho[c, k] * fd[k] + f0[c, k] * fs[k] + fixed[k]
                            sigma = wp.max(noise[0] * bright[k] + noise[1] * wp.max(y[k], 0.0), 1.0e-20)
                            off = (y[k] - predicted) / sigma
                            off2[k] += wp.where(turn == 0, 0.0, off * off / 3.0)
                            shining[k] += y[k]
                            expected[k] += predicted
                    for k in range(lanes):
                        dark = wp.where(shining[k] < shadow[1] * expected[k], 1, 0) * wp.where(off2[k] > shadow[0], 1, 0)
                        given = wp.where(shining[k] >= 0.0, 1.0, 0.0)
                        cost[k] += given * wp.log(1.0 + wp.where(dark == 1, shadow[0], off2[k]))
                        sigma = wp.max(noise[0] * bright[k] + noise[1] * wp.max(shining[k], 0.0) / 3.0, 1.0e-20)
                        relative = bright[k] / sigma
                        trust = wp.where(shining[k] > 0.0, wp.where(dark == 1, SHADOW_TRUST, 1.0), SHADOW_TRUST)
                        w[k] = given * trust * relative * relative / (1.0 + off2[k])
                    for c in range(3):
                        y = colour[c, at]
                        for k in range(lanes):
                            left = y[k] - fixed[k]
                            dd[c, k] += w[k] * fd[k] * fd[k]
                            ds[c, k] += w[k] * fd[k] * fs[k]
                            ss[c, k] += w[k] * fs[k] * fs[k]
                            rd[c, k] += w[k] * fd[k] * left
                            rs[c, k] += w[k] * fs[k] * left
                if turn < wp.static(REWEIGHTINGS):
                    for c in range(3):
                        for k in range(lanes):
                            # two non-negative unknowns: the free solution, or the better one alone
                            bottom = dd[c, k] * ss[c, k] - ds[c, k] * ds[c, k]
                            safe = bottom > 1.0e-6 * dd[c, k] * ss[c, k]
                            a = (ss[c, k] * rd[c, k] - ds[c, k] * rs[c, k]) / wp.where(safe, bottom, 1.0)
                            b = (dd[c, k] * rs[c, k] - ds[c, k] * rd[c, k]) / wp.where(safe, bottom, 1.0)
                            only_a = wp.max(rd[c, k], 0.0) / wp.max(dd[c, k], 1.0e-20)
                            only_b = wp.clamp(wp.max(rs[c, k], 0.0) / wp.max(ss[c, k], 1.0e-20), 0.0, 1.0)
                            gain_a = only_a * (2.0 * rd[c, k] - only_a * dd[c, k])
                            gain_b = only_b * (2.0 * rs[c, k] - only_b * ss[c, k])
                            both = wp.where(safe, 1, 0) * wp.where(a >= 0.0, 1, 0) * wp.where(b >= 0.0, 1, 0)
                            full = wp.where(b > 1.0, 1, 0)  # F0 at its bound: the albedo takes what is left
                            rest = wp.max(rd[c, k] - ds[c, k], 0.0) / wp.max(dd[c, k], 1.0e-20)
                            alone_a = wp.where(gain_a >= gain_b, only_a, 0.0)
                            alone_b = wp.where(gain_a >= gain_b, 0.0, only_b)
                            rho[c, k] = wp.where(both == 1, wp.where(full == 1, rest, a), alone_a)
                            f0[c, k] = wp.where(both == 1, wp.min(b, 1.0), alone_b)
            for k in range(lanes):
                better = cost[k] < best_cost[k]
                best_cost[k] = wp.where(better, cost[k], best_cost[k])
                best_rough[k] = wp.where(better, rough[k], best_rough[k])
                for c in range(3):
                    best_rho[c, k] = wp.where(better, rho[c, k], best_rho[c, k])
                    best_f0[c, k] = wp.where(better, f0[c, k], best_f0[c, k])
        closest = lambertian(toward, form, nx, ny, nz, vx, vy, vz, p * pack_stride, light_count, light_stride)
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

    return material_kernel
