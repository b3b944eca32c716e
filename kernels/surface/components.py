"""Connected parts of a masked surface: each is a height field with a constant of its own.

A mask is cut into runs, unbroken stretches of one row. There are few, so joining them into components is host work in
NumPy, while sums over the pixels stay on the device, one thread a run.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.surface.grid import Grid


class Runs(NamedTuple):
    """Unbroken stretches of usable pixels, row by row."""

    row: np.ndarray  # [M] int32
    first_col: np.ndarray  # [M] int32
    end_col: np.ndarray  # [M] int32, one past the last
    label: np.ndarray  # [M] int32, the component, 0…count − 1
    count: int


def label_runs(
    usable: np.ndarray,  # [rows, cols] uint8 or bool
) -> Runs:
    """Cut a mask into runs and label their 4-connected components.

    Rounds are few (each at least halves the parts still to be joined), whatever the shape: spirals and combs included.
    """
    rows, cols = usable.shape
    padded = np.zeros((rows, cols + 1), dtype=np.int8)
    padded[:, :cols] = usable != 0
    flat = padded.ravel()
    change = np.flatnonzero(np.diff(flat, prepend=np.int8(0)))  # every row ends on a spare 0: starts and ends alternate
    start, end = change[0::2], change[1::2]
    width = cols + 1

    # a run of the next row touches if it begins before this one's end and ends after its beginning
    below_first = np.searchsorted(end, start + width, side="right")
    below_last = np.searchsorted(start, end + width, side="left")
    touching = np.maximum(below_last - below_first, 0)
    a = np.repeat(np.arange(start.size), touching)
    b = np.arange(a.size) - np.repeat(np.cumsum(touching) - touching, touching) + np.repeat(below_first, touching)
    root = join(start.size, a, b)
    kept, label = np.unique(root, return_inverse=True)
    row = start // width
    first_col = start - row * width
    return Runs(
        row.astype(np.int32),
        first_col.astype(np.int32),
        (first_col + end - start).astype(np.int32),
        label.astype(np.int32),
        int(kept.size),
    )


def join(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the smallest member of each node's component, given the pairs (a, b) of connected nodes."""
    root = np.arange(count)
    while a.size:
        low, high = np.minimum(root[a], root[b]), np.maximum(root[a], root[b])
        apart = low != high
        if not apart.any():
            break
        a, b = a[apart], b[apart]
        np.minimum.at(root, high[apart], low[apart])
        while True:  # point every node at its root
            up = root[root]
            if np.array_equal(up, root):
                break
            root = up
    return root


@wp.struct
class DeviceRuns:
    """Runs on the device, and where each begins in the flat layout of a grid."""

    start: wp.array(dtype=wp.int32)  # [M]
    length: wp.array(dtype=wp.int32)
    row: wp.array(dtype=wp.int32)
    col: wp.array(dtype=wp.int32)


@wp.kernel
def _sum_runs(first: int,
              runs: DeviceRuns,
              value: wp.array(dtype=wp.float32),
              # outputs
              total: wp.array(dtype=wp.float64)):
    m = first + wp.tid()
    s = wp.float64(0.0)
    for i in range(runs.start[m], runs.start[m] + runs.length[m]):
        s += wp.float64(value[i])
    total[m] = s


@wp.kernel
def _sum_depths(first: int,
                runs: DeviceRuns,
                value: wp.array(dtype=wp.float32),
                mean: wp.array(dtype=wp.float64),
                spacing: wp.float64,
                # outputs
                total: wp.array(dtype=wp.float64)):
    m = first + wp.tid()
    s = wp.float64(0.0)
    for i in range(runs.start[m], runs.start[m] + runs.length[m]):
        s += wp.exp(spacing * (mean[m] - wp.float64(value[i])))
    total[m] = s


@wp.kernel
def _write_heights(first: int,
                   runs: DeviceRuns,
                   value: wp.array(dtype=wp.float32),
                   mean: wp.array(dtype=wp.float64),
                   spacing: wp.float64,
                   mean_z: wp.float64,
                   # outputs
                   height: wp.array2d(dtype=wp.float32)):
    m = first + wp.tid()
    for k in range(runs.length[m]):
        z = mean_z + spacing * (wp.float64(value[runs.start[m] + k]) - mean[m])
        height[runs.row[m], runs.col[m] + k] = wp.float32(z)


@wp.kernel
def _write_depths(first: int,
                  runs: DeviceRuns,
                  value: wp.array(dtype=wp.float32),
                  mean: wp.array(dtype=wp.float64),
                  spacing: wp.float64,
                  scale: wp.array(dtype=wp.float64),
                  # outputs
                  height: wp.array2d(dtype=wp.float32)):
    m = first + wp.tid()
    for k in range(runs.length[m]):
        depth = scale[m] * wp.exp(spacing * (mean[m] - wp.float64(value[runs.start[m] + k])))
        height[runs.row[m], runs.col[m] + k] = wp.float32(-depth)


def place(
    value: wp.array,  # [grid.size] float32, heights (or −log depths) in units of the spacing, any constant
    runs: Runs,
    *,
    grid: Grid,
    perspective: bool,
    spacing: float,
    mean_z: float,
) -> wp.array:
    """Return the camera-frame z of every pixel, the mean of each component at mean_z: [rows, cols] float32, 0 outside the runs.

    Reads one number per run back to the host, once (orthographic) or twice (perspective).
    """
    device, count = grid.device, runs.row.size
    height = wp.zeros((grid.rows, grid.cols), dtype=wp.float32, device=device)
    if count == 0:
        return height
    length = runs.end_col - runs.first_col
    pixels = np.bincount(runs.label, weights=length)

    def per_run(values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=device)

    there = DeviceRuns()
    there.start = per_run((runs.row + 1) * grid.pitch + runs.first_col + 1, wp.int32)
    there.length, there.row, there.col = (per_run(values, wp.int32) for values in (length, runs.row, runs.first_col))
    total = wp.zeros(count, dtype=wp.float64, device=device)

    def component_mean() -> np.ndarray:
        return (np.bincount(runs.label, weights=to_numpy(total)) / pixels)[runs.label]

    devices.launch(_sum_runs, count, [there, value], [total], device=device)
    mean = per_run(component_mean(), wp.float64)
    if perspective:
        devices.launch(_sum_depths, count, [there, value, mean, spacing], [total], device=device)
        scale = per_run(-mean_z / component_mean(), wp.float64)
        devices.launch(_write_depths, count, [there, value, mean, spacing, scale], [height], device=device)
    else:
        devices.launch(_write_heights, count, [there, value, mean, spacing, mean_z], [height], device=device)
    return height
