"""Standard deviations at steps of the range: a pixel on an edge sees both sides, and its range is somewhere between them.

A step that is small against the wavelengths bends all phases alike, so that the frequencies agree on a range between the two sides and
nothing but the neighbours tells of it. Larger ones make the frequencies disagree, which `decide` and `disagreement` find.

On a slope the range of a pixel is that of its brighter part: where the amplitude changes from pixel to pixel, the mean lies aside.
"""

import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.continuous.decide import Ranges
from kernels.tof.continuous.unwrap import TURN

PART = 0.2
"""Standard deviation over the step: shares of both sides that are evenly distributed give 1/√12 = 0.29 of it, and about half of the pixels
next to a step are mixed, which divides the variance by two."""
ASIDE_PX = 1 / 12
"""How far the mean of a pixel lies aside for a contrast of one, (a - b) / (a + b), between the pixels beside it: by so much if the
amplitude grows evenly, and as a root mean square about as much if it has an edge anywhere between the two."""
LARGEST_RAD = 1.0
"""Phase at the highest frequency from which on a step makes the frequencies disagree, radians."""
SIGMAS = 4.0
"""Least step in standard deviations of the ranges that show it."""

_OK = int(Status.OK)


def cover_steps(ranges: Ranges, amplitude: wp.array, rows: int, cols: int, *, spacing_m: float) -> wp.array:
    """Return the standard deviation of each range, with that of mixed pixels where the range steps along a row or a column.

    A step is what the nearest OK pixels on both sides differ by, beyond the slopes further out on either side.

    Args:
        ranges: of `decide`; rows · cols pixels and padding.
        amplitude: [frequency, pixel] float32; the last frequency's is used.
        rows, cols: of the image.
        spacing_m: between wraps of the highest frequency, metres.

    Returns:
        [pixel] float32 metres, on the device; pixels that are not OK, or whose neighbours are not, keep what they have.
    """
    device, pixels = str(ranges.range.device), ranges.range.shape[0]
    if not 0 < rows * cols <= pixels:
        raise ArrayError(f"there are {pixels} pixels, the image is {rows} x {cols}: give the image's own size")
    sigma = wp.clone(ranges.sigma)
    devices.launch(_steps_kernel, rows * cols, [ranges.range, ranges.sigma, ranges.status, amplitude, rows, cols,
                                                LARGEST_RAD * spacing_m / TURN], [sigma], device=device)
    return sigma


@wp.func
def side(ranges: wp.array(dtype=wp.float32), sigma: wp.array(dtype=wp.float32), status: wp.array(dtype=wp.int32), p: int, stride: int):
    """Return the range of the nearest of two pixels beside p that is OK, its variance, how many pixels away it is (0: neither is OK), and
    the step between the two, or -1."""
    near = p + stride
    beyond = near + stride
    found = wp.vec4(0.0, 0.0, 0.0, -1.0)
    if status[near] == _OK:
        found = wp.vec4(ranges[near], sigma[near] * sigma[near], 1.0, -1.0)
        if status[beyond] == _OK:
            found[3] = wp.abs(ranges[beyond] - ranges[near])
    elif status[beyond] == _OK:
        found = wp.vec4(ranges[beyond], sigma[beyond] * sigma[beyond], 2.0, -1.0)
    return found


@wp.func
def step_along(ranges: wp.array(dtype=wp.float32), sigma: wp.array(dtype=wp.float32), status: wp.array(dtype=wp.int32), p: int, stride: int,
               place: int, length: int):
    """Return the step across a pixel at this place of a row or column; 0 where there is none."""
    found = float(0.0)
    if place >= 2 and place + 2 < length:
        one = side(ranges, sigma, status, p, -stride)
        other = side(ranges, sigma, status, p, stride)
        slope = wp.max(one[3], other[3])
        if one[2] > 0.0 and other[2] > 0.0 and slope >= 0.0:
            away = one[2] + other[2]
            before = wp.where(one[3] < 0.0, slope, one[3])
            after = wp.where(other[3] < 0.0, slope, other[3])
            step = wp.abs(one[0] - other[0]) - one[2] * before - other[2] * after
            if step > SIGMAS * wp.sqrt((1.0 + away * away) * (one[1] + other[1])):
                found = step
    return found


@wp.func
def aside(ranges: wp.array(dtype=wp.float32), status: wp.array(dtype=wp.int32), amplitude: wp.array2d(dtype=wp.float32), p: int,
          stride: int, place: int, length: int):
    """Return how far the range of a pixel lies aside because its light comes from one part of it, metres, along a row or column."""
    found = float(0.0)
    if place >= 1 and place + 1 < length:
        a = p - stride
        b = p + stride
        if status[a] == _OK and status[b] == _OK:
            f = amplitude.shape[0] - 1
            contrast = wp.abs(amplitude[f, b] - amplitude[f, a]) / wp.max(amplitude[f, b] + amplitude[f, a], 1.0e-30)
            slope = wp.min(wp.abs(ranges[b] - ranges[p]), wp.abs(ranges[p] - ranges[a]))
            found = ASIDE_PX * contrast * slope
    return found


@wp.kernel(module="unique")
def _steps_kernel(first: int,
                  ranges: wp.array(dtype=wp.float32),  # [pixel] metres
                  before: wp.array(dtype=wp.float32),  # [pixel] metres
                  status: wp.array(dtype=wp.int32),  # [pixel]
                  amplitude: wp.array2d(dtype=wp.float32),  # [F, pixel]
                  rows: int,
                  cols: int,
                  largest: float,  # metres
                  # outputs
                  sigma: wp.array(dtype=wp.float32)):  # [pixel] metres
    p = first + wp.tid()
    if status[p] == _OK:
        r = p // cols
        c = p - r * cols
        step = wp.max(step_along(ranges, before, status, p, 1, c, cols), step_along(ranges, before, status, p, cols, r, rows))
        more = PART * wp.min(step, largest)
        across = aside(ranges, status, amplitude, p, 1, c, cols)
        down = aside(ranges, status, amplitude, p, cols, r, rows)
        sigma[p] = wp.sqrt(before[p] * before[p] + more * more + across * across + down * down)
