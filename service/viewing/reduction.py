"""Images made smaller by whole factors and cut into square tiles, and bands of whole rows of a stack that are as high as these need."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from service.reporting.progress import Timings
from stage.stack.stack import PIXEL_PAD, Stack, padded

LEAST_SIDE = 8
"""Least side of a tile: with smaller ones, the matrices of a hundred lights would take twice the memory of the coefficient images."""
MOST_TILES = 1024
"""Most tiles. A page keeps the coefficients of two pictures in a texture with a row for each tile, and all browsers have 2048 rows."""
MOST_COEFFICIENTS = 4_000_000
"""Most tiles × terms × lights: a page multiplies each with the weight of its light, in each channel, whenever an environment turns."""
NO_TILE = 0xFFFF
"""Index of a tile that holds nothing of the object."""


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


@dataclass(frozen=True)
class Tiling:
    """The division of an image into tiles."""

    side: int
    index: np.ndarray  # [rows of tiles, columns of tiles] uint16, row by row from 0; NO_TILE where the object is not

    @property
    def tile_count(self) -> int:
        """The number of tiles that hold some of the object."""
        return int((self.index != NO_TILE).sum())


class TileRow(NamedTuple):
    """The tiles of one row that hold some of the object."""

    rows: slice
    """Rows of the reduced image."""
    tiles: np.ndarray  # [n] indices of the tiles
    columns: np.ndarray  # [n] which columns of tiles they are
    images: np.ndarray  # [n, 3, lights, side²] float32 radiance times the factor of the matte; 0 beyond the edge of the image


def tiling_of(factor: np.ndarray, *, lights: int, terms: int) -> Tiling:
    """Return the smallest tiles that a page can use, of a reduced image that is above 0 on the object, for so many lights and terms."""
    side = LEAST_SIDE
    while True:
        holds = block_sums((factor > 0).astype(np.float32)[..., None], side)[..., 0] > 0
        count = int(holds.sum())
        if count <= max(1, min(MOST_TILES, MOST_COEFFICIENTS // (lights * terms))):
            index = np.full(holds.shape, NO_TILE, dtype=np.uint16)
            index[holds] = np.arange(count)
            return Tiling(side, index)
        side *= 2


def tile_rows(stack: Stack, factor: np.ndarray, tiling: Tiling, step: int, timings: Timings, stage: str) -> Iterator[TileRow]:
    """Yield the captured images row by row of tiles, without rows that hold nothing of the object.
    `factor`: [rows, cols] of the whole image, which the images are multiplied with. `tiling`: of the image that is reduced by the step."""
    lights, side, cols = stack.light_count, tiling.side, factor.shape[1]
    across = tiling.index.shape[1]
    bands = list(row_bands(stack, factor.shape, side * step, 4 * 3 * 4 * lights))
    timings.stage(stage, len(bands))
    for done, band in enumerate(bands, start=1):
        own = np.flatnonzero(band.own)
        stored = stack.band(band.start, band.stop)[:, :lights, own[0] : own[-1] + 1]
        for tile_row in range(band.reduced.start, band.reduced.stop):
            indices, top = tiling.index[tile_row], tile_row * side
            columns = np.flatnonzero(indices != NO_TILE)
            if not len(columns):
                continue
            whole = slice(top * step, min((top + side) * step, band.rows.stop))
            part = stored[:, :, (whole.start - band.rows.start) * cols : (whole.stop - band.rows.start) * cols]
            images = _reduced(part.reshape(3, lights, -1, cols), stack.scale[:lights], factor[whole], step)
            rows, width = images.shape[2:]
            padded = np.zeros((3, lights, side, across * side), dtype=np.float32)
            padded[:, :, :rows, :width] = images
            tiles = padded.reshape(3, lights, side, across, side).transpose(3, 0, 1, 2, 4)[columns]
            yield TileRow(slice(top, top + rows), indices[columns].astype(np.int64), columns,
                          tiles.reshape(len(columns), 3, lights, side**2))
        timings.advance(done)


def put_together(tiles: np.ndarray, row: TileRow, side: int, cols: int) -> np.ndarray:
    """Return the rows of an image that tiles [n, channels, side²] make, [channels, rows, cols]; 0 where there is no tile."""
    across = -(-cols // side)
    channels = tiles.shape[1]
    image = np.zeros((across, channels, side, side), dtype=tiles.dtype)
    image[row.columns] = tiles.reshape(len(tiles), channels, side, side)
    height = row.rows.stop - row.rows.start
    return image.transpose(1, 2, 0, 3).reshape(channels, side, across * side)[:, :height, :cols]


def _reduced(stored: np.ndarray, scale: np.ndarray, factor: np.ndarray, step: int) -> np.ndarray:
    """Return stored values [3, lights, rows, cols] as radiance times the factor of the matte, reduced."""
    if step == 1:
        return np.asarray(stored.astype(np.float32) * (scale.astype(np.float32)[:, None, None] * factor))
    planes = [plane_means(plane * (scale[light] * factor), step) for channel in stored for light, plane in enumerate(channel)]
    return np.stack(planes).reshape(*stored.shape[:2], *planes[0].shape)
