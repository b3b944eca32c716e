"""Decoded pixels put together and taken apart: phases decoded one by one as one set of periods, and a part of a band."""

from collections.abc import Sequence

import warp as wp

from kernels.errors import ArrayError
from kernels.packs import unwritten, zeros
from kernels.structured.decoded import Decoded
from kernels.structured.phase import WrappedPhase


def join_periods(parts: Sequence[WrappedPhase]) -> WrappedPhase:
    """Return all periods of several phases of the same pixels, in the order given.

    Raises:
        ArrayError: nothing is given, or the pixels differ.
    """
    if not parts:
        raise ArrayError("no phase is given: give one or more")
    first = parts[0]
    other = next((part.pixel_count for part in parts if part.pixel_count != first.pixel_count), None)
    if other is not None:
        raise ArrayError(f"one phase has {first.pixel_count} pixels, another {other}: decode the same frames")
    periods = tuple(period for part in parts for period in part.periods_px)
    joined = []
    for field in ("phase", "amplitude", "offset", "sigma", "status"):
        rows = [getattr(part, field)[row] for part in parts for row in range(len(part.periods_px))]
        plane = unwritten(first.pixel_count, rows[0].dtype, first.device, rows=len(periods))
        for row, values in enumerate(rows):
            wp.copy(plane[row], values)
        joined.append(plane)
    return WrappedPhase(*joined, periods, first.pixel_count, first.device)


def cropped(decoded: Decoded, first: int, count: int, *, device: str) -> Decoded:
    """Return a copy of `count` pixels from `first` on, padded to whole packs.

    Raises:
        ArrayError: there are not as many.
    """
    have = decoded.coordinate.shape[0]
    if first < 0 or count < 1 or first + count > have:
        raise ArrayError(f"pixels {first} to {first + count} are asked for, there are {have}")
    parts = [zeros(count, array.dtype, device) for array in decoded]
    for part, array in zip(parts, decoded, strict=True):
        wp.copy(part, array, src_offset=first, count=count)
    return Decoded(*parts)
