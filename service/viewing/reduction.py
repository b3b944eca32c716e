"""Images made smaller by whole factors, as the mean of square blocks of pixels."""

import numpy as np


def step_within(pixels: int, most: int) -> int:
    """Return the least whole step with which an image of so many pixels, each step-th in both directions, has at most `most`."""
    return max(1, int(np.ceil(np.sqrt(pixels / most))))


def block_sums(values: np.ndarray, step: int, weight: np.ndarray | None = None) -> np.ndarray:
    """Return the sum of each block of step × step pixels; blocks at the right and lower edge may have fewer pixels.

    Args:
        values: [rows, cols, channels].
        step: of a block.
        weight: [rows, cols] factors of the pixels; None: 1.

    Returns:
        [⌈rows / step⌉, ⌈cols / step⌉, channels] float32.
    """
    rows, cols, channels = values.shape
    down = np.empty((-(-rows // step), cols, channels), dtype=np.float32)
    for index, row in enumerate(range(0, rows, step)):  # block by block: the sum over an axis of the whole image takes ten times as long
        block = values[row : row + step]
        if weight is None:
            np.sum(block, axis=0, dtype=np.float32, out=down[index])
        else:
            np.einsum("rcx,rc->cx", block, weight[row : row + step], out=down[index])
    return np.add.reduceat(down, np.arange(0, cols, step), axis=1) if step > 1 else down


def plane_means(plane: np.ndarray, step: int) -> np.ndarray:
    """Return the mean of each block of step × step pixels of a plane [rows, cols], float32."""
    counted = block_sums(np.ones((*plane.shape, 1), dtype=np.float32), step)
    return np.asarray((block_sums(plane[..., None], step) / counted)[..., 0])
