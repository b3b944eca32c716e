"""Carries of plain k-ary codes: the edges at which several digits of a number change at once.

Where digit j of a plain code grows by one, all finer digits fall from k - 1 to 0. A pixel that sees both stripes reads all of them at one
mixture t; levels in between look like other digits, and the number that they spell may lie far away. So every such carry is fitted to
the readings (t by least squares over the finer digits, the best pair of levels of digit j, the nearest levels of the coarser ones), and the
best is weighed against the nearest levels (kary.py). In a reflected code one digit changes by one at every edge, and no carry exists.
"""

from typing import Any, Literal

import warp as wp

from kernels.device import once
from kernels.packs import pack_type

EMPTY_CHI2 = 1.0e30
"""Sentinel χ² where there is no carry."""
NO_EDGE = -2
"""Number of the stripe behind an edge where there is none."""
LEVEL_ERROR = 0.02
"""Error of a level beyond noise, as a part of white minus black: the camera's and projector's responses and light from other surfaces cause
it."""
FINEST_ERROR = 0.15
"""The same for the finest digit where carries are fitted: a pixel as wide as a stripe mixes in stripes beyond the two of the edge."""


@wp.struct
class Code:
    """The frames of a k-ary code, what they show, and the noise of their readings."""

    order: wp.array(dtype=int)  # [digits] frames, finest first
    white: int
    black: int
    expected: wp.array2d(dtype=float)  # [k, channels] of `kary.expected_levels`
    reflected: int
    read_variance: float
    gain: float


@wp.func
def weight_of_reading(on: float, off: float, reading: float, level_error: float, code: Code) -> float:
    """Return 1 / variance of a reading minus the level that black and white of the pixel let expect."""
    contrast = wp.max(on - off, 0.0)
    return 1.0 / (3.0 * code.read_variance + level_error * level_error * contrast * contrast
                  + code.gain * (wp.max(on, 0.0) + wp.max(off, 0.0) + wp.max(reading, 0.0)))


@once
def carry_kernel(pack: int, channels: Literal[1, 3]) -> Any:
    """Return the kernel that fits levels and carries."""
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def fit_kernel(first: int,
                   values: wp.array2d(dtype=float_pack),  # [F · channels, P]
                   code: Code,
                   # outputs
                   misfit: wp.array(dtype=float_pack),  # [P] χ² of the nearest levels
                   carry_misfit: wp.array(dtype=float_pack),  # [P] χ² of the best carry
                   edge: wp.array(dtype=int_pack)):  # [P] number of the stripe behind it; NO_EDGE
        p = first + wp.tid()
        base = code.expected.shape[0]
        total, chosen, place, below, unit = float_pack(), float_pack(EMPTY_CHI2), int_pack(), int_pack(), int_pack()
        xx, xr, rr, number, chosen_total = float_pack(), float_pack(), float_pack(), int_pack(), float_pack()
        chosen_unit = int_pack()
        for k in range(pack):
            unit[k] = 1
            place[k] = NO_EDGE
        for digit in range(code.order.shape[0]):
            frame = code.order[digit]
            own = wp.where(digit == 0, FINEST_ERROR, LEVEL_ERROR)
            best, nearest, carried, pair = float_pack(EMPTY_CHI2), int_pack(), float_pack(EMPTY_CHI2), int_pack()
            for level in range(base):
                cost, mixed = float_pack(), float_pack()
                for channel in range(channels):
                    on = values[code.white * channels + channel, p]
                    off = values[code.black * channels + channel, p]
                    reading = values[frame * channels + channel, p]
                    here = float(code.expected[level, channel])
                    there = float(code.expected[wp.min(level + 1, base - 1), channel])
                    for k in range(pack):
                        contrast = wp.max(on[k] - off[k], 0.0)
                        w = weight_of_reading(on[k], off[k], reading[k], own, code)
                        miss = reading[k] - off[k] - here * contrast
                        cost[k] = cost[k] + w * miss * miss
                        t = wp.clamp(xr[k] / wp.max(xx[k], 1.0e-20), 0.0, 1.0)
                        miss = miss - t * (there - here) * contrast
                        mixed[k] = mixed[k] + w * miss * miss
                for k in range(pack):
                    nearest[k] = wp.where(cost[k] < best[k], level, nearest[k])
                    best[k] = wp.min(best[k], cost[k])
                    if level + 1 < base:
                        pair[k] = wp.where(mixed[k] < carried[k], level, pair[k])
                        carried[k] = wp.min(carried[k], mixed[k])
            for k in range(pack):
                if digit > 0 and code.reflected == 0:
                    # coarser digits are the same under both: their cost is added to either later
                    t = wp.clamp(xr[k] / wp.max(xx[k], 1.0e-20), 0.0, 1.0)
                    rarity = 2.0 * float(digit) * wp.log(float(base))
                    cost_of = rr[k] - 2.0 * t * xr[k] + t * t * xx[k] + carried[k] + rarity
                    if cost_of - total[k] - best[k] < chosen[k] - chosen_total[k]:
                        chosen[k] = cost_of
                        chosen_total[k] = total[k] + best[k]
                        below[k] = (pair[k] + 1) * unit[k]
                        chosen_unit[k] = unit[k] * base
                number[k] = number[k] + nearest[k] * unit[k]
                unit[k] = unit[k] * base
                total[k] = total[k] + best[k]
            for channel in range(channels):
                on = values[code.white * channels + channel, p]
                off = values[code.black * channels + channel, p]
                reading = values[frame * channels + channel, p]
                top = float(code.expected[base - 1, channel])
                step = float(code.expected[0, channel]) - top
                for k in range(pack):
                    contrast = wp.max(on[k] - off[k], 0.0)
                    w = weight_of_reading(on[k], off[k], reading[k], own, code)
                    rest = reading[k] - off[k] - top * contrast
                    x = step * contrast
                    xx[k] = xx[k] + w * x * x
                    xr[k] = xr[k] + w * x * rest
                    rr[k] = rr[k] + w * rest * rest
        carry = float_pack()
        for k in range(pack):
            found = chosen_unit[k] > 0 and chosen[k] < EMPTY_CHI2
            carry[k] = wp.where(found, total[k] - chosen_total[k] + chosen[k], EMPTY_CHI2)
            if found:
                place[k] = number[k] / chosen_unit[k] * chosen_unit[k] + below[k]
        misfit[p] = total
        carry_misfit[p] = carry
        edge[p] = place

    return fit_kernel
