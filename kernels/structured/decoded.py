"""The result that every decoder of projected codes returns."""

from math import sqrt
from typing import NamedTuple

import warp as wp

from kernels.errors import ArrayError
from kernels.packs import unwritten, zeros
from kernels.status import OK, Status

STRIPE_DEVIATION = 1.0 / sqrt(12.0)
"""Standard deviation of a place evenly distributed over a stripe of width one."""
MAX_SPREAD = 1
"""Largest distance, in stripes, between the readings of a pixel with doubtful digits that still give a place."""

_SATURATED, _SHADOWED, _UNDECIDED, _MULTIPATH, _OUT_OF_RANGE = (
    int(s) for s in (Status.SATURATED, Status.SHADOWED, Status.UNDECIDED, Status.MULTIPATH, Status.OUT_OF_RANGE))


class Decoded(NamedTuple):
    """One coordinate of the projector at each camera pixel, on the device; pixels are padded to whole packs.

    UNDECIDED and MULTIPATH pixels carry the most likely coordinate and its deviation where there is one; else both are 0.
    """

    coordinate: wp.array  # [pixels] float32: continuous u or v, projector pixels (discrete codes: of the stripe centre), or 0
    sigma: wp.array  # [pixels] float32: standard deviation of the coordinate, projector pixels; 0 where not decoded
    amplitude: wp.array  # [pixels] float32: half of what the pattern changes, in the unit of the images
    status: wp.array  # [pixels] uint8, codes of kernels.status


def unwritten_decoded(pixels: int, device: str) -> Decoded:
    """Return the arrays of a result, for a kernel to write."""
    return Decoded(*(unwritten(pixels, dtype, device) for dtype in (wp.float32, wp.float32, wp.float32, wp.uint8)))


def cropped(decoded: Decoded, first: int, count: int, *, device: str) -> Decoded:
    """Return a copy of `count` pixels from `first` on, padded to whole packs."""
    have = decoded.coordinate.shape[0]
    if first < 0 or count < 1 or first + count > have:
        raise ArrayError(f"pixels {first} to {first + count} are asked for, there are {have}")
    parts = [zeros(count, array.dtype, device) for array in decoded]
    for part, array in zip(parts, decoded, strict=True):
        wp.copy(part, array, src_offset=first, count=count)
    return Decoded(*parts)


@wp.func
def place_stripe(cut: int, lit: bool, settled: bool, mixed: bool, read: int, one: int, other: int, both: int, block: int, reach: int,
                 loose: float, spread: int, stripe: float, extent: float):
    """Return the status of a pixel, the middle of the stripes that it may show and its deviation.

    UNDECIDED and MULTIPATH have a place too: the stripe as read, with the deviation of `spread` stripes. The others that are not OK have 0.

    Args:
        cut: not 0 where a frame saturates.
        lit: whether the projector reaches the pixel.
        settled: whether two digits at most are in doubt, beside the finest that `block` leaves open.
        mixed: whether light of other ways may have decided more than these.
        read, one, other, both: number of the block as read, with the other choice of either doubtful digit, and of both.
        block: number of stripes that the finest digits leave open; numbers count blocks.
        reach: largest distance, in blocks, between these numbers that still gives a place.
        loose: part of a stripe, 0…1, that noise or other light adds to the width of a pixel at an edge.
        spread: how many stripes the single choices of all doubtful digits span.
        stripe: width of a stripe, projector pixels.
        extent: projector pixels along the axis.
    """
    least = wp.min(wp.min(read, one), wp.min(other, both))
    most = wp.max(wp.max(read, one), wp.max(other, both))
    width = float(block) * stripe
    start = float(least) * width
    middle, deviation = float(0.0), float(0.0)
    code = OK
    if cut != 0:
        code = _SATURATED
    elif not lit:
        code = _SHADOWED
    elif mixed or not settled or most - least > reach:
        code = wp.where(mixed, _MULTIPATH, _UNDECIDED)
        middle = wp.min((float(read) + 0.5) * width, extent)
        deviation = STRIPE_DEVIATION * wp.min(float(spread) * stripe, extent)
    elif start >= extent:
        code = _OUT_OF_RANGE
    else:
        end = wp.min((float(most) + 1.0) * width, extent)
        middle = 0.5 * (start + end)
        # a pixel that mixes two stripes lies within half a stripe of their edge, or it would mix others too
        deviation = STRIPE_DEVIATION * wp.where((most - least + 1) * block == 2, wp.min((1.0 + loose) * stripe, end - start), end - start)
    return code, middle, deviation
