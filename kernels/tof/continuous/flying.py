"""Flying pixels: a pixel that sees the edge of one surface before another measures a range between the two.

They are marked and no other pixel changes: smoothing is a filter of its own.

Source: Sabov and Krüger, "Identification and correction of flying pixels in range camera data", SCCG 2008; here a pixel is judged by the
straight lines through its neighbours on either side and by their standard deviations.
"""

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import Status

SIGMAS = 4.0
"""Least departure of a flying pixel from what both sides predict, in standard deviations of the difference."""
RELATIVE = 0.01
"""Least departure of a flying pixel, as a part of its range: curved surfaces depart from their tangents too."""
STEPS = 1.5
"""The departure must exceed this many times the side's own pixel-to-pixel step: a surface that curves away at its rim bends by less than a
step."""
STEEPEST = 10.0
"""Neighbours are on one surface when their ranges differ by less than this many times the least departure: a slope of a tenth of the range
per pixel."""
ASIDE = 0.9
"""A step across the line counts as slope only if it is smaller than this fraction of the pixel's departure; a larger one may be a flying
pixel."""
LEAST_SUPPORT = 2
"""Least number of the eight neighbours that lie on the same surface: a wire one pixel wide has two. Where fewer than six are measured, a
third of them suffices."""

_OK, _FLYING = int(Status.OK), int(Status.FLYING)


def mark_flying(ranges: wp.array, sigma: wp.array, status: wp.array, rows: int, cols: int, *, least_m: float = 0.02) -> wp.array:
    """Find flying pixels.

    A pixel is flying where, along a row, a column or a diagonal, the straight lines through the two pixels on either side (next to it,
    or one further away: edges blur over two pixels) predict ranges that lie apart, and it lies between them, on neither; or where fewer
    than LEAST_SUPPORT neighbours are as far away as it is.

    Args:
        ranges, sigma: [rows · cols] float32 metres, padded or not.
        status: [rows · cols] int32; only pixels that are OK are looked at and count as neighbours.
        least_m: smallest departure that counts, metres.

    Returns:
        [rows · cols] int32 status with FLYING in it, on the device.
    """
    require_image(ranges, sigma, status, rows=rows, cols=cols)
    if not (np.isfinite(least_m) and least_m > 0):
        raise ArrayError(f"the least departure is {least_m} m: give one above zero")
    marked = wp.zeros_like(status)
    devices.launch(_flying_kernel, rows * cols, [ranges, sigma, status, rows, cols, float(least_m)], [marked], device=str(ranges.device))
    return marked


def require_image(*arrays: wp.array, rows: int, cols: int) -> None:
    """Refuse arrays that are not one image."""
    for array in arrays:
        if len(array.shape) != 1 or not 0 < rows * cols <= array.shape[0]:
            raise ArrayError(f"an array is {array.shape}, the image is {rows} x {cols}: give [rows · cols], padded or not")


@wp.func
def seen(status: wp.array(dtype=wp.int32), r: int, c: int, rows: int, cols: int):
    """Return whether the pixel lies in the image and is measured."""
    inside = False
    if r >= 0 and c >= 0 and r < rows and c < cols:
        inside = status[r * cols + c] == _OK
    return inside


@wp.func
def step_aside(ranges: wp.array(dtype=wp.float32), status: wp.array(dtype=wp.int32), r: int, c: int, dr: int, dc: int, rows: int,
               cols: int, most: float):
    """Return the largest step from a pixel to its neighbours across the direction (dr, dc), of those below `most`."""
    here = ranges[r * cols + c]
    largest = float(0.0)
    for side in range(2):
        sign = 1 - 2 * side
        if seen(status, r - sign * dc, c + sign * dr, rows, cols):
            step = wp.abs(ranges[(r - sign * dc) * cols + c + sign * dr] - here)
            if step < most:
                largest = wp.max(largest, step)
    return largest


@wp.func
def departure(ranges: wp.array(dtype=wp.float32), sigma: wp.array(dtype=wp.float32), status: wp.array(dtype=wp.int32), r: int, c: int,
              dr: int, dc: int, reach: int, rows: int, cols: int, least: float):
    """Return how far a pixel departs from the line through the two pixels `reach` steps and one more in a direction, how far from the
    nearer of the two, and how far from the line it must at least to lie off it; zeros where one of the two is not measured."""
    found = wp.vec3()
    r1 = r + reach * dr
    c1 = c + reach * dc
    if seen(status, r1, c1, rows, cols) and seen(status, r1 + dr, c1 + dc, rows, cols):
        p = r * cols + c
        i = r1 * cols + c1
        j = i + dr * cols + dc
        ahead = float(reach)
        line = ranges[i] + ahead * (ranges[i] - ranges[j])
        variance = sigma[p] * sigma[p] + (1.0 + ahead) * (1.0 + ahead) * sigma[i] * sigma[i] + ahead * ahead * sigma[j] * sigma[j]
        rise = wp.max(wp.abs(ranges[i] - ranges[j]),
                      step_aside(ranges, status, r1, c1, dr, dc, rows, cols, ASIDE * wp.abs(ranges[p] - ranges[i])))
        most = wp.max(wp.max(SIGMAS * wp.sqrt(variance), least), STEPS * ahead * rise)
        found = wp.vec3(ranges[p] - line, ranges[p] - ranges[i], most)
    return found


@wp.kernel(module="unique", module_options={"max_unroll": 2})  # unrolled, it is no faster and takes seconds to compile
def _flying_kernel(first: int,
                   ranges: wp.array(dtype=wp.float32),
                   sigma: wp.array(dtype=wp.float32),
                   status: wp.array(dtype=wp.int32),
                   rows: int,
                   cols: int,
                   least: float,
                   # outputs
                   marked: wp.array(dtype=wp.int32)):
    p = first + wp.tid()
    code = status[p]
    if code == _OK:
        r = p // cols
        c = p - r * cols
        d = ranges[p]
        s2 = sigma[p] * sigma[p]
        floor_m = wp.max(least, RELATIVE * d)
        flying = bool(False)
        for direction in range(4):  # right, down, down right, down left
            dr = wp.where(direction == 0, 0, 1)
            dc = wp.where(direction == 1, 0, wp.where(direction == 3, -1, 1))
            for reach in range(1, 3):
                one = departure(ranges, sigma, status, r, c, -dr, -dc, reach, rows, cols, floor_m)
                if wp.abs(one[0]) > one[2]:
                    other = departure(ranges, sigma, status, r, c, dr, dc, reach, rows, cols, floor_m)
                    if wp.abs(other[0]) > other[2] and one[0] * other[0] < 0.0 and one[1] * other[1] < 0.0:
                        flying = True
        if not flying:
            support = wp.int32(0)
            present = wp.int32(0)
            for i in range(-1, 2):
                for j in range(-1, 2):
                    if (i != 0 or j != 0) and seen(status, r + i, c + j, rows, cols):
                        q = (r + i) * cols + c + j
                        present += 1
                        near = STEEPEST * wp.max(SIGMAS * wp.sqrt(s2 + sigma[q] * sigma[q]), floor_m)
                        if wp.abs(ranges[q] - d) < near:
                            support += 1
            flying = support < wp.min(LEAST_SUPPORT, present // 3)
        if flying:
            code = int(_FLYING)
    marked[p] = code
