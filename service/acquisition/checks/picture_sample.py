"""The part of a picture by which it is judged: means of blocks all over it, and one tile at full resolution."""

import hashlib
from typing import NamedTuple

import numpy as np

from stage.colour.colour import linearise

MOST_PIXELS = 60_000
"""The most pixels that are read all over a picture: a few milliseconds' work."""
BLOCKS = 48
"""The number of blocks along the longer side: each averages enough pixels that lamps are told apart below the noise of a pixel."""
TILE_PX = 160
"""The side of the tile, in which shifts and blur are seen."""
LIT = 0.02
"""The part of full scale above which a pixel counts as not dark."""
LEAST_VALUES = 8
"""Pictures with fewer different readings are not compared bit by bit: two black ones are no sign of a camera that repeats itself."""


class Sample(NamedTuple):
    """A picture as it is judged, scene-linear, full scale 1."""

    blocks: np.ndarray  # [blocks] float32, the mean of the pixels and channels of each
    tile: np.ndarray  # [rows, cols] float32, the mean of the channels
    clipped: float
    """The share of the pixels that are not dark of which a channel is at full scale."""
    bright: float
    """What the brightest thousandth reads."""
    digest: bytes | None
    """A digest of the readings; None: they hardly differ."""


def stride(shape: tuple[int, ...], most: int = MOST_PIXELS) -> int:
    """Return the distance in pixels between those, `most` of them, that are read all over a picture of a shape."""
    return max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / most))))


def place_of_tile(pixels: np.ndarray) -> tuple[int, int]:
    """Return the first row and column of the tile: where a picture has most detail."""
    step = stride(pixels.shape)
    small = pixels[::step, ::step].astype(np.float32).mean(axis=2)
    detail = np.zeros(small.shape)
    detail[1:, 1:] = np.abs(np.diff(small, axis=0))[:, 1:] + np.abs(np.diff(small, axis=1))[1:]
    side = max(1, min(TILE_PX // step, *small.shape))
    total = np.pad(detail.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
    sums = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    row, column = np.unravel_index(sums.argmax(), sums.shape)
    return min(int(row) * step, max(0, pixels.shape[0] - TILE_PX)), min(int(column) * step, max(0, pixels.shape[1] - TILE_PX))


def sample_of(
    pixels: np.ndarray,  # [rows, cols, 3] recorded values, integers as fractions of full scale
    place: tuple[int, int],  # of the tile, by `place_of_tile`
    space: str,
    full_scale: float,  # the recorded value from which readings are clipped
) -> Sample:
    """Return the sample of a picture."""
    step, (row, column) = stride(pixels.shape), place
    sparse = np.ascontiguousarray(pixels[step // 2::step, step // 2::step], dtype=np.float32)
    tile = np.ascontiguousarray(pixels[row:row + TILE_PX, column:column + TILE_PX], dtype=np.float32)
    brightest = sparse.max(axis=2)
    lit = brightest > LIT * full_scale
    clipped = float((brightest[lit] >= full_scale).mean()) if lit.any() else 0.0
    digest = hashlib.sha256(sparse.tobytes()).digest() if len(np.unique(sparse[::7, ::7])) >= LEAST_VALUES else None
    linear = linearise(sparse, space).mean(axis=2)
    return Sample(_block_means(linear), linearise(tile, space).mean(axis=2), clipped, float(np.quantile(linear, 0.999)), digest)


def _block_means(values: np.ndarray) -> np.ndarray:
    """Return the mean of each square block of [rows, cols], [blocks]; what is left at the edges belongs to the last ones."""
    side = max(1, max(values.shape) // BLOCKS)
    edges = [np.arange(0, max(1, length - side + 1), side) for length in values.shape]
    sums = np.add.reduceat(np.add.reduceat(values, edges[0], axis=0), edges[1], axis=1)
    counts = np.outer(*(np.diff([*edge, length]) for edge, length in zip(edges, values.shape, strict=True)))
    means: np.ndarray = (sums / counts).astype(np.float32).ravel()
    return means
