"""What the readings of a pixel say beyond the unknowns that they had to pay for, and how much of them a fit leaves unexplained."""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import pack_type
from kernels.photometric.samples import Samples, samples_type, to_host

INFORMATIVE = 0.1
"""Part of a pixel's level below which a reading is shadow and says little: it does not count as information."""
USED = 1e-3
"""Weight above which a lobe of the mixture counts as an unknown that the readings have paid for."""
DIRECTION = 2
"""Unknowns of a unit normal."""
EXPECTED_COST, PSEUDO_READINGS = 0.05, 1.0
"""Cost of a reading that is expected before any is seen, and the number of readings that this expectation counts as: real and path-traced
objects have 0.01 to 0.15 under many lights, and a fit with as many unknowns as readings has no misfit of its own."""


class Evidence(NamedTuple):
    """How well the readings of each sampled pixel are explained."""

    total: np.ndarray  # [n] float64, cost of all readings
    surplus: np.ndarray  # [n] readings that could have contradicted the fit
    noise: np.ndarray  # [n] float64, cost of a reading beyond the unknowns


def evidence(samples: Samples, cost: np.ndarray, weights: np.ndarray) -> Evidence:
    """Return what the fits of sampled pixels leave unexplained. Waits for the device.

    Args:
        samples: the readings.
        cost: [n] of the fit, per light.
        weights: [n, lobes] of its mixture.
    """
    unknowns = DIRECTION + (weights > USED).sum(axis=1)
    total = cost.astype(np.float64) * samples.light_count
    surplus = np.maximum(_informative(samples) - unknowns, 0)
    return Evidence(total, surplus, (total + EXPECTED_COST * PSEUDO_READINGS) / (surplus + PSEUDO_READINGS))


def _informative(samples: Samples) -> np.ndarray:
    """Return [n] the number of readings that are not shadow."""
    counts = wp.empty(samples.packs, dtype=pack_type(samples.lanes, wp.float32), device=samples.device)
    devices.launch(_count_kernel(samples.lanes), samples.packs,
                   [samples.arrays], [counts], device=samples.device)
    return to_host(samples, counts)


@once
def _count_kernel(lanes: int) -> Any:
    lane_type, samples_struct = pack_type(lanes, wp.float32), samples_type(lanes)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def count_kernel(first: int,
                     samples: samples_struct,
                     # outputs
                     counts: wp.array(dtype=lane_type)):  # [P]
        p = first + wp.tid()
        count = lane_type()
        for light in range(samples.light_count):
            y = samples.grey[p * samples.pack_stride + light * samples.light_stride]
            for k in range(lanes):
                count[k] += wp.where(y[k] > INFORMATIVE, 1.0, 0.0)
        counts[p] = count

    return count_kernel
