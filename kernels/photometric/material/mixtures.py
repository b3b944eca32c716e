"""Pixels in which two of the object's materials lie side by side: the share of each, by how much better both explain the readings than one.

On the border of two materials a reading is y = a y_1 + (1 - a) y_2, whether the pixel covers both or a texture blends them. One lobe
cannot stand for two that differ in F0 or roughness: between metal and paint it would need the F0 of a metal beside a diffuse albedo,
which a fit of one material rightly refuses. With the two materials given, a pixel has one unknown more than its albedo, the abundance a.

Source: materials as few and mixed per pixel after Goldman et al., "Shape and spatially-varying BRDFs from photometric stereo", TPAMI 2010,
section 4; the width of the single lobe that stands for a mixture, the mean of the slope variances, after Olano and Baker, "LEAN mapping",
I3D 2010.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import log_of
from kernels.packs import channels_type, pack_type, vector_at
from kernels.photometric.material.material import COST_FLOOR, Material
from kernels.photometric.material.material_kernel import REWEIGHTINGS, common_weight
from kernels.photometric.material.shared_materials import LEAST_GAIN
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.lobes import RESPONSES, Reflectance, direction_reflectance
from kernels.photometric.model.robust_weights import LOG_GROUP, WEIGHT_ROWS, Criteria, plain_weights, weigh
from kernels.photometric.model.samples import Samples, per_pixel, samples_type, scratch_memory, scratch_type, to_host
from kernels.photometric.search.hypotheses import LobeShape, criteria

MIXED_ROWS = 6
"""Values that scratch memory holds for each light beside the reflectance and the weights: in each channel, what the lobe of the second
material reads, and how much more that of the first reads."""


@once
def mixture_kernel(lanes: int, reflectance: Reflectance) -> Any:
    """Return the kernel for one width of packs and one kind of light."""
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
        nx, ny, nz = vector_at(normal, p)
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


MIXED_RISE = 1.25
"""Factor by which the cost of one material must exceed that of two: on real objects without mixed pixels hardly a pixel reaches it, on soft
borders of metal and paint it is mostly several times as much."""
LEAST_SHARE = 0.02
"""Least share of a material in a pixel that mixes two; with less the pixel has one material."""
MOST_PAIRS = 4
"""Largest number of pairs of materials that pixels mix."""
HELD = RESPONSES + WEIGHT_ROWS + MIXED_ROWS
"""Values that the scratch memory of the fit holds for each light and pixel, more than any other step of the general solver."""

NO_PAIRS = np.zeros((0, 2, 4), dtype=np.float32)
"""No pair of materials: every pixel has one material."""


class Mixture(NamedTuple):
    """Two materials in each of the sampled pixels."""

    abundance: np.ndarray  # [n] float32, share of the first material; 0 where the pixel has one
    pair: np.ndarray  # [n] uint8, which pair of materials


class _Mixed(NamedTuple):
    """The best pair of each pixel, whether or not it explains the pixel better than one material."""

    diffuse_albedo: np.ndarray  # [n, 3]
    abundance: np.ndarray  # [n]
    pair: np.ndarray  # [n]
    cost: np.ndarray  # [n] per light


def choose_pairs(samples: Samples, normal: np.ndarray, materials: np.ndarray, single: Material, *, shape: LobeShape) -> np.ndarray:
    """Choose the pairs of shared materials that pixels mix; waits for the device.

    Args:
        samples: some hundreds of pixels, spread over the object.
        materials: [materials, 4] F0 and roughness, of shared_materials.choose_materials.
        single: what one material a pixel makes of the same samples.

    Returns:
        [pairs, 2, 4] float32, the pair that explains most first; none where two materials explain no pixel clearly better than one.
    """
    pairs = np.array([(materials[i], materials[j]) for i in range(len(materials)) for j in range(i)], dtype=np.float32).reshape(-1, 2, 4)
    fits = [_fit(samples, normal, pair[None], shape) for pair in pairs]
    best, chosen = single.cost, []
    while fits and len(chosen) < MOST_PAIRS:
        saved = [np.where(_better(fit, single.cost), np.maximum(best - fit.cost, 0), 0) for fit in fits]
        index = int(np.argmax([gain.sum() for gain in saved]))
        if saved[index].sum() < LEAST_GAIN * single.cost.sum() or index in chosen:
            break
        chosen.append(index)
        best = best - saved[index]
    return pairs[chosen]


def mix_materials(samples: Samples, normal: np.ndarray, single: Material, pairs: np.ndarray, *,
                  shape: LobeShape) -> tuple[Material, Mixture]:
    """Replace the material of pixels that two materials, of [pairs, 2, 4], explain clearly better than one; waits for the device.

    Mixed pixels get the albedo of both together, and F0 and roughness of single_lobe.
    """
    mixture = Mixture(np.zeros(len(normal), np.float32), np.zeros(len(normal), np.uint8))
    tried = np.flatnonzero(single.cost > COST_FLOOR)  # what costs less needs no second material
    if not len(tried) or not len(pairs):
        return single, mixture
    fit = _fit(choose(samples, tried), normal[tried], pairs, shape)
    kept = _better(fit, single.cost[tried])
    mixed = tried[kept]
    material = Material(*(plane.copy() for plane in single))
    material.diffuse_albedo[mixed], material.cost[mixed] = fit.diffuse_albedo[kept], fit.cost[kept]
    mixture.abundance[mixed], mixture.pair[mixed] = fit.abundance[kept], fit.pair[kept]
    material.specular[mixed], material.roughness[mixed] = single_lobe(fit.abundance[kept], pairs[fit.pair[kept]])
    return material, mixture


def single_lobe(abundance: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return F0 [n, 3] and roughness [n] of the single lobe that comes closest to the lobes of two materials.

    F0 is the mean of both, so that as much light is reflected at normal incidence; α² is the mean of both weighted by what each reflects.

    Args:
        abundance: [n] share of the first material.
        pairs: [n, 2, 4] F0 and roughness of both materials.
    """
    shares = np.stack([abundance, 1 - abundance], axis=1)
    specular = np.einsum("np,npc->nc", shares, pairs[..., :3])
    reflected = shares * pairs[..., :3].mean(axis=-1)
    variance = np.einsum("np,np->n", reflected, pairs[..., 3] ** 4) / np.maximum(reflected.sum(axis=1), 1e-20)
    return specular.astype(np.float32), (variance**0.25).astype(np.float32)


def _better(fit: _Mixed, single_cost: np.ndarray) -> np.ndarray:
    """Return where two materials explain a pixel clearly better than one."""
    inside = (fit.abundance >= LEAST_SHARE) & (fit.abundance <= 1 - LEAST_SHARE)
    return inside & (MIXED_RISE * fit.cost + COST_FLOOR < single_cost)


def _fit(samples: Samples, normal: np.ndarray, pairs: np.ndarray, shape: LobeShape) -> _Mixed:
    device, lanes, packs = samples.device, samples.lanes, samples.packs
    fitted = wp.empty((6, packs), dtype=pack_type(lanes, wp.float32), device=device)
    scratch = scratch_memory(samples, HELD)
    devices.launch(mixture_kernel(lanes, direction_reflectance(lanes)), packs,
                   [samples.arrays, wp.empty((0, 0, 0), dtype=wp.float32, device=device), per_pixel(samples, normal),
                    criteria(None, shape), wp.array(pairs, dtype=wp.vec4, device=device)], [scratch, fitted], device=device)
    values = to_host(samples, fitted)
    return _Mixed(values[:, :3], values[:, 3], values[:, 4].astype(np.uint8), values[:, 5] / samples.light_count)
