"""A range image from points at any image coordinates: at the centre of each pixel, the depth of the surface that the nearest point lies on.

Along the lines of sight of a perspective camera the inverse depth of a plane is linear in the image. Each pixel takes the value at its
centre of the function that fits the points around it (moving least squares), by weights that fall with the distance, and of the points
only those that lie on one surface with the nearest. The function is linear but for one term, the squared distance from the centre:
without it the pixels would lie inside of each bent surface, as means do. The variance follows from the same weights; where it is larger
than that of the nearest point, as beside the edge of the points, the pixel has no depth.

Source: Levin, "The approximation power of moving least-squares", Mathematics of Computation 67, 1998 (equations 1.1 to 1.5).
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices

REACH = 2
"""Pixels to each side of a pixel whose points are looked at."""
NEAREST = 1.25
"""Farthest that the nearest point may lie from the centre of a pixel, pixels."""
WIDTH = 0.8
"""Standard deviation of the Gaussian function by which points count, pixels."""
STEEPEST = float(np.tan(np.radians(70.0)))
"""Largest slope of a surface against the line of sight: what is steeper may be an edge beside what lies behind it."""
STEP_SIGMAS = float(4.0 * np.sqrt(2.0))
"""Difference of two depths, in standard deviations of one, that noise explains."""
LEAST_SPREAD = 1.0e-3
"""Least determinant of the moments of the points, of which points all around have 4: below it they lie in a line or on a ring."""


class Resampled(NamedTuple):
    """What the pixels show, each [rows, cols]."""

    depth: np.ndarray  # float32 metres; 0 where there is none
    sigma: np.ndarray  # float32 metres, standard deviation of the depth; 0 where there is none
    nearest: np.ndarray  # int32, number of the point that is nearest to the centre; −1 where the pixel has no depth


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
        # moments of the weights, of the values, and of the variance of the values
        sums = wp.mat44()
        spreads = wp.mat44()
        values = wp.vec4()
        for r in range(top, bottom + 1):
            for k in range(start[r * cols + left], start[r * cols + right + 1]):
                there = measured[k]
                off = at[k] - centre
                gentle = STEEPEST * wp.min(there[0], reference[0]) / focal * wp.length(at[k] - at[closest])
                if wp.abs(there[0] - reference[0]) <= gentle + STEP_SIGMAS * wp.max(there[1], reference[1]):
                    deviation = there[1] / (there[0] * there[0])
                    w = wp.exp(-0.5 * wp.length_sq(off) / (WIDTH * WIDTH)) * wp.pow(reference[1] / there[1], 2.0)
                    place = wp.vec4(1.0, off[0] / WIDTH, off[1] / WIDTH, wp.length_sq(off) / (WIDTH * WIDTH))
                    products = wp.outer(place, place)
                    sums += w * products
                    spreads += (w * w * deviation * deviation) * products
                    values += (w * (1.0 / there[0] - inverse)) * place
        if wp.determinant(sums) > LEAST_SPREAD * wp.pow(sums[0, 0], 4.0):
            weights = wp.inverse(sums)[0]
            variance = wp.dot(weights, spreads * weights)
            own = reference[1] * inverse * inverse
            found = inverse + wp.dot(weights, values)
            if variance <= own * own and found > 0.0:
                depth[i] = 1.0 / found
                sigma[i] = wp.sqrt(variance) / (found * found)
                nearest[i] = closest


def resample(places: np.ndarray, depths: np.ndarray, sigmas: np.ndarray, shape: tuple[int, int], focal: float, *, device: str) -> Resampled:
    """Return the range image of points that a perspective camera without distortion saw.

    Args:
        places: [n, 2] u and v of the points in pixels, from the top-left corner of the image; those outside of it do not count.
        depths: [n] metres, above 0.
        sigmas: [n] metres, standard deviations of the depths, above 0; the errors of points are independent.
        shape: rows and columns of the image.
        focal: of the camera, pixels.
        device: where to compute.

    Convention:
        Waits for the device.
    """
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
    found = nearest.numpy()
    known = found >= 0
    return Resampled(depth.numpy().reshape(shape), sigma.numpy().reshape(shape),
                     np.where(known, order[np.where(known, found, 0)], -1).astype(np.int32).reshape(shape))
