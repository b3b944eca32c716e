"""Find the lights that each pixel sees over the solved height."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import pack_type
from kernels.relight.model.shading import Surface
from kernels.surface.shadows import NO_REACH, Extent, Projection, Relief, in_shadow_within, relief_of, surface_point

GRAZING = 0.1
"""The n·l up to which a pixel does not tell whether the surface hides a light: steps of the height hide it from pixels that it grazes."""


def see_lights(place: np.ndarray, pixels: np.ndarray, height: wp.array, mask: wp.array, projection: Projection, *,
               extent: Extent | None = None, thickness: wp.array | None = None, surface: Surface | None = None, device: str) -> wp.array:
    """Return which pixels see which lights, by marching from every pixel to every light.

    Args:
        place: [n, 4] unit direction and 0, or position and 1, as of sources.Sources.
        pixels: [m] row-major positions in the image.
        height: [rows, cols] float32, camera-frame z.
        mask: [rows, cols] uint8, where there is surface: the number of its part.
        projection: of the camera; the unit is that of height.
        extent: of the height and mask, from shadows.extent_of; None: it is found.
        thickness: [rows, cols] float32 from the front of each part to its back; None: light passes behind the front of another part.
        surface: the same pixels with their normals: where they hardly face a light or not at all, what the surface hides of it says
            nothing of other light, and it counts as seen. None: they are not looked at, and the surface of a pixel hides what is behind it.

    Returns:
        [n, P] uint8 packs: 255 where the light is seen, 0 where the surface hides it. The last pack is filled up with the last pixel.
    """
    if not len(pixels) or pixels.min() < 0 or pixels.max() >= mask.shape[0] * mask.shape[1]:
        raise ArrayError(f"pixels must be positions from 0 to {mask.shape[0] * mask.shape[1] - 1}, one or more")
    pack = devices.pack_width(device)
    packs = -(-len(pixels) // pack)
    where = pixels[np.minimum(np.arange(packs * pack), len(pixels) - 1)]
    visible = wp.empty((len(place), packs), dtype=pack_type(pack, wp.uint8), device=device)
    normals = wp.empty((0, packs), dtype=pack_type(pack, wp.float32), device=device) if surface is None else surface.values[:3]
    devices.launch(_see_kernel(pack), len(place) * packs,
                   [wp.array(place, dtype=wp.vec4, device=device), wp.array(where, dtype=wp.int32, device=device), normals,
                    relief_of(height, mask, projection, extent, thickness)], [visible], device=device, uneven=True)
    return visible


@once
def _see_kernel(pack: int) -> Any:
    byte_pack, lane_type, load = pack_type(pack, wp.uint8), pack_type(pack, wp.float32), pack_load(pack, wp.float32)

    # unrolled on CUDA, so that the bytes of a pack stay in registers
    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 4})
    def see_kernel(first: int,
                   places: wp.array(dtype=wp.vec4),  # [N]
                   pixels: wp.array(dtype=wp.int32),  # [P · pack]
                   normals: wp.array2d(dtype=lane_type),  # [3, P]; none: they are not looked at
                   relief: Relief,
                   # outputs
                   visible: wp.array2d(dtype=byte_pack)):  # [N, P]
        thread = first + wp.tid()
        packs = visible.shape[1]
        light = thread / packs
        p = thread % packs
        place = places[light]
        out = byte_pack()
        nx, ny, nz = lane_type(), lane_type(), lane_type()
        if normals.shape[0] > 0:
            nx = load(normals, 0, p)
            ny = load(normals, 1, p)
            nz = load(normals, 2, p)
        for k in range(pack):
            n = pixels[p * pack + k]
            row, col = n / relief.mask.shape[1], n % relief.mask.shape[1]
            toward = wp.vec3(place[0], place[1], place[2])
            reach = float(NO_REACH)
            if place[3] > 0.0:
                toward = toward - surface_point(row, col, relief.height, relief.camera)
                reach = wp.length(toward)
                toward = toward / wp.max(reach, 1.0e-20)
            hidden = bool(False)
            if normals.shape[0] == 0 or nx[k] * toward[0] + ny[k] * toward[1] + nz[k] * toward[2] > GRAZING:
                hidden = in_shadow_within(relief, row, col, toward, reach)
            out[k] = wp.where(hidden, wp.uint8(0), wp.uint8(255))
        visible[light, p] = out

    return see_kernel
