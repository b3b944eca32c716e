"""A range image from points at any image coordinates: at the centre of each pixel, the depth of the surface that the nearest point lies on.

Along the lines of sight of a perspective camera the inverse depth of a plane is linear in the image. Each pixel takes the value at its
centre of the function that fits the points around it (moving least squares), by weights that fall with the distance. The function is
linear but for one term, the squared distance from the centre: without it the pixels would lie inside of each bent surface, as means do.

Points that are farther before or behind the nearest than a surface of 70° leads to do not count. Where noise does not explain what the
fit leaves, as beside lower steps and at creases, it is made again with weights that fall with the residual, which leads to the side with
most of the weight, that of the nearest points. The variance follows from the weights, and what noise still does not explain is added to
it. A pixel has no depth where the variance is larger than that of the nearest point alone, as beside the edge of the points, or where the
fit leaves a large part of the width of a pixel.

Source: Levin, "The approximation power of moving least-squares", Mathematics of Computation 67, 1998 (equations 1.1 to 1.5); Fleishman,
Cohen-Or and Silva, "Robust moving least-squares fitting with sharp features", SIGGRAPH 2005; Geman and McClure, "Statistical methods for
tomographic image reconstruction", 1987 (the weights).
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy

REACH = 3
"""Pixels to each side of a pixel whose points are looked at."""
NEAREST = 1.75
"""Farthest that the nearest point may lie from the centre of a pixel, pixels."""
WIDTH = 1.0
"""Standard deviation of the Gaussian function by which points count, pixels."""
STEEPEST = float(np.tan(np.radians(70.0)))
"""Largest slope of a surface against the line of sight: what is steeper may be an edge beside what lies behind it."""
STEP_SIGMAS = float(4.0 * np.sqrt(2.0))
"""Difference of two depths, in standard deviations of one, that noise explains."""
LEAST_SPREAD = 1.0e-3
"""Least determinant of the moments of the points, of which points all around have 4: below it they lie in a line or on a ring."""
MOST_SURER = 16.0
"""Largest ratio of the variances of two points by which one counts more than the other."""
ROUNDS = 6
"""Most fits of a pixel."""
LEAST_FREE = 0.1
"""Least part of the points that counts as left for the residual, of those that the four numbers of the fit leave."""
EXPLAINED = 1.2
"""Largest RMS residual that noise explains, in standard deviations of the points."""
REDESCENDING = 3.0
"""Least residual, in standard deviations, from which on the weight of a point falls fast."""
MOST_LEFT = 0.3
"""Largest RMS residual that noise does not explain, in widths of a pixel."""


class Resampled(NamedTuple):
    """Depth, its σ and the nearest point of each pixel, each [rows, cols]."""

    depth: np.ndarray  # float32 metres; 0 where there is none
    sigma: np.ndarray  # float32 metres, standard deviation of the depth; 0 where there is none
    nearest: np.ndarray  # int32, number of the point that is nearest to the centre; −1 where the pixel has no depth


@wp.func
def _one_surface(there: wp.vec2, reference: wp.vec2, apart: float, focal: float) -> bool:
    """Return whether a surface of at most STEEPEST leads from one depth and its standard deviation to another, `apart` pixels away."""
    gentle = STEEPEST * wp.min(there[0], reference[0]) / focal * apart
    return wp.abs(there[0] - reference[0]) <= gentle + STEP_SIGMAS * wp.max(there[1], reference[1])


@wp.func
def _terms(off: wp.vec2) -> wp.vec4:
    """Return the terms of the fit at a place, pixels from the centre."""
    return wp.vec4(1.0, off[0] / WIDTH, off[1] / WIDTH, wp.length_sq(off) / (WIDTH * WIDTH))


@wp.func
def _weight(off: wp.vec2, surer: float) -> float:
    """Return the weight of a point at a place with a standard deviation that is so many times smaller than that of the nearest."""
    return wp.exp(-0.5 * wp.length_sq(off) / (WIDTH * WIDTH)) * wp.clamp(surer * surer, 1.0 / MOST_SURER, MOST_SURER)


@wp.func
def _redescending(residual: float, scale: float) -> float:
    """Return the part of its weight that a point with a residual keeps."""
    part = scale * scale / (scale * scale + residual * residual)
    return part * part


@wp.kernel(enable_backward=False)
def _resample_kernel(first: int, rows: int, cols: int, focal: float, start: wp.array(dtype=int), at: wp.array(dtype=wp.vec2),
                     measured: wp.array(dtype=wp.vec2),
                     # outputs
                     depth: wp.array(dtype=float), sigma: wp.array(dtype=float), nearest: wp.array(dtype=int)):
    i = first + wp.tid()
    row = i // cols
    col = i - row * cols
    centre = wp.vec2(float(col) + 0.5, float(row) + 0.5)
    top = wp.max(row - REACH, 0)
    bottom = wp.min(row + REACH, rows - 1)
    left = wp.max(col - REACH, 0)
    right = wp.min(col + REACH, cols - 1)
    closest = wp.int32(-1)
    least = float(NEAREST * NEAREST)
    for r in range(top, bottom + 1):
        for k in range(start[r * cols + left], start[r * cols + right + 1]):
            apart = wp.length_sq(at[k] - centre)
            if apart < least:
                least = apart
                closest = k
    if closest >= 0:
        reference = measured[closest]
        inverse = 1.0 / reference[0]
        own = reference[1] * inverse * inverse
        fit = wp.vec4()
        misfit = float(0.0)
        variance = float(-1.0)
        scale = float(0.0)
        for attempt in range(ROUNDS):
            # moments of the weights, of the values, and of the variance of the values
            sums = wp.mat44()
            spreads = wp.mat44()
            values = wp.vec4()
            for r in range(top, bottom + 1):
                for k in range(start[r * cols + left], start[r * cols + right + 1]):
                    there = measured[k]
                    if _one_surface(there, reference, wp.length(at[k] - at[closest]), focal):
                        place = _terms(at[k] - centre)
                        deviation = there[1] / (there[0] * there[0])
                        value = 1.0 / there[0] - inverse
                        w = _weight(at[k] - centre, own / deviation)
                        if attempt > 0:
                            w *= _redescending((value - wp.dot(fit, place)) / deviation, scale)
                        products = wp.outer(place, place)
                        sums += w * products
                        spreads += (w * w * deviation * deviation) * products
                        values += (w * value) * place
            variance = float(-1.0)
            if wp.determinant(sums) <= LEAST_SPREAD * wp.pow(sums[0, 0], 4.0):
                break
            solution = wp.inverse(sums)
            weights = solution[0]
            fit = solution * values
            variance = wp.dot(weights, spreads * weights)
            total = float(0.0)
            doubled = float(0.0)
            squares = float(0.0)
            for r in range(top, bottom + 1):
                for k in range(start[r * cols + left], start[r * cols + right + 1]):
                    there = measured[k]
                    if _one_surface(there, reference, wp.length(at[k] - at[closest]), focal):
                        deviation = there[1] / (there[0] * there[0])
                        residual = (1.0 / there[0] - inverse - wp.dot(fit, _terms(at[k] - centre))) / deviation
                        w = _weight(at[k] - centre, 1.0)
                        if attempt > 0:
                            w *= _redescending(residual, scale)
                        total += w
                        doubled += w * w
                        squares += w * residual * residual
            free = wp.max(1.0 - 4.0 * doubled / (total * total), LEAST_FREE)
            misfit = wp.sqrt(squares / (total * free))
            if misfit <= EXPLAINED:
                break
            scale = wp.max(REDESCENDING, 0.5 * misfit)
        if variance >= 0.0 and variance <= own * own:
            found = inverse + fit[0]
            unexplained = own * wp.sqrt(wp.max(misfit * misfit - EXPLAINED * EXPLAINED, 0.0))
            if found > 0.0 and unexplained <= MOST_LEFT * found / focal:  # a pixel is depth / focal wide
                depth[i] = 1.0 / found
                sigma[i] = wp.sqrt(variance + unexplained * unexplained) / (found * found)
                nearest[i] = closest


def resample(places: np.ndarray, depths: np.ndarray, sigmas: np.ndarray, shape: tuple[int, int], focal: float, *, device: str) -> Resampled:
    """Return the range image of points that a perspective camera without distortion saw; waits for the device.
    `places`: [n, 2] u and v of the points in pixels, from the top-left corner of the image; those outside of it do not count. `depths,
    sigmas`: [n] metres, above 0; the errors of points are independent. `focal`: in pixels."""
    rows, cols = shape
    col, row = np.floor(places).astype(np.int64).T
    inside = np.flatnonzero((col >= 0) & (col < cols) & (row >= 0) & (row < rows))
    pixel = (row * cols + col)[inside]
    order = inside[np.argsort(pixel, kind="stable")]
    start = np.zeros(rows * cols + 1, dtype=np.int32)
    start[1:] = np.cumsum(np.bincount(pixel, minlength=rows * cols))
    measured = np.stack([depths, sigmas], axis=1)

    def uploaded(values: np.ndarray) -> Any:
        return wp.array(values[order].astype(np.float32), dtype=wp.vec2, device=device)

    depth, sigma = (wp.zeros(rows * cols, dtype=float, device=device) for _ in range(2))
    nearest: Any = wp.full(rows * cols, -1, dtype=int, device=device)
    devices.launch(_resample_kernel, rows * cols, [rows, cols, focal, wp.array(start, dtype=int, device=device), uploaded(places),
                                                   uploaded(measured)], [depth, sigma, nearest], device=device)
    found = to_numpy(nearest)
    known = found >= 0
    return Resampled(to_numpy(depth).reshape(shape), to_numpy(sigma).reshape(shape),
                     np.where(known, order[np.where(known, found, 0)], -1).astype(np.int32).reshape(shape))
