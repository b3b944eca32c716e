"""What every decoder of projected codes returns."""

from typing import NamedTuple

import warp as wp


class Decoded(NamedTuple):
    """One coordinate of the projector at each camera pixel, on the device; pixels are padded to whole packs."""

    coordinate: wp.array  # [pixels] float32: continuous u or v, projector pixels (discrete codes: of the stripe centre), or 0
    sigma: wp.array  # [pixels] float32: standard deviation of the coordinate, projector pixels; 0 where not decoded
    amplitude: wp.array  # [pixels] float32: half of what the pattern changes, in the unit of the images
    status: wp.array  # [pixels] uint8, codes of kernels.status
