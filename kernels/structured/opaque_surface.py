"""Test whether decoded depths can be those of opaque surfaces under a projector: tests of each pixel against its neighbours and the others.

Facing. The inverse depth of a plane is linear in the image: s = α x + β y + γ along the line of sight (x, y, -1). The projector at C lies
on the camera's side of it where E = α C_x + β C_y - γ C_z < 1. A patch with E > 1 shows the camera one face and the projector the other, so
it is no surface that the projector lights: order is reversed there, as in the image of a curved mirror. α and β are tried from the
neighbours on either side, so that one side of an edge of depth is enough to acquit a pixel.

Steepness. A depth that no neighbour of its row (or of its column) can be reached from on a slope of 80 degrees, though there are
neighbours, stands alone: a mixture of two surfaces, or an image in a mirror that makes it small.

One surface to a ray. Light of a projector pixel ends at the first surface. Points are binned by their direction from the projector; where
all the bins around a point hold points clearly nearer to the projector, or all hold points clearly farther, the point is a reflection of
them or they are of it. (A surface along the light is nearer on one side and farther on the other.)

Texture. Light that is brighter on one side of a pixel's square shows a coordinate beside its centre; the deviation grows by that shift.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices

CERTAIN_SIGMAS = 4.0
"""Deviations by which E must lie above one on every choice of neighbours, and a depth beyond the steepest slope."""
STEEPEST = 5.67
"""Tangent of 80 degrees, the steepest slope of one surface between two pixels."""
RANGE_PART = 0.05
"""Least relative difference between the distances, from the projector, of points that cannot both be lit in one bin: within a bin of a few
pixels, a surface at 80 degrees differs by less."""
RANGE_SIGMAS = 6.0
"""The same in standard deviations of the point's depth."""
BIN_PIXELS = 6.0
"""Number of camera pixels that a bin holds on average, so that a surface leaves no bin empty."""
SAMPLE = 20_000
"""Number of points from which the extent of all directions is taken."""
LEAST_BINS = 8
"""Least number of bins along a side."""
SHIFT_PART = 0.125
"""Largest shift of the light's middle from a pixel's centre, pixels, where one half is bright and the other dark."""
EMPTY = 1.0e30
"""Sentinel distance of an empty bin."""


class Agreement(NamedTuple):
    """The findings of the tests, on the device."""

    turned: wp.array  # [pixels] uint8: 1 where the projector would see the back of the surface
    alone: wp.array  # [pixels] uint8: 1 where no neighbour of the row, or none of the column, can belong to its surface
    contradicted: wp.array  # [pixels] uint8: 1 where other points are lit by the same light at other distances
    deviation: wp.array  # [pixels] float32 metres: of the depth, from texture within the pixel


def check_surface(depth: np.ndarray, sigma: np.ndarray, amplitude: np.ndarray, solved: np.ndarray, x: np.ndarray, y: np.ndarray,
                  projector_from_camera: np.ndarray, *, device: str) -> Agreement:
    """Test decoded depths against each other; pixels that are not solved have 0. Not synchronised on CUDA.

    Args:
        depth: [rows, cols] metres.
        sigma: [rows, cols] its standard deviation.
        amplitude: [rows, cols] of the pattern.
        solved: [rows, cols] bool, which of them count.
        x, y: [rows, cols] lines of sight (x, y, -1) of the camera frame, x right, y up.
        projector_from_camera: [3, 4], x right, y down, z forward of the projector.
    """
    rows, cols = depth.shape
    flat = [wp.array(np.ascontiguousarray(values, np.float32).reshape(-1), dtype=wp.float32, device=device)
            for values in (depth, sigma, amplitude, x, y)]
    known = wp.array(np.ascontiguousarray(solved).reshape(-1).astype(np.uint8), dtype=wp.uint8, device=device)
    turn, shift = projector_from_camera[:, :3], projector_from_camera[:, 3]
    centre = -turn.T @ shift
    pixels = rows * cols
    binned = _bins(depth, solved, x, y, turn, shift)
    bins, distance, near, far = (wp.array(values, dtype=dtype, device=device)
                                 for values, dtype in zip(binned[:4], (wp.int32, *[wp.float32] * 3), strict=True))
    columns, lines = binned[4:]
    found = Agreement(*(wp.zeros(pixels, dtype=dtype, device=device) for dtype in (wp.uint8, wp.uint8, wp.uint8, wp.float32)))
    devices.launch(_agree_kernel, pixels, [*flat, known, bins, distance, near, far, wp.vec3(*centre.tolist()), rows, cols, columns, lines],
                   list(found), device=device, uneven=True)
    return found


