"""Result of every decoder of projected codes."""

from math import sqrt
from typing import NamedTuple

import warp as wp

from kernels.packs import unwritten

STRIPE_DEVIATION = 1.0 / sqrt(12.0)
"""Standard deviation of a place evenly distributed over a stripe of width one."""


class Decoded(NamedTuple):
    """One coordinate of the projector at each camera pixel, on the device; pixels are padded to whole packs."""

    coordinate: wp.array  # [pixels] float32: continuous u or v, projector pixels (discrete codes: of the stripe centre), or 0
    sigma: wp.array  # [pixels] float32: standard deviation of the coordinate, projector pixels; 0 where not decoded
    amplitude: wp.array  # [pixels] float32: half of what the pattern changes, in the unit of the images
    status: wp.array  # [pixels] uint8, codes of kernels.status


def unwritten_decoded(pixels: int, device: str) -> Decoded:
    """Return the arrays of a result, for a kernel to write."""
    return Decoded(*(unwritten(pixels, dtype, device) for dtype in (wp.float32, wp.float32, wp.float32, wp.uint8)))


@wp.func
def stripe_place(least: int, most: int, stripe: float, extent: float) -> wp.vec2:
    """Return the middle of the stripes from `least` to `most`, each `stripe` pixels wide, and its standard deviation."""
    start = float(least) * stripe
    end = wp.min((float(most) + 1.0) * stripe, extent)
    return wp.vec2(0.5 * (start + end), STRIPE_DEVIATION * (end - start))
