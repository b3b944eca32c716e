"""The samples of some of the sampled pixels, which are copied on their device, and results of some pixels put among those of all."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.model.samples import Samples


def put(whole: Iterable[np.ndarray], where: np.ndarray, part: Iterable[np.ndarray]) -> None:
    """Replace the results of some pixels, field by field, in place."""
    for values, replaced in zip(whole, part, strict=True):
        values[where] = replaced


def either(first: np.ndarray, a: Iterable[np.ndarray], b: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Return one result of all pixels, field by field, where `first` [n] is true, else the other."""
    return [np.where(first if x.ndim == 1 else first[:, None], x, y) for x, y in zip(a, b, strict=True)]


def choose(samples: Samples, chosen: np.ndarray) -> Samples:
    """Return the samples of some of the sampled pixels.

    Args:
        chosen: [n] bool, or positions among them; one or more.

    Returns:
        The samples on the same device.
    """
    positions = np.flatnonzero(chosen) if chosen.dtype == bool else chosen
    lanes, packs = samples.lanes, -(-len(positions) // samples.lanes)
    order = positions[np.minimum(np.arange(packs * lanes), len(positions) - 1)]
    strides = (samples.light_count, 1) if samples.device == "cpu" else (1, packs)
    where = wp.array(order, dtype=wp.int32, device=samples.device)

    def pick(values: wp.array, lights: int, old: tuple[int, int], new: tuple[int, int]) -> wp.array:
        rows = values.shape[:-1]
        picked = wp.empty((*rows, packs * lights), dtype=values.dtype, device=samples.device)
        single, chosen = (each.reshape((math.prod(rows), -1)) for each in (values, picked))
        devices.launch(_choose_kernel(lanes), packs, [single, where, lights, *old, *new], [chosen], device=samples.device)
        return picked

    grey, colour, toward = (pick(values, samples.light_count, (samples.pack_stride, samples.light_stride), strides)
                            for values in (samples.grey, samples.colour, samples.toward))
    level, view = (pick(values, 1, (1, 0), (1, 0)) for values in (samples.level, samples.view))
    return Samples(grey, colour, level, toward, view, len(positions), packs, samples.light_count, lanes, *strides, samples.device)


@once
def _choose_kernel(lanes: int) -> Any:
    lane_type = pack_type(lanes, wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def choose_kernel(first: int,
                      values: wp.array2d(dtype=lane_type),
                      pixels: wp.array(dtype=wp.int32),  # [P · lanes]
                      light_count: int,
                      pack_stride: int,  # of values
                      light_stride: int,
                      chosen_pack_stride: int,
                      chosen_light_stride: int,
                      # outputs
                      chosen: wp.array2d(dtype=lane_type)):
        p = first + wp.tid()
        for row in range(values.shape[0]):
            for light in range(light_count):
                picked = lane_type()
                for k in range(lanes):
                    n = pixels[p * lanes + k]
                    picked[k] = values[row, n // lanes * pack_stride + light * light_stride][n % lanes]
                chosen[row, p * chosen_pack_stride + light * chosen_light_stride] = picked

    return choose_kernel
