"""Normals to the slope between each pixel and its right and lower neighbour, and how far that slope can be trusted.

The chord between the surface points of two neighbours i, j is taken perpendicular to m = n_i + n_j: exact on a
sphere, second order elsewhere. With r = (x, y, -1) along the line of sight and Δ = r_j − r_i:

    orthographic   z_j − z_i         = −Δ·m / m_z
    perspective    log d_j − log d_i = −log(1 + Δ·m / r_i·m)                  (p = d·r)

The weight is the squared cosine between the mean normal and the line of sight, (m_z/2)² or (r_i·m/2)(r_j·m/2): what
is made small is then the distance of each neighbour from the tangent plane, (m/2)·(p_j − p_i), in units of the
pixel's footprint. Its product with the slope is polynomial in the normals, so noise of the normals averages out. The
inverse variance of the slope, (m_z⁴/(m_x² + m_z²)), was tried and is worse: a pair that noise made steeper weighs
less, which flattens everything into a bowl (2 to 5 times the error on a hemisphere with 0.05 to 0.15 rad of noise),
and it makes the problem anisotropic at a rim, where multigrid takes 60 iterations in place of 7. Across a crease m is
short and so is the weight. s, the distance between pixels in the plane of x and y, is the unit of the unknown
heights, so that both projections give numbers of the order of pixels.

A pair steeper than STEEPEST (or facing away, which no visible surface does) keeps the slope of STEEPEST at the
smallest weight: dropping it would cut stray pixels off and send them to the mean height as spikes.

Sources: Quéau, Durou & Aujol, "Normal Integration: A Survey", 2018, for log-depth under perspective; Cao et al.,
"Bilateral Normal Integration", ECCV 2022, for residuals weighted by the cosine.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.surface.grid import EdgeWeights, Grid
from kernels.surface.normal_map import NormalMap

STEEPEST = 0.02
"""Cosine of the steepest usable tilt, 88.9°: that of the rim of a sphere of 2500 pixels radius, which normals do not resolve."""

_FLOOR = wp.constant(wp.float32(STEEPEST))
_LEAST = wp.constant(wp.float32(STEEPEST**2))


class Slopes(NamedTuple):
    """Slope of each edge of a grid, at the cell of its left or upper pixel, and its weight."""

    right: wp.array  # [size] float32, height difference in units of s
    down: wp.array
    weights: EdgeWeights


@wp.func
def orthographic_slope(m: wp.vec3, ri: wp.vec3, rj: wp.vec3, spacing: float):
    """Return (slope of z, weight) of one pair, in units of the spacing."""
    lean = wp.dot(rj - ri, m)
    facing = wp.max(m[2], _FLOOR * wp.length(m))
    slope = wp.float32(0.0)
    if facing > 0.0:
        slope = -lean / (facing * spacing)
    return wp.vec2(slope, wp.max(_LEAST, 0.25 * facing * facing))


@wp.func
def perspective_slope(m: wp.vec3, ri: wp.vec3, rj: wp.vec3, spacing: float):
    """Return (slope of −log d, weight) of one pair, in units of the spacing: it grows towards the viewer, as z does."""
    lean = wp.dot(rj - ri, m)
    floor = _FLOOR * wp.length(m) * wp.length(ri)
    facing = -wp.dot(ri, m)
    facing_next = facing - lean
    slope = wp.float32(0.0)
    weight = _LEAST
    if facing > floor and facing_next > floor:
        # in double: adding the small step to 1 would round it off, and the error would add up over a row
        slope = -wp.float32(wp.log(wp.float64(1.0) + wp.float64(lean) / wp.float64(facing_next))) / spacing
        weight = wp.max(_LEAST, 0.25 * facing * facing_next)
    elif floor > 0.0:
        slope = -lean / (floor * spacing)
    return wp.vec2(slope, weight)


@wp.func
def _normal_at(normal: wp.array3d(dtype=wp.float32), r: int, c: int):
    return wp.normalize(wp.vec3(normal[0, r, c], normal[1, r, c], normal[2, r, c]))


@once
def _edge_kernel(perspective: bool) -> Any:
    """Return the kernel over all edges for one projection."""
    pair = perspective_slope if perspective else orthographic_slope

    @wp.func
    def edge_to(normal: wp.array3d(dtype=wp.float32), usable: wp.array2d(dtype=wp.uint8), x: wp.array2d(dtype=wp.float32),
                y: wp.array2d(dtype=wp.float32), trust: wp.array2d(dtype=wp.float32), n: wp.vec3, ri: wp.vec3, own: float,
                r: int, c: int, spacing: float):
        """Return (slope, weight) of the edge from a pixel of normal n and trust `own` on the ray ri to pixel (r, c), zeros where that is
        not usable."""
        edge = wp.vec2()
        # nested, because a kernel evaluates both sides of `and`
        if r < usable.shape[0] and c < usable.shape[1]:  # noqa: SIM102
            if usable[r, c] != wp.uint8(0):
                edge = pair(n + _normal_at(normal, r, c), ri, wp.vec3(x[r, c], y[r, c], -1.0), spacing)
                edge[1] *= 2.0 / (1.0 / own + 1.0 / trust[r, c])
        return edge

    @wp.kernel(enable_backward=False, module="unique")
    def edge_kernel(first: int,
                    row: int,
                    normal: wp.array3d(dtype=wp.float32),
                    usable: wp.array2d(dtype=wp.uint8),
                    x: wp.array2d(dtype=wp.float32),
                    y: wp.array2d(dtype=wp.float32),
                    trust: wp.array2d(dtype=wp.float32),
                    spacing: float,
                    # outputs
                    right: wp.array(dtype=wp.float32),
                    down: wp.array(dtype=wp.float32),
                    weights: EdgeWeights):
        p = first + wp.tid()
        r = p // usable.shape[1]
        c = p - r * usable.shape[1]
        if usable[r, c] == wp.uint8(0):
            return
        i = (row + r + 1) * weights.pitch + c + 1
        n, ri = _normal_at(normal, r, c), wp.vec3(x[r, c], y[r, c], -1.0)
        edge = edge_to(normal, usable, x, y, trust, n, ri, trust[r, c], r, c + 1, spacing)
        right[i] = edge[0]
        weights.right[i] = edge[1]
        edge = edge_to(normal, usable, x, y, trust, n, ri, trust[r, c], r + 1, c, spacing)
        down[i] = edge[0]
        weights.down[i] = edge[1]

    return edge_kernel


@wp.kernel
def _turn(first: int,
          row: int,
          normal: wp.array3d(dtype=wp.float32),
          usable: wp.array2d(dtype=wp.uint8),
          pitch: int,
          # outputs
          right: wp.array(dtype=wp.float16),
          down: wp.array(dtype=wp.float16)):
    p = first + wp.tid()
    r = p // usable.shape[1]
    c = p - r * usable.shape[1]
    if usable[r, c] == wp.uint8(0):
        return
    i = (row + r + 1) * pitch + c + 1
    n = _normal_at(normal, r, c)
    # nested, because a kernel evaluates both sides of `and`
    if c + 1 < usable.shape[1]:  # noqa: SIM102
        if usable[r, c + 1] != wp.uint8(0):
            right[i] = wp.float16(wp.acos(wp.clamp(wp.dot(n, _normal_at(normal, r, c + 1)), -1.0, 1.0)))
    if r + 1 < usable.shape[0]:  # noqa: SIM102
        if usable[r + 1, c] != wp.uint8(0):
            down[i] = wp.float16(wp.acos(wp.clamp(wp.dot(n, _normal_at(normal, r + 1, c)), -1.0, 1.0)))


def pair_slopes(surface: NormalMap, *, grid: Grid, spacing: float) -> tuple[Slopes, np.ndarray]:
    """Return the slopes and weights of every pair of 4-neighbours that are both usable.

    The weight of a pair is the harmonic mean of the trust in its pixels, times the cosines.
    `spacing`: mean distance of neighbouring pixels in the plane of x and y. Returns Slopes in units of the spacing, growing towards the
    viewer: of z (orthographic) or of −log d (perspective); and which pixels are usable, [rows, cols] bool on the host: in the mask, with a
    finite normal of some length."""
    slopes = Slopes(grid.zeros(), grid.zeros(), grid.no_edges())
    usable = np.empty((grid.rows, grid.cols), dtype=bool)
    for band in surface.bands():
        inputs = [band.first, band.normal, band.usable, band.x, band.y, band.trust, spacing]
        devices.launch(_edge_kernel(surface.perspective), band.rows * grid.cols, inputs, list(slopes), device=grid.device)
        usable[band.first : band.first + band.rows] = to_numpy(band.usable)[: band.rows]
    return slopes, usable


def pair_turns(surface: NormalMap, *, grid: Grid) -> tuple[wp.array, wp.array]:
    """Return the angles, radians, between the normals of each pixel and its right and lower neighbour, each [size] float16; 0 where one of
    the two is not usable."""
    turns = grid.zeros(wp.float16), grid.zeros(wp.float16)
    for band in surface.bands():
        devices.launch(_turn, band.rows * grid.cols, [band.first, band.normal, band.usable, grid.pitch], list(turns), device=grid.device)
    return turns
