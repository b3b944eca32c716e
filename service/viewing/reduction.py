"""Images made smaller by whole factors, as the mean of square blocks of pixels, and bands of whole rows of a stack for such work."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stage.stack.stack import PIXEL_PAD, Stack, padded


class RowBand(NamedTuple):
    """Some rows of the image, and the pixel range of the stack that contains them."""

    rows: slice
    """Rows of the image."""
    reduced: slice
    """Rows of the image reduced by the step."""
    start: int
    """First pixel of the range, a multiple of 64."""
    stop: int
    """Pixel after the range, a multiple of 64."""
    own: np.ndarray  # [stop - start] bool: which pixels of the range are of these rows


def row_bands(stack: Stack, shape: tuple[int, int], step: int, bytes_per_pixel: int) -> Iterator[RowBand]:
    """Yield bands of rows that begin at a multiple of a step; the caller allocates some bytes for each pixel beside the stack."""
    rows, cols = shape
    _, most = next(stack.bands(bytes_per_pixel))
    height = max(1, most // (cols * step)) * step
    for first in range(0, rows, height):
        last = min(first + height, rows)
        start, stop = first * cols // PIXEL_PAD * PIXEL_PAD, padded(last * cols, PIXEL_PAD)
        place = np.arange(start, stop)
        yield RowBand(slice(first, last), slice(first // step, -(-last // step)), start, stop,
                      (place >= first * cols) & (place < last * cols))


def step_within(pixels: int, most: int) -> int:
    """Return the least whole step with which an image of so many pixels, each step-th in both directions, has at most `most`."""
    return max(1, int(np.ceil(np.sqrt(pixels / most))))


def block_sums(values: np.ndarray, step: int, weight: np.ndarray | None = None) -> np.ndarray:
    """Return the sum of each block of step × step pixels, [⌈rows / step⌉, ⌈cols / step⌉, channels] float32.

    Blocks at the right and lower edge may have fewer pixels; pixels may have weights [rows, cols].
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
