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

import itertools
from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import Recorded
from kernels.surface.grid import EdgeWeights, Grid, Walk, end_cell, first_cell, make_grid, record

# as in conjugate
wp.set_module_options({"fuse_fp": False})

COARSEST = 2
"""Side, in pixels, of the coarsest level: smoothing alone solves it."""
BRIEF_CELLS = 8191
"""Number of coarse cells that are restricted faster on one core than it takes to start another."""
COARSEST_SWEEPS = 4
"""Number of smoothing passes on the coarsest level, in each direction."""


class Level(NamedTuple):
    """One grid of the hierarchy."""

    grid: Grid
    weights: EdgeWeights
    target: wp.array  # [size] float32, right-hand side
    value: wp.array  # [size] float32, the level's answer
    scratch: wp.array  # [size or more] float32, shared with the other levels: a level is done with it before the next begins


@wp.func
def diagonal(weights: EdgeWeights, i: int):
    """Return the sum of the weights of cell i."""
    return weights.right[i - 1] + weights.right[i] + weights.down[i - weights.pitch] + weights.down[i]


@wp.func
def relaxed(weights: EdgeWeights, target: wp.array(dtype=wp.float32), value: wp.array(dtype=wp.float32), i: int):
    """Return the value of cell i that fulfils its equation given its neighbours, and 0 for a cell without edges."""
    pitch, d = weights.pitch, diagonal(weights, i)
    around = (weights.right[i - 1] * value[i - 1] + weights.right[i] * value[i + 1]
              + weights.down[i - pitch] * value[i - pitch] + weights.down[i] * value[i + pitch])
    return wp.where(d > 0.0, (target[i] + around) / d, 0.0)


@wp.kernel
def _smooth_from_zero(first: int,
                      walk: Walk,
                      weights: EdgeWeights,
                      target: wp.array(dtype=wp.float32),
                      # outputs
                      value: wp.array(dtype=wp.float32)):
    t = first + wp.tid()
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        d = diagonal(weights, i)
        value[i] = wp.where(d > 0.0, target[i] / d, 0.0)


@wp.kernel
def _smooth(first: int,
            walk: Walk,
            weights: EdgeWeights,
            target: wp.array(dtype=wp.float32),
            # outputs
            value: wp.array(dtype=wp.float32)):
    t = first + wp.tid()
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        value[i] = relaxed(weights, target, value, i)


@wp.kernel
def _scaled_residual(first: int,
                     walk: Walk,
                     weights: EdgeWeights,
                     target: wp.array(dtype=wp.float32),
                     value: wp.array(dtype=wp.float32),
                     # outputs
                     scaled: wp.array(dtype=wp.float32)):
    """Return the residual divided by the diagonal; for a cell without edges, 0."""
    t = first + wp.tid()
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        scaled[i] = relaxed(weights, target, value, i) - value[i]


@wp.func
def halved_cell(p: int, cols: int, pitch: int, coarse_pitch: int):
    """Return the upper left fine cell of coarse pixel p, and the coarse cell."""
    r = p // cols
    c = p - r * cols
    return (2 * r + 1) * pitch + 2 * c + 1, (r + 1) * coarse_pitch + c + 1


@wp.kernel
def _restrict(first: int,
              weights: EdgeWeights,
              scaled: wp.array(dtype=wp.float32),
              cols: int,
              coarse_pitch: int,
              # outputs
              target: wp.array(dtype=wp.float32)):
    """Apply the transpose of _prolong: a red pixel's residual goes to the cells of its neighbours. Black residuals are 0."""
    pitch = weights.pitch
    k, coarse = halved_cell(first + wp.tid(), cols, pitch, coarse_pitch)  # k is always even: the cell's black pixels are this one
    j = k + pitch + 1  # and the one diagonally below
    s = weights.right[k - 1] * scaled[k - 1] + weights.right[k] * scaled[k + 1]
    s += weights.down[k - pitch] * scaled[k - pitch] + weights.down[k] * scaled[k + pitch]
    s += weights.right[j - 1] * scaled[j - 1] + weights.right[j] * scaled[j + 1]
    s += weights.down[j - pitch] * scaled[j - pitch] + weights.down[j] * scaled[j + pitch]
    target[coarse] = s