def _bins(depth: np.ndarray, solved: np.ndarray, x: np.ndarray, y: np.ndarray, turn: np.ndarray,
          shift: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int, int]:
    """Return the bin of each pixel's direction from the projector (-1: none), its distance, the least and greatest distance in each bin,
    and how many bins there are across and down."""
    bins, distance = np.full(depth.size, -1, np.int32), np.zeros(depth.size, np.float32)
    kept = np.flatnonzero(solved)
    z = depth.ravel()[kept].astype(np.float32)
    points = np.stack([x.ravel()[kept] * z, y.ravel()[kept] * z, -z]).astype(np.float32)
    own = turn.astype(np.float32) @ points + shift.astype(np.float32)[:, None]
    ahead = own[2] > 0
    kept, own = kept[ahead], own[:, ahead]
    if not len(kept):
        return bins, distance, np.full(1, EMPTY, np.float32), np.zeros(1, np.float32), 1, 1
    tangent = own[:2] / own[2]
    low, high = np.percentile(tangent[:, ::max(1, len(kept) // SAMPLE)], [0.5, 99.5], axis=1)
    span = np.maximum(high - low, 1e-6)
    side = np.sqrt(span.prod() * BIN_PIXELS / len(kept))
    columns, lines = (int(n) for n in np.maximum(np.ceil(span / side), LEAST_BINS))
    place = np.floor((tangent - low[:, None]) * (np.array([columns, lines]) / span)[:, None]).astype(np.int32)
    inside = (place >= 0).all(axis=0) & (place[0] < columns) & (place[1] < lines)
    kept, cell = kept[inside], place[1, inside] * columns + place[0, inside]
    bins[kept] = cell
    distance[kept] = np.sqrt((own[:, inside]**2).sum(axis=0))
    near, far = np.full(columns * lines, EMPTY, np.float32), np.zeros(columns * lines, np.float32)
    np.minimum.at(near, cell, distance[kept])
    np.maximum.at(far, cell, distance[kept])
    return bins, distance, near, far, columns, lines


@wp.func
def slope_to(inverse: float, depth: wp.array(dtype=float), sigma: wp.array(dtype=float), known: wp.array(dtype=wp.uint8), there: int,
             inside: bool, step: float) -> wp.vec3:
    """Return the slope of the inverse depth towards a neighbour, the variance that the neighbour adds, and 1; zeros without one."""
    result = wp.vec3()
    if inside and step != 0.0:  # noqa: SIM102 - Warp evaluates both sides of "and"
        if int(known[there]) == 1:
            other = 1.0 / depth[there]
            noise = sigma[there] * other * other / step
            result = wp.vec3((other - inverse) / step, noise * noise, 1.0)
    return result


@wp.func
def reached(z: float, noise: float, depth: wp.array(dtype=float), sigma: wp.array(dtype=float), known: wp.array(dtype=wp.uint8), there: int,
            inside: bool, step: float) -> int:
    """Return 1 where a neighbour can lie on the same surface, -1 where it cannot, 0 where there is none."""
    found = int(0)  # noqa: RUF046 - declares a variable that a branch may change
    if inside:  # noqa: SIM102 - Warp evaluates both sides of "and"
        if int(known[there]) == 1:
            other = depth[there]
            spread = wp.sqrt(noise * noise + sigma[there] * sigma[there])
            near = wp.abs(other - z) <= wp.static(STEEPEST) * wp.min(z, other) * wp.abs(step) + wp.static(CERTAIN_SIGMAS) * spread
            found = wp.where(near, 1, -1)
    return found


@wp.kernel(enable_backward=False, module="unique")
def _agree_kernel(first: int,
                  depth: wp.array(dtype=float),  # [pixels]
                  sigma: wp.array(dtype=float),  # [pixels]
                  amplitude: wp.array(dtype=float),  # [pixels]
                  x: wp.array(dtype=float),  # [pixels]
                  y: wp.array(dtype=float),  # [pixels]
                  known: wp.array(dtype=wp.uint8),  # [pixels]
                  bins: wp.array(dtype=int),  # [pixels]
                  distance: wp.array(dtype=float),  # [pixels]
                  near: wp.array(dtype=float),  # [bins]
                  far: wp.array(dtype=float),  # [bins]
                  centre: wp.vec3,  # of the projector
                  rows: int,
                  cols: int,
                  columns: int,
                  lines: int,
                  # outputs
                  turned: wp.array(dtype=wp.uint8),
                  alone: wp.array(dtype=wp.uint8),
                  contradicted: wp.array(dtype=wp.uint8),
                  deviation: wp.array(dtype=float)):
    p = first + wp.tid()
    if int(known[p]) == 0:
        return
    row, col = p / cols, p % cols
    s = 1.0 / depth[p]
    own_noise = sigma[p] * s * s
    across, up = centre[0] + x[p] * centre[2], centre[1] + y[p] * centre[2]
    level = wp.abs(across) >= wp.abs(up)  # the baseline: along rows or along columns
    left_in, right_in, above_in, below_in = col > 0, col + 1 < cols, row > 0, row + 1 < rows
    last = rows * cols - 1
    before = reached(depth[p], sigma[p], depth, sigma, known, p - 1, left_in, x[wp.max(p - 1, 0)] - x[p])
    after = reached(depth[p], sigma[p], depth, sigma, known, p + 1, right_in, x[wp.min(p + 1, last)] - x[p])
    over_it = reached(depth[p], sigma[p], depth, sigma, known, p - cols, above_in, y[wp.max(p - cols, 0)] - y[p])
    under = reached(depth[p], sigma[p], depth, sigma, known, p + cols, below_in, y[wp.min(p + cols, last)] - y[p])
    if wp.max(before, after) < 1 and before + after < 0:
        alone[p] = wp.uint8(1)
    if wp.max(over_it, under) < 1 and over_it + under < 0:
        alone[p] = wp.uint8(1)
    left = slope_to(s, depth, sigma, known, p - 1, left_in, x[wp.max(p - 1, 0)] - x[p])
    right = slope_to(s, depth, sigma, known, p + 1, right_in, x[wp.min(p + 1, last)] - x[p])
    above = slope_to(s, depth, sigma, known, p - cols, above_in, y[wp.max(p - cols, 0)] - y[p])
    below = slope_to(s, depth, sigma, known, p + cols, below_in, y[wp.min(p + cols, last)] - y[p])
    one, two, three, four, lever, other_lever = left, right, above, below, across, up
    step, brightness, shade = float(0.0), float(0.0), float(0.0)
    if level:
        if left_in and right_in:
            step = 0.5 * wp.abs(x[wp.min(p + 1, last)] - x[wp.max(p - 1, 0)])
            brightness = amplitude[p - 1] + amplitude[p + 1]
            shade = wp.abs(amplitude[p - 1] - amplitude[p + 1])
    else:
        one, two, three, four, lever, other_lever = above, below, left, right, up, across
        if above_in and below_in:
            step = 0.5 * wp.abs(y[wp.max(p - cols, 0)] - y[wp.min(p + cols, last)])
            brightness = amplitude[p - cols] + amplitude[p + cols]
            shade = wp.abs(amplitude[p - cols] - amplitude[p + cols])
    if one[2] == 0.0 or two[2] == 0.0:
        return

    # the surface on every choice of neighbours
    least = float(EMPTY)
    for choice in range(4):
        along = wp.where(choice % 2 == 0, one, two)
        beside = wp.where(choice / 2 == 0, three, four)
        e = along[0] * lever + beside[0] * other_lever - s * centre[2]
        spread = along[1] * lever * lever + beside[1] * other_lever * other_lever
        own = own_noise * (wp.abs(lever) + beside[2] * wp.abs(other_lever)) / wp.max(step, 1.0e-9)
        least = wp.min(least, e - CERTAIN_SIGMAS * wp.sqrt(spread + own * own))
    if least > 1.0 and wp.abs(lever) > 0.0:
        turned[p] = wp.uint8(1)

    # by how much the inverse depth is off if the light's middle is not the pixel's
    if brightness > 0.0:
        still = (1.0 + s * centre[2]) / lever
        slope = 0.5 * (one[0] + two[0])
        shift = SHIFT_PART * wp.min(shade / brightness, 1.0)
        deviation[p] = depth[p] * depth[p] * wp.abs(still - slope) * step * shift

    # other points on the same rays of the projector
    if bins[p] >= 0:
        cell_line, cell_column = bins[p] / columns, bins[p] % columns
        margin = wp.max(RANGE_PART * distance[p], RANGE_SIGMAS * sigma[p])
        all_nearer, all_farther = bool(True), bool(True)
        for down in range(-1, 2):
            for over in range(-1, 2):
                line, column = cell_line + down, cell_column + over
                if line >= 0 and column >= 0 and line < lines and column < columns:
                    cell = line * columns + column
                    all_nearer = all_nearer and near[cell] < distance[p] - margin
                    all_farther = all_farther and far[cell] > distance[p] + margin
                else:
                    all_nearer, all_farther = bool(False), bool(False)
        if all_nearer or all_farther:
            contradicted[p] = wp.uint8(1)
