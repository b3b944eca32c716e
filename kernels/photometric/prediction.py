"""Readings that a mixture of lobes predicts under a normal, as the search fits them."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.hypotheses import Diffuse, SearchOptions, criteria
from kernels.photometric.lobes import direction_lobes
from kernels.photometric.samples import Samples, host_values, per_pixel


def predict(samples: Samples, normal: np.ndarray, weights: np.ndarray, *, shape: Diffuse) -> np.ndarray:
    """Return the readings that mixtures of lobes predict, relative to the level of each pixel.

    Args:
        samples: directions of lights and viewer.
        normal: [n, 3] unit normals.
        weights: [n, lobes] of the mixtures, from search_normals.
        shape: of the diffuse lobe.

    Returns:
        [n, lights] float32. Waits for the device.
    """
    lanes, packs, lights = samples.lanes, samples.packs, samples.light_count
    lobes = direction_lobes(lanes)
    lane_type = pack_type(lanes, wp.float32)
    predicted = wp.empty(packs * lights, dtype=lane_type, device=samples.device)
    scratch = wp.empty(packs * lights * lobes.held, dtype=lane_type, device=samples.device)
    devices.launch(_predict_kernel(lanes), packs,
                   [samples.toward, wp.empty((0, 0, 0), dtype=wp.float32, device=samples.device), samples.view,
                    per_pixel(samples, normal), per_pixel(samples, weights), criteria(SearchOptions(), shape)[2], lights,
                    samples.pack_stride, samples.light_stride],
                   [scratch, predicted], device=samples.device)
    return host_values(samples, predicted)


@once
def _predict_kernel(lanes: int) -> Any:
    lane_type = pack_type(lanes, wp.float32)
    mixture, held, _, prepare, fill = direction_lobes(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def predict_kernel(first: int,
                       toward: wp.array2d(dtype=lane_type),  # [3, P · L]
                       table: wp.array3d(dtype=float),  # of no use to lights of one direction
                       view: wp.array2d(dtype=lane_type),  # [3, P]
                       normal: wp.array2d(dtype=lane_type),  # [3, P]
                       weights: wp.array2d(dtype=lane_type),  # [lobes, P]
                       form: wp.vec2,  # diffuse roughness, slope
                       light_count: int,
                       pack_stride: int,
                       light_stride: int,
                       # outputs
                       scratch: wp.array(dtype=lane_type),  # [P · L · held]
                       predicted: wp.array(dtype=lane_type)):  # [P · L]
        p = first + wp.tid()
        start, base = p * pack_stride, p * light_count * held
        prepare(toward, view[0, p], view[1, p], view[2, p], start, light_count, light_stride, base, 1, scratch)
        fill(toward, table, form, normal[0, p], normal[1, p], normal[2, p], view[0, p], view[1, p], view[2, p],
             start, light_count, light_stride, base, 1, scratch)
        for light in range(light_count):
            total = lane_type()
            for a in range(mixture):
                f, x = scratch[base + light * held + a], weights[a, p]
                for k in range(lanes):
                    total[k] += f[k] * x[k]
            predicted[start + light * light_stride] = total

    return predict_kernel
