"""One multigrid V-cycle for a weighted graph Laplacian on a masked grid: the preconditioner of the height solver.

Levels halve by 2×2 cells. Two things keep the number of iterations independent of the size of the picture:

- Carrying a cell's value unchanged to its four pixels makes the coarse problem twice too stiff in two dimensions, so
  an edge between two cells has the mean, not the sum, of the two edges that cross (Braess 1995 corrects by a factor
  instead).
- A correction reaches a pixel as the weighted mean of the cells of its four neighbours (one Jacobi step on the
  carried values): (2a + b + c)/4 on a plain grid, exact on planes, and never drawn across a missing or weak edge
  (Kwak 1999, with the weights of the operator).

Smoothing is red-black Gauss-Seidel, red first on the way down and last on the way up. The restriction is the
transpose of the prolongation, so the cycle is symmetric and positive definite whatever the coarse weights are, as
conjugate gradients need. A pixel without edges gets 0.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.surface.grid import Grid, Walk, cell_of, make_grid, run

wp.set_module_options({"enable_backward": False})

COARSEST = 2
"""Levels stop at this many pixels a side, where smoothing alone solves."""
COARSEST_SWEEPS = 4
"""Smoothing passes there, each way."""


class Level(NamedTuple):
    """One grid of the hierarchy."""

    grid: Grid
    right_weight: wp.array  # [size] float32
    down_weight: wp.array
    target: wp.array  # [size] float32, right-hand side
    value: wp.array  # [size] float32, the level's answer
    scratch: wp.array


@wp.func
def edge_sum(
    value: wp.array(dtype=wp.float32),
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    i: int,
    pitch: int,
):
    """Return (sum of weights, weighted sum of the neighbours' values) of cell i."""
    left = wx[i - 1]
    right = wx[i]
    up = wy[i - pitch]
    down = wy[i]
    around = left * value[i - 1] + right * value[i + 1] + up * value[i - pitch] + down * value[i + pitch]
    return wp.vec2(left + right + up + down, around)


@wp.kernel
def _smooth_from_zero(
    first: int,
    walk: Walk,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    pitch: int,
    # outputs
    value: wp.array(dtype=wp.float32),
):
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            d = wx[i - 1] + wx[i] + wy[i - pitch] + wy[i]
            v = wp.float32(0.0)
            if d > 0.0:
                v = target[i] / d
            value[i] = v


@wp.kernel
def _smooth(
    first: int,
    walk: Walk,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    pitch: int,
    # outputs
    value: wp.array(dtype=wp.float32),
):
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            e = edge_sum(value, wx, wy, i, pitch)
            v = wp.float32(0.0)
            if e[0] > 0.0:
                v = (target[i] + e[1]) / e[0]
            value[i] = v


@wp.kernel
def _scaled_residual(
    first: int,
    walk: Walk,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    value: wp.array(dtype=wp.float32),
    pitch: int,
    # outputs
    scaled: wp.array(dtype=wp.float32),
):
    """Residual over diagonal."""
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            e = edge_sum(value, wx, wy, i, pitch)
            v = wp.float32(0.0)
            if e[0] > 0.0:
                v = (target[i] + e[1]) / e[0] - value[i]
            scaled[i] = v


@wp.kernel
def _restrict(
    first: int,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    scaled: wp.array(dtype=wp.float32),
    pitch: int,
    cols: int,
    coarse_pitch: int,
    # outputs
    target: wp.array(dtype=wp.float32),
):
    """The transpose of _prolong: a red pixel's residual goes to the cells of its neighbours. Black residuals are 0."""
    p = first + wp.tid()
    r = p // cols
    c = p - r * cols
    k = (2 * r + 1) * pitch + 2 * c + 1  # always even: the cell's black pixels are this one
    j = k + pitch + 1  # and the one diagonally below
    s = wx[k - 1] * scaled[k - 1] + wx[k] * scaled[k + 1]
    s += wy[k - pitch] * scaled[k - pitch] + wy[k] * scaled[k + pitch]
    s += wx[j - 1] * scaled[j - 1] + wx[j] * scaled[j + 1]
    s += wy[j - pitch] * scaled[j - pitch] + wy[j] * scaled[j + pitch]
    target[(r + 1) * coarse_pitch + c + 1] = s


@wp.kernel
def _prolong(
    first: int,
    walk: Walk,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    coarse: wp.array(dtype=wp.float32),
    pitch: int,
    coarse_pitch: int,
    # outputs
    value: wp.array(dtype=wp.float32),
):
    """Add the coarse correction at one colour; smoothing the other colour next replaces what it would get."""
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            left = wx[i - 1]
            right = wx[i]
            up = wy[i - pitch]
            down = wy[i]
            d = left + right + up + down
            if d > 0.0:
                r = i // pitch - 1
                c = i - (r + 1) * pitch - 1
                row = (r // 2 + 1) * coarse_pitch + 1
                col = c // 2
                above = row - coarse_pitch * (1 - r % 2)
                below = row + coarse_pitch * (r % 2)
                s = left * coarse[row + col - (1 - c % 2)] + right * coarse[row + col + c % 2]
                s += up * coarse[above + col] + down * coarse[below + col]
                value[i] = value[i] + s / d


@wp.kernel
def _coarsen(
    first: int,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    pitch: int,
    cols: int,
    coarse_pitch: int,
    # outputs
    coarse_wx: wp.array(dtype=wp.float32),
    coarse_wy: wp.array(dtype=wp.float32),
):
    p = first + wp.tid()
    r = p // cols
    c = p - r * cols
    i = (2 * r + 1) * pitch + 2 * c + 1
    k = (r + 1) * coarse_pitch + c + 1
    coarse_wx[k] = 0.5 * (wx[i + 1] + wx[i + 1 + pitch])
    coarse_wy[k] = 0.5 * (wy[i + pitch] + wy[i + pitch + 1])


class Multigrid:
    """The hierarchy over one pair of weight arrays.

    Args:
        grid: the finest layout.
        right_weight, down_weight: its edges.
        target: the finest right-hand side, read by `cycle`.
        value: where `cycle` leaves its answer.
        scratch: an array that `cycle` may overwrite.
    """

    def __init__(
        self,
        grid: Grid,
        right_weight: wp.array,  # [size] float32
        down_weight: wp.array,
        *,
        target: wp.array,
        value: wp.array,
        scratch: wp.array,
    ):
        self.levels = [Level(grid, right_weight, down_weight, target, value, scratch)]
        while max(grid.rows, grid.cols) > COARSEST:
            grid = make_grid(-(-grid.rows // 2), -(-grid.cols // 2), grid.device)
            self.levels.append(Level(grid, *(grid.zeros() for _ in range(5))))
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            g = coarse.grid
            inputs = [fine.right_weight, fine.down_weight, fine.grid.pitch, g.cols, g.pitch]
            outputs = [coarse.right_weight, coarse.down_weight]
            devices.launch(_coarsen, g.rows * g.cols, inputs, outputs, device=g.device)

    def cycle(self) -> None:
        """Set value = B·target, with B a symmetric positive definite approximation of the inverse."""
        for fine, coarse in zip(self.levels, self.levels[1:], strict=False):
            self._down(fine, coarse)
        self._coarsest()
        for fine, coarse in zip(self.levels[-2::-1], self.levels[:0:-1], strict=True):
            self._up(fine, coarse)

    def _smooth(self, level: Level, parity: int) -> None:
        inputs = [level.right_weight, level.down_weight, level.target, level.grid.pitch]
        run(_smooth, level.grid.colour(parity), inputs, [level.value], device=level.grid.device)

    def _start(self, level: Level) -> None:
        """Red (odd) cells from a guess of zero, then black."""
        inputs = [level.right_weight, level.down_weight, level.target, level.grid.pitch]
        run(_smooth_from_zero, level.grid.odd, inputs, [level.value], device=level.grid.device)
        self._smooth(level, 0)

    def _down(self, fine: Level, coarse: Level) -> None:
        self._start(fine)
        g, device = coarse.grid, coarse.grid.device
        weights = [fine.right_weight, fine.down_weight]
        inputs = [*weights, fine.target, fine.value, fine.grid.pitch]
        run(_scaled_residual, fine.grid.odd, inputs, [fine.scratch], device=device)
        inputs = [*weights, fine.scratch, fine.grid.pitch, g.cols, g.pitch]
        devices.launch(_restrict, g.rows * g.cols, inputs, [coarse.target], device=device)

    def _up(self, fine: Level, coarse: Level) -> None:
        inputs = [fine.right_weight, fine.down_weight, coarse.value, fine.grid.pitch, coarse.grid.pitch]
        run(_prolong, fine.grid.odd, inputs, [fine.value], device=fine.grid.device)
        self._smooth(fine, 0)
        self._smooth(fine, 1)

    def _coarsest(self) -> None:
        level = self.levels[-1]
        self._start(level)
        for _ in range(COARSEST_SWEEPS - 1):
            self._smooth(level, 1)
            self._smooth(level, 0)
        for _ in range(COARSEST_SWEEPS):
            self._smooth(level, 0)
            self._smooth(level, 1)
