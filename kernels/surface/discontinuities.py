"""Edge weights that let a surface break: bilateral normal integration, the reweighting between two solves.

A surface is taken to be continuous on one side of every pixel at least, along rows and along columns. Each pixel shares
its trust between its two edges by how badly the present heights fit them: the worse edge loses. An edge that both of its
pixels distrust carries nothing, and the surface breaks there.

Source: Cao, Santo, Shi, Okura & Matsushita, "Bilateral Normal Integration", ECCV 2022, eq. 15–18. Here the misfit of an
edge is its residual (h_j − h_i − g, in units of its own standard deviation's direction), where the paper takes the
height difference alone: a steep but continuous slope then takes no side.
"""

import warp as wp

from kernels.surface.grid import Grid, Summer, Walk, cell_of, run
from kernels.surface.slopes import Slopes

wp.set_module_options({"enable_backward": False})

LEAST_TRUST = 1.0e-5
"""What is left of an edge that both pixels distrust, so that no part of the surface floats."""

_TRUST = wp.constant(wp.float32(LEAST_TRUST))


@wp.func
def _misfit(
    g: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    w: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    h: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    i: int,
    step: int,
):
    """Weighted squared residual of the edge from i to i + step; 0 where there is none."""
    e = wp.float32(0.0)
    if w[i] > 0.0:
        d = h[i + step] - h[i] - g[i]
        e = w[i] * d * d
    return e


@wp.func
def _share(sharpness: float, here: float, other: float):
    """How much of a pixel's trust goes to the edge of misfit `here`, 0…1."""
    return 1.0 / (1.0 + wp.exp(wp.min(sharpness * (here - other), 80.0)))


@wp.kernel
def _reweigh(
    first: int,
    walk: Walk,
    gx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    gy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    base_x: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    base_y: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    h: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    sharpness: float,
    pitch: int,
    # outputs
    wx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    wy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    partial: wp.array(dtype=wp.float64),  # type: ignore[valid-type]
):
    """New weights, and each thread's part of the misfit under them."""
    t = first + wp.tid()
    total = wp.float64(0.0)
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            here = _misfit(gx, base_x, h, i, 1)
            trust = _share(sharpness, here, _misfit(gx, base_x, h, i - 1, 1))
            trust += _share(sharpness, here, _misfit(gx, base_x, h, i + 1, 1))
            trust = wp.max(trust, _TRUST)
            wx[i] = base_x[i] * trust
            total += wp.float64(trust * here)
            here = _misfit(gy, base_y, h, i, pitch)
            trust = _share(sharpness, here, _misfit(gy, base_y, h, i - pitch, pitch))
            trust += _share(sharpness, here, _misfit(gy, base_y, h, i + pitch, pitch))
            trust = wp.max(trust, _TRUST)
            wy[i] = base_y[i] * trust
            total += wp.float64(trust * here)
    partial[t] = total


def reweigh(
    base: Slopes,
    h: wp.array,  # [size] float32, present heights
    *,
    sharpness: float,
    grid: Grid,
    summer: Summer,
    right_weight: wp.array,  # outputs, [size] float32
    down_weight: wp.array,
    total: wp.array,  # [1] float64, the misfit under the new weights
) -> None:
    """Write the weights for the next solve from the misfit of the present heights. Nothing is read back."""
    inputs = [*base, h, sharpness, grid.pitch]
    run(_reweigh, grid.sums, inputs, [right_weight, down_weight, summer.partial], device=grid.device)
    summer.finish(total, 0)


@wp.func
def _cell_curl(
    gx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    gy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    wx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    wy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    i: int,
    pitch: int,
):
    """Weighted squared sum of the slopes around the four pixels right of and below i; −1 where one of them is missing."""
    least = wp.min(wp.min(wx[i], wx[i + pitch]), wp.min(wy[i], wy[i + 1]))
    c = gx[i] + gy[i + 1] - gx[i + pitch] - gy[i]
    e = wp.float32(-1.0)
    if least > 0.0:
        e = least * c * c
    return e


@wp.func
def _loop_trust(a: float, b: float, scale: float):
    e = wp.min(a, b)
    if e < 0.0:
        e = wp.max(a, b)
    t = 1.0 + wp.max(e, 0.0) / (scale * scale)
    return wp.max(_TRUST, 1.0 / (t * t))


@wp.kernel
def _distrust_loops(
    first: int,
    walk: Walk,
    gx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    gy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    base_x: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    base_y: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    scale: float,
    pitch: int,
    # outputs
    wx: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
    wy: wp.array(dtype=wp.float32),  # type: ignore[valid-type]
):
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            here = _cell_curl(gx, gy, base_x, base_y, i, pitch)
            wx[i] = base_x[i] * _loop_trust(here, _cell_curl(gx, gy, base_x, base_y, i - pitch, pitch), scale)
            wy[i] = base_y[i] * _loop_trust(here, _cell_curl(gx, gy, base_x, base_y, i - 1, pitch), scale)


def distrust_loops(base, *, scale, grid, right_weight, down_weight):
    run(_distrust_loops, grid.cells, [*base, scale, grid.pitch], [right_weight, down_weight], device=grid.device)
