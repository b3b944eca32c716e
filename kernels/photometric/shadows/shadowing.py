"""Cast shadows: readings whose light is hidden by the surface, as its height says, are taken out of the samples.
Readings of wide lights that a surface hides in part are divided by the part of the light that reached the pixel.

Source: photometric stereo without the shadowed lights of a pixel, Barsky and Petrou, "The 4-source photometric stereo technique for
three-dimensional surfaces in the presence of highlights and shadows", TPAMI 2003; here the shadows are marched over a height map.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type, vector_at
from kernels.photometric.lambertian.near import Places
from kernels.photometric.model.samples import Samples, per_pixel, samples_type
from kernels.surface.shadows import NO_REACH, Extent, Projection, Relief, in_shadow_within, relief_of, surface_point


def exclude_shadows(samples: Samples, pixels: np.ndarray, height: wp.array, mask: wp.array, projection: Projection,
                    places: Places | None = None, extent: Extent | None = None) -> None:
    """Mark readings whose light is hidden by the surface as no readings, in place.

    Args:
        pixels: [n] their row-major positions in the image.
        height: [rows, cols] float32, camera-frame z.
        mask: [rows, cols] uint8, where there is surface.
        projection: of the camera; the unit is that of height.
        places: of the lights, where some light is near.
        extent: of the surface; None: it is found, for which height and mask are read back.
    """
    rows, cols = mask.shape
    if len(pixels) != samples.pixel_count or pixels.min() < 0 or pixels.max() >= rows * cols:
        raise ArrayError(f"pixels must be {samples.pixel_count} positions from 0 to {rows * cols - 1}")
    order = np.minimum(np.arange(samples.packs * samples.lanes), samples.pixel_count - 1)
    where = wp.array(pixels[order], dtype=wp.int32, device=samples.device)
    place = np.zeros((samples.light_count, 4), dtype=np.float32) if places is None else places.place
    devices.launch(_exclude_kernel(samples.lanes), samples.packs,
                   [wp.array(place, dtype=wp.vec4, device=samples.device), where,
                    relief_of(height, mask, projection, extent)], [samples.arrays], device=samples.device)


@once
def _exclude_kernel(lanes: int) -> Any:
    samples_struct = samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def exclude_kernel(first: int,
                       places: wp.array(dtype=wp.vec4),  # [L or padded] position and 1, or anything and 0
                       pixels: wp.array(dtype=wp.int32),  # [P · lanes]
                       relief: Relief,
                       # outputs
                       samples: samples_struct):
        p = first + wp.tid()
        cols = relief.mask.shape[1]
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            place = places[light]
            lx, ly, lz = vector_at(samples.toward, at)
            y = samples.grey[at]
            red, green, blue = vector_at(samples.colour, at)
            for k in range(lanes):
                n = pixels[p * lanes + k]
                row, col = n / cols, n % cols
                start = surface_point(row, col, relief.height, relief.camera)
                reach = wp.where(place[3] > 0.0, wp.length(wp.vec3(place[0], place[1], place[2]) - start), NO_REACH)
                if in_shadow_within(relief, row, col, wp.vec3(lx[k], ly[k], lz[k]), reach):
                    y[k] = -1.0
                    red[k] = -1.0
                    green[k] = -1.0
                    blue[k] = -1.0
            samples.grey[at] = y
            samples.colour[0, at] = red
            samples.colour[1, at] = green
            samples.colour[2, at] = blue

    return exclude_kernel


LEAST_PART = 0.5
"""Least part of the light of a source, as the pixel reflects it, at which its reading is used: below it, the shape of the shadow's
edge, which follows from a height that is not exact, decides the reading."""


def divide_by_visible(samples: Samples, part: np.ndarray) -> None:
    """Divide readings by the visible part of their light, and mark those as no readings of which too little is visible, in place.
    `part`: [n, lights] from 0 to 1: what each pixel reflects of each light where the surface hides some of it, over what it would
    reflect of the whole."""
    if part.shape != (samples.pixel_count, samples.light_count):
        raise ArrayError(f"part is {part.shape}: give one number for each of {samples.pixel_count} pixels and {samples.light_count} lights")
    devices.launch(_divide_kernel(samples.lanes), samples.packs,
                   [per_pixel(samples, part)], [samples.arrays], device=samples.device)


@once
def _divide_kernel(lanes: int) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def divide_kernel(first: int,
                      part: wp.array2d(dtype=lane_type),  # [L, P]
                      # outputs
                      samples: samples_struct):
        p = first + wp.tid()
        for light in range(samples.light_count):
            at = p * samples.pack_stride + light * samples.light_stride
            seen = part[light, p]
            y = samples.grey[at]
            for k in range(lanes):
                y[k] = wp.where(seen[k] >= LEAST_PART, y[k] / wp.max(seen[k], LEAST_PART), -1.0)
            samples.grey[at] = y
            for c in range(3):
                channel = samples.colour[c, at]
                for k in range(lanes):
                    channel[k] = wp.where(seen[k] >= LEAST_PART, channel[k] / wp.max(seen[k], LEAST_PART), -1.0)
                samples.colour[c, at] = channel

    return divide_kernel
