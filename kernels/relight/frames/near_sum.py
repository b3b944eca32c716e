"""Captured images summed for light that is near: every pixel sees a near light in a direction and strength of its own, and takes the
captured lights around that direction, as smooth weighting does.

The same sum is taken of a model of the surface under the captured lights, so that the model can say what the sum of images misses.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.relight.directions.latlong import first_of_equals
from kernels.relight.model.captured import Captured, images_type
from kernels.relight.model.shading import lobes, modelled
from kernels.relight.model.sources import Sources
from kernels.relight.weights.smooth import SphereTriangles, edge_planes, walk

LEAST_PART = 1e-3
"""Least share of an imaginary light's energy that a captured light receives. A light so far from the hole that its share is smaller
receives nothing, and the other lights receive its share."""


@wp.struct
class Net:
    """The triangles between the captured lights, and which lights receive the energy at their corners."""

    inward: wp.array(dtype=wp.vec3)  # [3 · faces] unit normals of the planes of the edges opposite to the corners
    length: wp.array(dtype=float)  # [3 · faces] what a corner's coordinate is weighted by
    neighbour: wp.array(dtype=int)  # [3 · faces] face beyond that edge
    corner: wp.array(dtype=int)  # [3 · faces] vertex at the corner
    start: wp.array(dtype=int)  # [vertices + 1] where the lights of a vertex begin; a light's own is the only one
    owner: wp.array(dtype=int)  # the lights that share the energy of each vertex
    part: wp.array(dtype=float)  # share of the vertex's energy that each of these lights receives


def sum_near(captured: Captured, sources: Sources, triangles: SphereTriangles) -> wp.array:
    """Sum images, and the model's images, for near and far samples of light: [6, pixels padded] float32 radiance on the device.

    Args:
        sources: the wanted light, some tens of samples; what hides it is not looked at, the images show it.
        triangles: of the captured lights, of several in one place the first.

    Raises:
        ArrayError: a captured light without irradiance.
    """
    surface, direction, irradiance = captured.surface, captured.direction, captured.irradiance
    count, device = len(direction), surface.device
    if not (irradiance > 0).all():
        light, channel = np.argwhere(~(irradiance > 0))[0]
        raise ArrayError(f"irradiance of light {light} is 0 in channel {'RGB'[channel]}: its image says nothing about light from there")
    pixels = surface.packs * devices.pack_width(device)
    weights = wp.zeros((3 * count, pixels), dtype=wp.float32, device=device)

    position = wp.array(to_numpy(surface.values)[12:15].reshape(3, -1), dtype=wp.float32, device=device)
    wanted = [wp.array(values, dtype=dtype, device=device) for values, dtype in (
        (sources.place, wp.vec4), (sources.energy, wp.vec3), (sources.axis, wp.vec4))]
    devices.launch(_weights_kernel, pixels, [position, *wanted, _net(triangles, direction, device), count], [weights], device=device)
    return captured.sums(_sum_kernel, 6, as_packs(weights, device))


def _net(triangles: SphereTriangles, direction: np.ndarray, device: str) -> Any:
    vertex, owner = np.nonzero(triangles.share > LEAST_PART)
    start = np.searchsorted(vertex, np.arange(len(triangles.vertex) + 1))
    inward, length = edge_planes(triangles)
    net = Net()
    net.inward = wp.array(inward.reshape(-1, 3), dtype=wp.vec3, device=device)
    net.length = wp.array(length.reshape(-1), dtype=wp.float32, device=device)
    net.neighbour = wp.array(triangles.neighbour.reshape(-1), dtype=wp.int32, device=device)
    net.corner = wp.array(triangles.corner.reshape(-1), dtype=wp.int32, device=device)
    net.start = wp.array(start, dtype=wp.int32, device=device)
    net.owner = wp.array(first_of_equals(direction)[owner], dtype=wp.int32, device=device)
    net.part = wp.array(triangles.share[vertex, owner] / np.add.reduceat(triangles.share[vertex, owner], start[:-1])[vertex],
                        dtype=wp.float32, device=device)
    return net


@wp.kernel(enable_backward=False, module="unique")
def _weights_kernel(first: int,
                    position: wp.array2d(dtype=float),  # [3, pixels padded]
                    place: wp.array(dtype=wp.vec4),  # [N]
                    energy: wp.array(dtype=wp.vec3),  # [N]
                    axis: wp.array(dtype=wp.vec4),  # [N]
                    net: Net,
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
        here, angles = walk(toward, here, net.inward, net.neighbour)
        a = wp.max(angles[0], 0.0) * net.length[3 * here]
        b = wp.max(angles[1], 0.0) * net.length[3 * here + 1]
        c = wp.max(angles[2], 0.0) * net.length[3 * here + 2]
        given = energy[n] * (arriving / wp.max(a + b + c, 1.0e-20))
        for side in range(3):
            share = wp.where(side == 0, a, wp.where(side == 1, b, c))
            vertex = net.corner[3 * here + side]
            for i in range(net.start[vertex], net.start[vertex + 1]):
                light = net.owner[i]
                amount = given * (share * net.part[i])
                weights[light, pixel] = weights[light, pixel] + amount[0]
                weights[count + light, pixel] = weights[count + light, pixel] + amount[1]
                weights[2 * count + light, pixel] = weights[2 * count + light, pixel] + amount[2]


@once
def _sum_kernel(pack: int) -> Any:
    lane_type, images_struct, evaluate = pack_type(pack, wp.float32), images_type(pack), lobes(pack)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def sum_kernel(first: int,
                   images: images_struct,
                   weights: wp.array2d(dtype=lane_type),  # [3 · lights, P]
                   # outputs
                   out: wp.array2d(dtype=lane_type)):  # [6, P]
        p = first + wp.tid()
        count = images.places.shape[0]
        albedo_r = images.surface[3, p]
        albedo_g = images.surface[4, p]
        albedo_b = images.surface[5, p]
        image_r, image_g, image_b = lane_type(), lane_type(), lane_type()
        model_r, model_g, model_b = lane_type(), lane_type(), lane_type()
        for light in range(count):
            facing, gloss, _, _ = evaluate(images.surface, p, images.places[light], wp.vec4())
            lit = images.visible[light, p]
            factor = images.factors[light]
            red = images.stored[light, p]
            green = images.stored[images.padded + light, p]
            blue = images.stored[2 * images.padded + light, p]
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