@wp.kernel
def _prolong(first: int,
             walk: Walk,
             weights: EdgeWeights,
             coarse: wp.array(dtype=wp.float32),
             coarse_pitch: int,
             # outputs
             value: wp.array(dtype=wp.float32)):
    """Add the coarse correction at one colour; smoothing the other colour next replaces what it would get."""
    t = first + wp.tid()
    pitch = weights.pitch
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        d = diagonal(weights, i)
        if d > 0.0:
            r = i // pitch - 1
            c = i - (r + 1) * pitch - 1
            row = (r // 2 + 1) * coarse_pitch + 1
            col = c // 2
            above = row - coarse_pitch * (1 - r % 2)
            below = row + coarse_pitch * (r % 2)
            s = weights.right[i - 1] * coarse[row + col - (1 - c % 2)] + weights.right[i] * coarse[row + col + c % 2]
            s += weights.down[i - pitch] * coarse[above + col] + weights.down[i] * coarse[below + col]
            value[i] = value[i] + s / d


@wp.kernel
def _coarsen(first: int,
             weights: EdgeWeights,
             cols: int,
             # outputs
             coarse: EdgeWeights):
    pitch = weights.pitch
    i, k = halved_cell(first + wp.tid(), cols, pitch, coarse.pitch)
    coarse.right[k] = 0.5 * (weights.right[i + 1] + weights.right[i + 1 + pitch])
    coarse.down[k] = 0.5 * (weights.down[i + pitch] + weights.down[i + pitch + 1])


class Multigrid:
    """The hierarchy over one grid's edge weights.
    `target`: the finest right-hand side, read by `cycle`. `value`: where `cycle` leaves its answer. `scratch`: an array of the finest
    layout that `cycle` may overwrite, finite."""

    def __init__(self, grid: Grid, weights: EdgeWeights, *, target: wp.array, value: wp.array, scratch: wp.array):
        self.levels = [Level(grid, weights, target, value, scratch)]
        while max(grid.rows, grid.cols) > COARSEST:
            grid = make_grid(-(-grid.rows // 2), -(-grid.cols // 2), grid.device)
            self.levels.append(Level(grid, grid.no_edges(), grid.zeros(), grid.zeros(), scratch))
        for fine, coarse in itertools.pairwise(self.levels):
            g = coarse.grid
            devices.launch(_coarsen, g.rows * g.cols, [fine.weights, g.cols], [coarse.weights], device=g.device)

        self._commands = [*itertools.chain.from_iterable(self._down(*pair) for pair in itertools.pairwise(self.levels)), *self._coarsest(),
                          *itertools.chain.from_iterable(self._up(*pair) for pair in itertools.pairwise(self.levels[::-1]))]

    def cycle(self) -> None:
        """Set value = B·target, with B a symmetric positive definite approximation of the inverse."""
        for command in self._commands:
            command.run()

    def _smooth(self, level: Level, parity: int) -> Recorded:
        return record(_smooth, level.grid.colour(parity), [level.weights, level.target], [level.value])

    def _start(self, level: Level) -> list[Recorded]:
        """Smooth the red (odd) cells from a guess of zero, then the black ones."""
        return [record(_smooth_from_zero, level.grid.odd, [level.weights, level.target], [level.value]), self._smooth(level, 0)]

    def _down(self, fine: Level, coarse: Level) -> list[Recorded]:
        g = coarse.grid
        return [*self._start(fine), record(_scaled_residual, fine.grid.odd, [fine.weights, fine.target, fine.value], [fine.scratch]),
                devices.record(_restrict, g.rows * g.cols, [fine.weights, fine.scratch, g.cols, g.pitch], [coarse.target], device=g.device,
                               brief=BRIEF_CELLS)]

    def _up(self, coarse: Level, fine: Level) -> list[Recorded]:
        return [record(_prolong, fine.grid.odd, [fine.weights, coarse.value, coarse.grid.pitch], [fine.value]), self._smooth(fine, 0),
                self._smooth(fine, 1)]

    def _coarsest(self) -> list[Recorded]:
        level = self.levels[-1]
        sweeps = (1, 0) * (COARSEST_SWEEPS - 1) + (0, 1) * COARSEST_SWEEPS
        return [*self._start(level), *(self._smooth(level, parity) for parity in sweeps)]
