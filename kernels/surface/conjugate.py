"""Conjugate gradients for the heights: minimise Σ w (h_j − h_i − g)² over the edges of a grid.

The scalars of the iteration stay on the device, one slot per iteration, so that a launch never waits for a sum; the
host reads them only to decide whether to stop.

Float32 holds up because every product with the matrix is a sum of differences of neighbours (each exact to its own
size), the sums of a picture run in float64, and the residual is carried along rather than recomputed: rounding of the
heights is white, and the solver does not chase it.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import warp as wp

from kernels.surface.grid import Grid, Summer, Walk, cell_of, run
from kernels.surface.multigrid import Multigrid
from kernels.surface.slopes import Slopes

wp.set_module_options({"enable_backward": False})

CHECK_EVERY = 4
"""Iterations between readings of the residual on CUDA, where each reading waits for the device."""


class Convergence(NamedTuple):
    """How a solve ended."""

    iterations: int
    residual: float  # preconditioned residual norm over that of the first guess
    converged: bool


@wp.kernel
def _descent(
    first: int,
    walk: Walk,
    gx: wp.array(dtype=wp.float32),
    gy: wp.array(dtype=wp.float32),
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    h: wp.array(dtype=wp.float32),
    pitch: int,
    # outputs
    residual: wp.array(dtype=wp.float32),
):
    """Minus half the gradient of the least squares at h."""
    t = first + wp.tid()
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            s = wx[i] * (h[i + 1] - h[i] - gx[i]) - wx[i - 1] * (h[i] - h[i - 1] - gx[i - 1])
            s += wy[i] * (h[i + pitch] - h[i] - gy[i]) - wy[i - pitch] * (h[i] - h[i - pitch] - gy[i - pitch])
            residual[i] = s


@wp.kernel
def _multiply(
    first: int,
    walk: Walk,
    wx: wp.array(dtype=wp.float32),
    wy: wp.array(dtype=wp.float32),
    p: wp.array(dtype=wp.float32),
    pitch: int,
    # outputs
    q: wp.array(dtype=wp.float32),
    partial: wp.array(dtype=wp.float64),
):
    """q = A·p, and each thread's part of p·q."""
    t = first + wp.tid()
    total = wp.float64(0.0)
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            v = p[i]
            s = wx[i] * (v - p[i + 1]) + wx[i - 1] * (v - p[i - 1])
            s += wy[i] * (v - p[i + pitch]) + wy[i - pitch] * (v - p[i - pitch])
            q[i] = s
            total += wp.float64(v) * wp.float64(s)
    partial[t] = total


@wp.kernel
def _dot(
    first: int,
    walk: Walk,
    a: wp.array(dtype=wp.float32),
    b: wp.array(dtype=wp.float32),
    # outputs
    partial: wp.array(dtype=wp.float64),
):
    t = first + wp.tid()
    total = wp.float64(0.0)
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            total += wp.float64(a[i]) * wp.float64(b[i])
    partial[t] = total


@wp.func
def _ratio(over: wp.array(dtype=wp.float64), i: int, under: wp.array(dtype=wp.float64), j: int):
    """over[i] / under[j], and 0 once the iteration has nothing left to do."""
    q = wp.float32(0.0)
    if under[j] > wp.float64(0.0):
        q = wp.float32(over[i] / under[j])
    return q


@wp.kernel
def _advance(
    first: int,
    walk: Walk,
    rz: wp.array(dtype=wp.float64),
    pq: wp.array(dtype=wp.float64),
    step: int,
    p: wp.array(dtype=wp.float32),
    q: wp.array(dtype=wp.float32),
    # outputs
    h: wp.array(dtype=wp.float32),
    residual: wp.array(dtype=wp.float32),
):
    t = first + wp.tid()
    alpha = _ratio(rz, step, pq, step)
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            h[i] = h[i] + alpha * p[i]
            residual[i] = residual[i] - alpha * q[i]


@wp.kernel
def _turn(
    first: int,
    walk: Walk,
    rz: wp.array(dtype=wp.float64),
    step: int,
    z: wp.array(dtype=wp.float32),
    # outputs
    p: wp.array(dtype=wp.float32),
):
    """The next direction of search."""
    t = first + wp.tid()
    beta = _ratio(rz, step + 1, rz, step)
    for k in range(walk.steps):
        i = cell_of(walk, t, k)
        if i < walk.end:
            p[i] = z[i] + beta * p[i]


class Solver:
    """Conjugate gradients on one grid, with their scratch memory and multigrid hierarchy.

    Memory: five arrays of the grid beyond slopes and heights, and five thirds for the coarse levels.
    """

    def __init__(self, grid: Grid, slopes: Slopes, *, max_iterations: int):
        self.grid, self.slopes, self.max_iterations = grid, slopes, max_iterations
        self.residual, self.z, self.p, self.q = (grid.zeros() for _ in range(4))
        self.multigrid = Multigrid(
            grid, slopes.right_weight, slopes.down_weight, target=self.residual, value=self.z, scratch=self.q
        )
        self.summer = Summer(grid)
        self.rz = wp.zeros(max_iterations + 1, dtype=wp.float64, device=grid.device)
        self.pq = wp.zeros(max_iterations, dtype=wp.float64, device=grid.device)

    def solve(
        self,
        h: wp.array,  # [size] float32, first guess; the answer on return
        *,
        tolerance: float,
        progress: Callable[[float], None] | None = None,
    ) -> Convergence:
        """Improve h until the preconditioned residual norm is below tolerance times its first value.

        Args:
            h: heights, changed in place.
            tolerance: relative; close to the relative error of the slopes of h in the weighted norm.
            progress: told the fraction done, by the logarithm of the residual.

        Returns:
            How the solve ended; reading the residual waits for the device, every CHECK_EVERY iterations on CUDA.
        """
        device, pitch, every = self.grid.device, self.grid.pitch, 1 if self.grid.device == "cpu" else CHECK_EVERY
        s = self.slopes
        weights = [s.right_weight, s.down_weight]
        run(_descent, self.grid.cells, [s.right, s.down, *weights, h, pitch], [self.residual], device=device)
        self._precondition(0)
        wp.copy(self.p, self.z)
        norm = self._norm(0)
        goal, start, step = tolerance * norm, norm, 0
        while norm > goal and step < self.max_iterations:
            run(_multiply, self.grid.sums, [*weights, self.p, pitch], [self.q, self.summer.partial], device=device)
            self.summer.finish(self.pq, step)
            inputs = [self.rz, self.pq, step, self.p, self.q]
            run(_advance, self.grid.cells, inputs, [h, self.residual], device=device)
            self._precondition(step + 1)
            run(_turn, self.grid.cells, [self.rz, step, self.z], [self.p], device=device)
            step += 1
            if step % every == 0 or step == self.max_iterations:
                norm = self._norm(step)
                if progress is not None and norm > 0.0:
                    progress(min(1.0, math.log(start / norm) / math.log(start / goal)) if start > goal > 0.0 else 1.0)
        return Convergence(step, norm / start if start > 0.0 else 0.0, norm <= goal)

    def _precondition(self, slot: int) -> None:
        """z = B·residual, rz[slot] = residual·z."""
        self.multigrid.cycle()
        run(_dot, self.grid.sums, [self.residual, self.z], [self.summer.partial], device=self.grid.device)
        self.summer.finish(self.rz, slot)

    def _norm(self, slot: int) -> float:
        return math.sqrt(max(0.0, float(self.rz[slot : slot + 1].numpy()[0])))
