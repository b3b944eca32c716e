"""Conjugate gradients for the heights: minimise Σ w (h_j − h_i − g)² over the edges of a grid.

The scalars of the iteration stay on the device, in slots that two iterations take in turn, so that a launch never waits for a sum; the
host reads them only to decide whether to stop. On CUDA the iterations between two readings are one graph.

Float32 holds up because every product with the matrix is a sum of differences of neighbours (each exact to its own
size), the sums of a picture run in float64, and the residual is carried along rather than recomputed: rounding of the
heights is white, and the solver does not chase it.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from kernels import graphs
from kernels.device import to_numpy
from kernels.surface.grid import EdgeWeights, Grid, Summer, Walk, end_cell, first_cell, run
from kernels.surface.multigrid import Multigrid
from kernels.surface.slopes import Slopes

# what an edge takes from one pixel it gives to the other to the last bit only where products are rounded alike: fused with a sum, as CUDA
# does by itself, one of the two is not rounded, the residuals no longer add up to 0, and the iteration stops at a thousandth
wp.set_module_options({"fuse_fp": False})

CHECK_EVERY = 4
"""Number of iterations between two readings of the residual on CUDA, where each reading waits for the device. It is even, so that their
graph ends in the slot in which it begins."""

NEAR, GROWN = 10.0, 1.0e4
"""Squared residual, over that of the goal, at which a solve ends once it falls no more, and over its least at which it ends wherever that
is: in float32 it may stay just above the goal, and iterations that go on divide rounding errors until the heights are nothing else."""


class Convergence(NamedTuple):
    """The end of a solve."""

    iterations: int
    residual: float  # preconditioned residual norm over that of the first guess
    converged: bool


@wp.kernel
def _descent(first: int,
             walk: Walk,
             right: wp.array(dtype=wp.float32),
             down: wp.array(dtype=wp.float32),
             weights: EdgeWeights,
             h: wp.array(dtype=wp.float32),
             # outputs
             residual: wp.array(dtype=wp.float32)):
    """Compute minus half the gradient of the least-squares sum at h."""
    t = first + wp.tid()
    pitch = weights.pitch
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        s = weights.right[i] * (h[i + 1] - h[i] - right[i]) - weights.right[i - 1] * (h[i] - h[i - 1] - right[i - 1])
        s += weights.down[i] * (h[i + pitch] - h[i] - down[i]) - weights.down[i - pitch] * (h[i] - h[i - pitch] - down[i - pitch])
        residual[i] = s


@wp.kernel
def _multiply(first: int,
              walk: Walk,
              weights: EdgeWeights,
              p: wp.array(dtype=wp.float32),
              # outputs
              q: wp.array(dtype=wp.float32),
              partial: wp.array(dtype=wp.float64)):
    t = first + wp.tid()
    pitch = weights.pitch
    total = wp.float64(0.0)
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        v = p[i]
        s = weights.right[i] * (v - p[i + 1]) + weights.right[i - 1] * (v - p[i - 1])
        s += weights.down[i] * (v - p[i + pitch]) + weights.down[i - pitch] * (v - p[i - pitch])
        q[i] = s
        total += wp.float64(v) * wp.float64(s)
    partial[t] = total


@wp.kernel
def _dot(first: int,
         walk: Walk,
         a: wp.array(dtype=wp.float32),
         b: wp.array(dtype=wp.float32),
         # outputs
         partial: wp.array(dtype=wp.float64)):
    t = first + wp.tid()
    total = wp.float64(0.0)
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        total += wp.float64(a[i]) * wp.float64(b[i])
    partial[t] = total


@wp.func
def _ratio(over: wp.float64, under: wp.float64, goal: wp.float64):
    """Compute over / under, and 0 once `over` has reached the goal: iterations until the host knows it divide rounding errors."""
    return wp.where(over > goal and under > wp.float64(0.0), wp.float32(over / under), 0.0)


@wp.kernel
def _advance(first: int,
             walk: Walk,
             rz: wp.array(dtype=wp.float64),
             pq: wp.array(dtype=wp.float64),
             slot: int,
             goal: wp.float64,
             p: wp.array(dtype=wp.float32),
             q: wp.array(dtype=wp.float32),
             # outputs
             h: wp.array(dtype=wp.float32),
             residual: wp.array(dtype=wp.float32)):
    t = first + wp.tid()
    alpha = _ratio(rz[slot], pq[0], goal)
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        h[i] = h[i] + alpha * p[i]
        residual[i] = residual[i] - alpha * q[i]


@wp.kernel
def _turn(first: int,
          walk: Walk,
          rz: wp.array(dtype=wp.float64),
          slot: int,
          goal: wp.float64,
          z: wp.array(dtype=wp.float32),
          # outputs
          p: wp.array(dtype=wp.float32)):
    t = first + wp.tid()
    beta = _ratio(rz[1 - slot], rz[slot], goal)
    for i in range(first_cell(walk, t), end_cell(walk, t), walk.step):
        p[i] = z[i] + beta * p[i]


class Solver:
    """Conjugate gradients on one grid, with their scratch memory and multigrid hierarchy.

    Memory: four arrays of the grid beyond slopes and heights, two where the slopes may be overwritten, and four thirds for the coarse
    levels. `slopes`: of all edges, and their weights. `max_iterations`: of `solve`. `overwrite`: whether the slopes may be overwritten,
    though not their weights: only the first residual needs them."""

    def __init__(self, grid: Grid, slopes: Slopes, *, max_iterations: int, overwrite: bool = False):
        self.grid, self.slopes, self.max_iterations = grid, slopes, max_iterations
        self.residual, self.z = grid.zeros(), grid.zeros()
        self.p, self.q = (slopes.right, slopes.down) if overwrite else (grid.zeros(), grid.zeros())
        self.multigrid = Multigrid(grid, slopes.weights, target=self.residual, value=self.z, scratch=self.q)
        self.summer = Summer(grid)
        self.rz = wp.zeros(2, dtype=wp.float64, device=grid.device)
        self.pq = wp.zeros(1, dtype=wp.float64, device=grid.device)

    def solve(
        self,
        h: wp.array,  # [size] float32, heights: first guess, changed in place to the answer
        *,
        tolerance: float,  # relative; close to the relative error of the slopes of h in the weighted norm
        progress: Callable[[float], None] | None = None,  # told the fraction done, by the logarithm of the residual
    ) -> Convergence:
        """Improve h until the preconditioned residual norm is below tolerance times its first value, or near it and falls no more.
        Returns how the solve ended; reading the residual waits for the device, every CHECK_EVERY iterations on CUDA."""
        grid, every = self.grid, CHECK_EVERY if self.grid.device != "cpu" or graphs.has_graphs("cpu") else 1
        run(_descent, grid.cells, [*self.slopes, h], [self.residual])
        self._precondition(0)
        wp.copy(self.p, self.z)
        start = square = least = self._square(0)
        goal, step = (tolerance * math.sqrt(start)) ** 2, 0
        group = graphs.Repeated(lambda: self._iterate(h, goal, range(step, step + every)), grid.device)
        while square > goal and step < self.max_iterations:
            if step + every <= self.max_iterations:
                group.run()
            else:
                every = self.max_iterations - step
                self._iterate(h, goal, range(step, self.max_iterations))
            step += every
            square, least = self._square(step % 2), min(least, square)
            if square > least * (1 if least <= NEAR * goal else GROWN):
                break
            if progress is not None and square > 0.0:
                progress(min(1.0, math.log(start / square) / math.log(start / goal)) if start > goal > 0.0 else 1.0)
        least = min(least, square)
        return Convergence(step, math.sqrt(least) / math.sqrt(start) if start > 0.0 else 0.0, least <= NEAR * goal)

    def _iterate(self, h: wp.array, goal: float, steps: range) -> None:
        """Do these steps; those after the goal is reached change nothing."""
        for slot in (step % 2 for step in steps):
            run(_multiply, self.grid.sums, [self.slopes.weights, self.p], [self.q, self.summer.partial])
            self.summer.finish(self.pq, 0)
            run(_advance, self.grid.cells, [self.rz, self.pq, slot, goal, self.p, self.q], [h, self.residual])
            self._precondition(1 - slot)
            run(_turn, self.grid.cells, [self.rz, slot, goal, self.z], [self.p])

    def _precondition(self, slot: int) -> None:
        """z = B·residual, rz[slot] = residual·z."""
        self.multigrid.cycle()
        run(_dot, self.grid.sums, [self.residual, self.z], [self.summer.partial])
        self.summer.finish(self.rz, slot)

    def _square(self, slot: int) -> float:
        return max(0.0, float(to_numpy(self.rz[slot : slot + 1])[0]))
