"""Readings that a mixture of lobes predicts under a normal, as the search fits them."""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.hypotheses import Diffuse, criteria
from kernels.photometric.lobes import direction_lobes
from kernels.photometric.robust_weights import Criteria
from kernels.photometric.samples import Samples, host_values, per_pixel, samples_type, scratch_memory, scratch_type


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
    predicted = wp.empty_like(samples.grey)
    devices.launch(_predict_kernel(samples.lanes), samples.packs,
                   [samples.arrays, wp.empty((0, 0, 0), dtype=wp.float32, device=samples.device), per_pixel(samples, normal),
                    per_pixel(samples, weights), criteria(None, shape)],
                   [scratch_memory(samples, direction_lobes(samples.lanes).held), predicted], device=samples.device)
    return host_values(samples, predicted)


@once
def _predict_kernel(lanes: int) -> Any:
    lane_type, samples_struct, scratch_struct = pack_type(lanes, wp.float32), samples_type(lanes), scratch_type(lanes)
    mixture, _, _, prepare, fill = direction_lobes(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def predict_kernel(first: int,
                       samples: samples_struct,
                       table: wp.array3d(dtype=float),  # of no use to lights of one direction
                       normal: wp.array2d(dtype=lane_type),  # [3, P]
                       weights: wp.array2d(dtype=lane_type),  # [lobes, P]
                       criteria: Criteria,
                       # outputs
                       scratch: scratch_struct,  # what the lobes hold
                       predicted: wp.array(dtype=lane_type)):  # [P · L]
        p = first + wp.tid()
        prepare(samples, p, scratch)
        fill(samples, table, criteria.form, normal[0, p], normal[1, p], normal[2, p], p, scratch)
        for light in range(samples.light_count):
            total = lane_type()
            for a in range(mixture):
                f = scratch.values[p * scratch.pack_stride + light * scratch.light_stride + a * scratch.step]
                x = weights[a, p]
                for k in range(lanes):
                    total[k] += f[k] * x[k]
            predicted[p * samples.pack_stride + light * samples.light_stride] = total

    return predict_kernel
