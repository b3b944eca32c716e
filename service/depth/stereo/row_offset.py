"""The offset between the rows of two rectified images, which a wrong calibration leaves, measured at matched places."""

import numpy as np

from stage.motion.resample import bicubic

REACH = 5
"""Half side of the window: 11 × 11 pixels."""
STEPS = 3
"""Gauss-Newton steps."""
MOST_PX = 2.0
"""Larger offsets are no longer found by steps from zero, and left out."""
LEAST_GRADIENT = 1e-12
"""Least sum of squared vertical differences in a window, as a fraction of the square of the largest reading."""


def row_offsets(left: np.ndarray, right: np.ndarray, disparity: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray, usable: np.ndarray, *,
                most: int) -> np.ndarray:
    """Measure by how many rows the right image lies lower than the left one.

    Args:
        left: [rows, cols] float32.
        right: [rows, right cols] float32.
        disparity, slope_x, slope_y: [rows, cols] float32, refined.
        usable: [rows, cols] bool, where the disparity holds.
        most: of how many places at most, evenly drawn.

    Returns:
        [places] float32, pixels.

    Source:
        Lucas and Kanade, "An iterative image registration technique with an application to stereo vision", IJCAI 1981, with a gain and an
        offset of brightness; the disparity stays as it is.
    """
    inner = np.zeros_like(usable)
    inner[REACH:-REACH, REACH:-REACH] = usable[REACH:-REACH, REACH:-REACH]
    row, col = np.nonzero(inner)
    if not len(row):
        return np.zeros(0, np.float32)
    chosen = np.linspace(0, len(row) - 1, min(most, len(row))).astype(int)
    row, col = row[chosen], col[chosen]
    dy, dx = (grid.ravel() for grid in np.mgrid[-REACH:REACH + 1, -REACH:REACH + 1])
    plane = disparity[row, col][:, None] + slope_x[row, col][:, None] * dx + slope_y[row, col][:, None] * dy
    values = left[row[:, None] + dy, col[:, None] + dx].astype(np.float64)
    values -= values.mean(axis=1, keepdims=True)
    x = (col[:, None] + dx - plane).astype(np.float32)
    offset = np.zeros(len(row))
    for _ in range(STEPS):
        y = (row[:, None] + dy + offset[:, None]).astype(np.float32)
        here, below, above = (_at(right, x, y + shift) for shift in (0.0, 0.5, -0.5))
        here -= here.mean(axis=1, keepdims=True)
        gain = (values * here).sum(axis=1) / np.maximum((here**2).sum(axis=1), 1e-30)
        slope = gain[:, None] * (below - above)
        slope -= slope.mean(axis=1, keepdims=True)
        weight = (slope**2).sum(axis=1)
        floor = LEAST_GRADIENT * float(np.abs(left).max()) ** 2
        offset += np.where(weight > floor, (slope * (values - gain[:, None] * here)).sum(axis=1) / np.maximum(weight, 1e-30), 0)
        offset = np.clip(offset, -MOST_PX, MOST_PX)
    return offset[np.abs(offset) < MOST_PX].astype(np.float32)


def _at(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return an image at places, which are clamped to it: float64 in the shape of x."""
    return bicubic(image, np.clip(x, 0, image.shape[1] - 1).astype(np.float32), np.clip(y, 0, image.shape[0] - 1).astype(np.float32)
                   ).astype(np.float64)
