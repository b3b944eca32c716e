"""Images made smaller by whole factors, as the mean of square blocks of pixels."""

import numpy as np


def step_within(pixels: int, most: int) -> int:
    """Return the least whole step with which an image of so many pixels, each step-th in both directions, has at most `most`."""
    return max(1, int(np.ceil(np.sqrt(pixels / most))))


def block_sums(values: np.ndarray, step: int) -> np.ndarray:
    """Return the sum of each block of step × step pixels; blocks at the right and lower edge may have fewer pixels.

    Args:
        values: [rows, cols, …].
        step: of a block.

    Returns:
        [⌈rows / step⌉, ⌈cols / step⌉, …] float32, or `values` as float32 for a step of 1.
    """
    if step == 1:
        return np.asarray(values, dtype=np.float32)
    down = np.add.reduceat(values, np.arange(0, values.shape[0], step), axis=0, dtype=np.float32)
    return np.asarray(np.add.reduceat(down, np.arange(0, values.shape[1], step), axis=1))


def block_means(values: np.ndarray, step: int, weight: np.ndarray) -> np.ndarray:
    """Return the weighted mean of each block of step × step pixels; 0 where the block has no weight.

    Args:
        values: [rows, cols, channels].
        step: of a block.
        weight: [rows, cols], 0 or above.
    """
    total = block_sums(weight, step)[..., None]
    weighted = block_sums(values * weight[..., None], step)
    return np.divide(weighted, total, out=np.zeros_like(weighted), where=total > 0)
