"""Captured images summed for light that is near: every pixel sees a near light in a direction and strength of its own, and takes the
captured lights around that direction, as smooth weighting does.

The same sum is taken of a model of the surface under the captured lights, so that the model can say what the sum of images misses.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type
from kernels.relight.latlong import first_of_equals
from kernels.relight.shading import Surface, lobes, modelled, require_same, upload_captured
from kernels.relight.smooth import walk
from kernels.relight.sources import Sources
from kernels.relight.triangulation import edge_planes, triangulate_sphere

LEAST_PART = 1e-3
"""Least share of an imaginary light's energy that a captured light receives. A light so far from the hole that its share is smaller
receives nothing, and the other lights receive its share."""


def sum_near(band: Band, surface: Surface, visible: wp.array, sources: Sources, direction: np.ndarray, irradiance: np.ndarray,
             scale: np.ndarray) -> wp.array:
    """Sum images, and the model's images, for near and far samples of light.

    Args:
        band: captured images of the same pixels as the surface.
        surface: solved maps.
        visible: [lights, P] uint8 packs of occlusion.see_lights for the captured lights.
        sources: the wanted light, some tens of samples; what hides it is not looked at, the images show it.
        direction, irradiance: [lights, 3] of the captured lights, four or more not in one plane.
        scale: [lights padded] radiance of a stored 1.0.

    Returns:
        [6, pixels padded] float32 radiance on the device: of the images, and of the model.

    Raises:
        ArrayError: shapes that do not fit, a captured light without irradiance, fewer than four lights, or all in one plane.
    """
    count, device = len(direction), surface.device
    require_same(band, surface, visible, count)
    if not (irradiance > 0).all():
        light, channel = np.argwhere(~(irradiance > 0))[0]
        raise ArrayError(f"irradiance of light {light} is 0 in channel {'RGB'[channel]}: its image says nothing about light from there")
    kept = first_of_equals(direction)
    triangles = triangulate_sphere(direction[kept])
    vertex, owner = np.nonzero(triangles.share > LEAST_PART)
    start = np.searchsorted(vertex, np.arange(len(triangles.vertex) + 1))
    part = triangles.share[vertex, owner] / np.add.reduceat(triangles.share[vertex, owner], start[:-1])[vertex]
    inward, length = edge_planes(triangles)
    pack = devices.pack_width(device)
    places, factors = upload_captured(direction, irradiance, scale, device)
    weights = wp.zeros((3 * count, surface.packs * pack), dtype=wp.float32, device=device)
    out = wp.empty((6, surface.packs * pack), dtype=wp.float32, device=device)

    def upload(values: np.ndarray, dtype: Any) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    position = wp.array(surface.values.numpy()[12:15].reshape(3, -1), dtype=wp.float32, device=device)
    devices.launch(_weights_kernel, surface.packs * pack,
                   [position, upload(sources.place, wp.vec4), upload(sources.energy, wp.vec3), upload(sources.axis, wp.vec4),
                    upload(inward.reshape(-1, 3), wp.vec3), upload(length.reshape(-1), wp.float32),
                    upload(triangles.neighbour.reshape(-1), wp.int32), upload(triangles.corner.reshape(-1), wp.int32),
                    upload(start, wp.int32), upload(kept[owner], wp.int32), upload(part, wp.float32), count], [weights], device=device)
    devices.launch(_sum_kernel(pack), surface.packs,
                   [band.values, band.frame_count, surface.values, visible, places, factors, as_packs(weights, device)],
                   [as_packs(out, device)], device=device)
    return out


@wp.kernel(enable_backward=False, module="unique")
def _weights_kernel(first: int,
                    position: wp.array2d(dtype=float),  # [3, pixels padded]
                    place: wp.array(dtype=wp.vec4),  # [N]
                    energy: wp.array(dtype=wp.vec3),  # [N]
                    axis: wp.array(dtype=wp.vec4),  # [N]
                    inward: wp.array(dtype=wp.vec3),  # [3 · faces] unit normals of the planes of the edges opposite to the corners
                    length: wp.array(dtype=float),  # [3 · faces] what a corner's coordinate is weighted by
                    neighbour: wp.array(dtype=int),  # [3 · faces] face beyond that edge
                    corner: wp.array(dtype=int),  # [3 · faces] vertex at the corner
                    start: wp.array(dtype=int),  # [vertices + 1] where the lights of a vertex begin; a light's own is the only one
                    owner: wp.array(dtype=int),  # the lights that share the energy of each vertex
                    part: wp.array(dtype=float),  # share of the vertex's energy that each of these lights receives
                    count: int,  # lights
                    # outputs
                    weights: wp.array2d(dtype=float)):  # [3 · lights, pixels padded], 0
    pixel = first + wp.tid()
    point = wp.vec3(position[0, pixel], position[1, pixel], position[2, pixel])
    here = wp.int32(0)
    for n in range(place.shape[0]):
        source, lobe = place[n], axis[n]
        toward = wp.vec3(source[0], source[1], source[2]) - source[3] * point
        away2 = wp.max(wp.dot(toward, toward), 1.0e-20)
        toward = toward / wp.sqrt(away2)
        arriving = wp.where(source[3] > 0.0, 1.0 / away2, 1.0)
        if lobe[3] > 0.0:
            ahead = wp.max(-(toward[0] * lobe[0] + toward[1] * lobe[1] + toward[2] * lobe[2]), 0.0)
            arriving = arriving * wp.pow(ahead, lobe[3])
        here, angles = walk(toward, here, inward, neighbour)
        a = wp.max(angles[0], 0.0) * length[3 * here]
        b = wp.max(angles[1], 0.0) * length[3 * here + 1]
        c = wp.max(angles[2], 0.0) * length[3 * here + 2]
        given = energy[n] * (arriving / wp.max(a + b + c, 1.0e-20))
        for side in range(3):
            share = wp.where(side == 0, a, wp.where(side == 1, b, c))
            vertex = corner[3 * here + side]
            for i in range(start[vertex], start[vertex + 1]):
                light = owner[i]
                amount = given * (share * part[i])
                weights[light, pixel] = weights[light, pixel] + amount[0]
                weights[count + light, pixel] = weights[count + light, pixel] + amount[1]
                weights[2 * count + light, pixel] = weights[2 * count + light, pixel] + amount[2]


@cache
def _sum_kernel(pack: int) -> Any:
    lane_type, half_pack, byte_pack = (pack_type(pack, dtype) for dtype in (wp.float32, wp.float16, wp.uint8))
    evaluate = lobes(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def sum_kernel(first: int,
                   captured: wp.array2d(dtype=half_pack),  # [3 · lights padded, P]
                   padded: int,  # lights
                   values: wp.array2d(dtype=lane_type),  # [24, P]
                   visible: wp.array2d(dtype=byte_pack),  # [lights, P]
                   lights: wp.array(dtype=wp.vec4),  # [lights]
                   factors: wp.array(dtype=wp.vec3),  # [lights] stored → radiance / irradiance
                   weights: wp.array2d(dtype=lane_type),  # [3 · lights, P]
                   # outputs
                   out: wp.array2d(dtype=lane_type)):  # [6, P]
        p = first + wp.tid()
        count = lights.shape[0]
        albedo_r = values[3, p]
        albedo_g = values[4, p]
        albedo_b = values[5, p]
        image_r, image_g, image_b = lane_type(), lane_type(), lane_type()
        model_r, model_g, model_b = lane_type(), lane_type(), lane_type()
        for light in range(count):
            facing, gloss, _, _ = evaluate(values, p, lights[light], wp.vec4())
            lit = visible[light, p]
            factor = factors[light]
            red = captured[light, p]
            green = captured[padded + light, p]
            blue = captured[2 * padded + light, p]
            wr = weights[light, p]
            wg = weights[count + light, p]
            wb = weights[2 * count + light, p]
            for k in range(pack):
                seen = float(lit[k]) * wp.static(1.0 / 255.0)
                image_r[k] += wr[k] * factor[0] * float(red[k])
                image_g[k] += wg[k] * factor[1] * float(green[k])
                image_b[k] += wb[k] * factor[2] * float(blue[k])
                model_r[k] += wr[k] * modelled(seen, albedo_r[k], facing[k], gloss[0, k])
                model_g[k] += wg[k] * modelled(seen, albedo_g[k], facing[k], gloss[1, k])
                model_b[k] += wb[k] * modelled(seen, albedo_b[k], facing[k], gloss[2, k])
        out[0, p] = image_r
        out[1, p] = image_g
        out[2, p] = image_b
        out[3, p] = model_r
        out[4, p] = model_g
        out[5, p] = model_b

    return sum_kernel
