"""The offset between the rows of two rectified images, which a wrong calibration leaves, measured at matched places."""

from typing import NamedTuple

import numpy as np

from stage.motion.resample import bicubic

REACH = 5
SIDE = 2 * REACH + 1
"""Half side and side of the window in pixels."""
STEPS = 3
"""Gauss-Newton steps."""
MOST_PX = 2.0
"""Larger offsets are no longer found by steps from zero, and left out."""
LEAST_GRADIENT = 1e-12
"""Least sum of squared vertical differences in a window, as a fraction of the square of the largest reading."""
MOST_PLACES = 1500
"""Places of one band of rows at which the offset is measured."""
ALIKE_NOISE, FLOOR_PX = 2.0, 0.02
"""σ² is that of the least squares fit times ALIKE_NOISE², because neighbours share their noise after smoothing and resampling, and
FLOOR_PX² in addition, for interpolation."""


class RowOffsets(NamedTuple):
    """Places of the left image, and by how many rows the right image lies lower there."""

    row: np.ndarray  # [places] int
    col: np.ndarray  # [places] int
    disparity: np.ndarray  # [places] float32, pixels between the columns of both images
    offset: np.ndarray  # [places] float32, pixels
    sigma: np.ndarray  # [places] float32, pixels

    @classmethod
    def none(cls) -> "RowOffsets":
        """Return no places."""
        return cls(*(np.zeros(0, int) for _ in range(2)), *(np.zeros(0, np.float32) for _ in range(3)))

    def joined(self, further: "RowOffsets") -> "RowOffsets":
        """Return these places and further ones."""
        return RowOffsets(*(np.concatenate(each) for each in zip(self, further, strict=True)))


def row_offsets(left: np.ndarray, right: np.ndarray, disparity: np.ndarray, slope_x: np.ndarray, slope_y: np.ndarray,
                usable: np.ndarray) -> RowOffsets:
    """Measure by how many rows the right image lies lower than the left one.

    Args:
        left: [rows, cols] float32.
        right: [rows, right cols] float32.
        disparity, slope_x, slope_y: [rows, cols] float32, refined.
        usable: [rows, cols] bool, where the disparity holds.

    Source:
        Lucas and Kanade, "An iterative image registration technique with an application to stereo vision", IJCAI 1981, with a gain and an
        offset of brightness; the disparity stays as it is.
    """
    inner = np.zeros_like(usable)
    inner[REACH:-REACH, REACH:-REACH] = usable[REACH:-REACH, REACH:-REACH]
    row, col = np.nonzero(inner)
    if not len(row):
        return RowOffsets.none()
    tiles = row // SIDE * (usable.shape[1] // SIDE + 1) + col // SIDE
    alone = np.unique(tiles, return_index=True)[1]  # one place in each tile, so that hardly any share their noise
    alone = alone[:: -(-len(alone) // MOST_PLACES)]
    row, col = row[alone], col[alone]
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
        off = values - gain[:, None] * here
        weight = np.maximum((slope**2).sum(axis=1), 1e-30)
        offset += np.where(weight > LEAST_GRADIENT * float(np.abs(left).max()) ** 2, (slope * off).sum(axis=1) / weight, 0)
        offset = np.clip(offset, -MOST_PX, MOST_PX)
    sigma = np.hypot(ALIKE_NOISE * np.sqrt((off**2).mean(axis=1) / weight), FLOOR_PX)
    kept = np.abs(offset) < MOST_PX
    return RowOffsets(row[kept], col[kept], *(each[kept].astype(np.float32) for each in (disparity[row, col], offset, sigma)))


def _at(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return an image at places, which are clamped to it: float64 in the shape of x."""
    return bicubic(image, np.clip(x, 0, image.shape[1] - 1).astype(np.float32), np.clip(y, 0, image.shape[0] - 1).astype(np.float32)
                   ).astype(np.float64)
