"""Means of maps over cells of 2^level pixels, and maps between the middles of cells."""

import numpy as np


def sum_cells(plane: np.ndarray, level: int) -> np.ndarray:
    """Return the sums over cells of 2^level pixels."""
    side = 1 << level
    rows, cols = (-(-count // side) for count in plane.shape)
    framed = np.pad(plane, ((0, rows * side - plane.shape[0]), (0, cols * side - plane.shape[1])))
    return framed.reshape(rows, side, cols, side).sum(axis=(1, 3))


def interpolated(cells: np.ndarray, weight: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    """Return bilinear interpolation of cells by their weights; 0 where all are 0."""
    held = (weight > 0).astype(np.float64)
    total, norm = (_bilinear(plane, shape, level) for plane in (cells * held, held))
    return total / np.where(norm > 0, norm, 1)


def _bilinear(cells: np.ndarray, shape: tuple[int, int], level: int) -> np.ndarray:
    for axis, count in enumerate(shape):
        place = np.clip((np.arange(count) + 0.5) / (1 << level) - 0.5, 0, cells.shape[axis] - 1)
        low = np.minimum(place.astype(np.int64), max(cells.shape[axis] - 2, 0))
        part = (place - low).reshape((-1, 1) if axis == 0 else (1, -1))
        cells = np.take(cells, low, axis) * (1 - part) + np.take(cells, np.minimum(low + 1, cells.shape[axis] - 1), axis) * part
    return cells
