"""The layout of a picture in memory for the height solver, the walk of a launch over it, and its sums.

A grid of rows × cols pixels is stored flat with a ring of spare cells, `pitch` cells a row, so that the four
neighbours of any pixel exist and lie at i ± 1 and i ± pitch. The pitch is odd, so that the parity of i is the colour
of pixel i on a chessboard. Spare cells belong to no edge (their weights stay 0), which makes every kernel free of
border cases.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices

CPU_RUN = 8192
"""Number of cells that one CPU thread takes in a row: 32 KB of float32, so that the cost of starting a thread is negligible."""
BRIEF_RUNS = 16
"""Number of such runs that are faster on one core than divided: a run takes some microseconds, to start another core a tenth of a
millisecond."""
CUDA_SUM_THREADS = 65536
"""Number of threads of a sum on CUDA: enough to fill the largest device, and few enough for their partial sums to be cheap."""
FOLD_THREADS = 256
"""Number of threads in the second stage of a long sum; the third stage is one thread."""


@wp.struct
class Walk:
    """The cells that thread t visits: every `step`-th of the `span` cells from start + t · apart on, below end."""

    start: wp.int32
    apart: wp.int32
    step: wp.int32
    span: wp.int32
    end: wp.int32


@wp.struct
class EdgeWeights:
    """Weight of each edge of a grid, at the cell of its left or upper pixel. A weight of 0 is no edge."""

    right: wp.array(dtype=wp.float32)  # [size], 0…1
    down: wp.array(dtype=wp.float32)
    pitch: wp.int32


class Sweep(NamedTuple):
    """A walk and the number of threads that cover it."""

    walk: Walk
    threads: int
    device: str


class Grid(NamedTuple):
    """The layout of one level."""

    rows: int
    cols: int
    pitch: int
    size: int
    cells: Sweep  # every pixel, one cell a thread on CUDA
    even: Sweep  # the pixels of even index
    odd: Sweep
    sums: Sweep  # every pixel, few threads with many cells each
    device: str

    def zeros(self, dtype: Any = wp.float32) -> wp.array:
        """Return a new array of this layout, all zero."""
        return wp.zeros(self.size, dtype=dtype, device=self.device)

    def pixels(self, cells: np.ndarray) -> np.ndarray:
        """Return the pixels [..., rows, cols] among cells [..., size] of this layout; of contiguous cells a view."""
        return cells.reshape(*cells.shape[:-1], -1, self.pitch)[..., 1:self.rows + 1, 1:self.cols + 1]

    def no_edges(self) -> EdgeWeights:
        """Return new edge weights, all zero."""
        weights = EdgeWeights()
        weights.right, weights.down, weights.pitch = self.zeros(), self.zeros(), self.pitch
        return weights

    def colour(self, parity: int) -> Sweep:
        """Return the walk over the pixels of one chessboard colour."""
        return self.odd if parity else self.even


def make_grid(rows: int, cols: int, device: str) -> Grid:
    """Lay out rows × cols pixels."""
    pitch = cols + 1 + cols % 2
    first, end = pitch, (rows + 1) * pitch
    return Grid(
        rows,
        cols,
        pitch,
        (rows + 3) * pitch,
        _sweep(first, end, 1, device),
        _sweep(first + first % 2, end, 2, device),
        _sweep(first + 1 - first % 2, end, 2, device),
        _sweep(first, end, 1, device, threads=CUDA_SUM_THREADS),
        device,
    )


def _sweep(start: int, end: int, stride: int, device: str, *, threads: int | None = None) -> Sweep:
    count = max(0, -(-(end - start) // stride))
    walk = Walk()
    walk.start, walk.end = start, end
    if device == "cpu":  # neighbouring cells one after another
        threads = max(1, math.ceil(count / CPU_RUN))
        walk.step, walk.span = stride, stride * math.ceil(count / threads)
        walk.apart = walk.span
    else:  # neighbouring cells in neighbouring threads
        threads = max(1, min(count, threads or count))
        walk.step, walk.span = stride * threads, end - start
        walk.apart = stride
    return Sweep(walk, threads, device)


def record(kernel: Any, sweep: Sweep, inputs: list[Any], outputs: list[Any]) -> devices.Recorded:
    """Return the launch of `run` without running it."""
    return devices.record(kernel, sweep.threads, [sweep.walk, *inputs], outputs, device=sweep.device, brief=BRIEF_RUNS)


def run(kernel: Any, sweep: Sweep, inputs: list[Any], outputs: list[Any]) -> None:
    """Launch a kernel whose arguments begin with `first: int, walk: Walk`."""
    record(kernel, sweep, inputs, outputs).run()


@wp.func
def first_cell(walk: Walk, t: int):
    """Return the cell that thread t visits first."""
    return walk.start + t * walk.apart


@wp.func
def end_cell(walk: Walk, t: int):
    """Return the cell that thread t stops before."""
    return wp.min(first_cell(walk, t) + walk.span, walk.end)


@wp.kernel
def _fold(
    first: int,
    partial: wp.array(dtype=wp.float64),
    count: int,
    stride: int,
    slot: int,
    # outputs
    total: wp.array(dtype=wp.float64),
):
    t = first + wp.tid()
    s = wp.float64(0.0)
    for j in range(t, count, stride):
        s += partial[j]
    total[slot + t] = s


class Summer:
    """Adds up the partial sums that the threads of `grid.sums` leave, always in the same order.

    The result goes to one slot of a device array: nothing is read back.
    """

    def __init__(self, grid: Grid):
        self.grid = grid
        self.partial = wp.zeros(grid.sums.threads, dtype=wp.float64, device=grid.device)
        self._middle = wp.zeros(FOLD_THREADS, dtype=wp.float64, device=grid.device)

    def finish(self, total: wp.array, slot: int) -> None:
        """Write the sum of `partial` to total[slot]."""
        device, count = self.grid.device, self.grid.sums.threads
        if count <= FOLD_THREADS:
            devices.launch(_fold, 1, [self.partial, count, 1, slot], [total], device=device)
            return
        devices.launch(_fold, FOLD_THREADS, [self.partial, count, FOLD_THREADS, 0], [self._middle], device=device)
        devices.launch(_fold, 1, [self._middle, FOLD_THREADS, 1, slot], [total], device=device)
