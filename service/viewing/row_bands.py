"""Bands of whole rows of a stack, for work that takes blocks or every so many pixels of an image."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stage.stack import PIXEL_PAD, Stack, padded


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
    """Yield bands of rows that begin at a multiple of a step.

    Args:
        stack: of the images.
        shape: rows and columns of an image.
        step: that the first row of every band is a multiple of.
        bytes_per_pixel: what the caller allocates for each pixel beside the stack.
    """
    rows, cols = shape
    _, most = next(stack.bands(bytes_per_pixel))
    height = max(1, most // (cols * step)) * step
    for first in range(0, rows, height):
        last = min(first + height, rows)
        start, stop = first * cols // PIXEL_PAD * PIXEL_PAD, padded(last * cols, PIXEL_PAD)
        place = np.arange(start, stop)
        yield RowBand(slice(first, last), slice(first // step, -(-last // step)), start, stop,
                      (place >= first * cols) & (place < last * cols))
