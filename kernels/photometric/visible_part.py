"""Wide lights that a surface hides in part: readings are divided by the part of the light that reached the pixel.

A light of which hardly anything arrived says nothing about the rest of its extent, so its reading counts as none.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.photometric.samples import Samples, per_pixel, samples_type

LEAST_PART = 0.5
"""Least part of the light of a source, as the pixel reflects it, at which its reading is used: below it, the shape of the shadow's
edge, which follows from a height that is not exact, decides the reading."""


def divide_by_visible(samples: Samples, part: np.ndarray) -> None:
    """Divide readings by the visible part of their light, and mark those as no readings of which too little is visible.

    Args:
        samples: changed in place.
        part: [n, lights] from 0 to 1: what each pixel reflects of each light where the surface hides some of it, over what it would reflect
            of the whole.

    Raises:
        ArrayError: parts of other pixels or lights.
    """
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
