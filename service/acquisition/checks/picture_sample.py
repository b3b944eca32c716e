"""The part of a picture by which it is judged, means of blocks all over it and one tile at full resolution; shift and blur of the tile.

Details are a band of spatial frequencies. The peak of the cross-correlation of both tiles' details is at the shift between them. Blur takes
details away: their contrast falls against that of a coarser band, and only what is left of them fits those of the other tile. Where two
tiles merely differ, as under another light, the contrast stays.
"""

import hashlib
from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

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
FINE_PX, DETAIL_PX, COARSE_PX = 0.7, 2.0, 6.0
"""Details lie between smoothing by the first and the second standard deviation, what is coarser between the second and the third."""
FARTHEST_PX = 12
"""The farthest shift that is looked for."""


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


def _stride(shape: tuple[int, ...]) -> int:
    """Return the distance in pixels between those that are read all over a picture."""
    return max(1, int(np.ceil(np.sqrt(shape[0] * shape[1] / MOST_PIXELS))))


def place_of_tile(pixels: np.ndarray) -> tuple[int, int]:
    """Return the first row and column of the tile: where a picture has most detail."""
    step = _stride(pixels.shape)
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
    step, (row, column) = _stride(pixels.shape), place
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


class Motion(NamedTuple):
    """How the details of a tile differ from those of another one."""

    shift_px: tuple[float, float]
    """Columns to the right, rows down, in whole pixels."""
    gain: float
    """The correlation at the shift over that without one; inf where there is none without."""
    correlation: float
    """The correlation at the shift, -1 to 1."""
    contrast: float
    """The contrast of details over that of the other tile, of equal coarser contrast."""
    match: float
    """The slope of the details against those of the other tile, of equal slope of what is coarser."""


class Bands(NamedTuple):
    """A tile in two bands of spatial frequencies."""

    fine: np.ndarray  # [rows, cols] float32
    coarse: np.ndarray  # [rows, cols] float32


def bands_of(tile: np.ndarray) -> Bands:
    """Return the bands of a tile, [rows, cols]."""
    fine, detail, coarse = (ndimage.gaussian_filter(tile, sigma, truncate=3.0) for sigma in (FINE_PX, DETAIL_PX, COARSE_PX))
    return Bands(fine - detail, detail - coarse)


def motion_between(tile: Bands, other: Bands) -> Motion | None:
    """Return the shift and the blur of a tile against another one; None where one of them has no details, or is too small."""
    shape, reach = tile.fine.shape, FARTHEST_PX
    if min(shape) < 4 * reach or min(float(np.abs(band).max()) for bands in (tile, other) for band in bands) <= 0:
        return None
    window = np.outer(np.hanning(shape[0]), np.hanning(shape[1])).astype(np.float32)
    first, second = tile.fine * window, other.fine * window
    product = fft.rfft2(first) * fft.rfft2(second).conj()
    found = fft.irfft2(product, s=shape) / float(np.sqrt((first**2).sum() * (second**2).sum()))
    near = np.roll(found, (reach, reach), axis=(0, 1))[:2 * reach + 1, :2 * reach + 1]
    row, column = np.unravel_index(near.argmax(), near.shape)
    here, peak = float(near[reach, reach]), float(near.max())
    coarse, fine = _power(other.coarse, other.coarse), _power(other.fine, other.fine)
    slope = _power(tile.coarse, other.coarse) / coarse
    contrast = np.sqrt(_power(tile.fine, tile.fine) / fine / max(_power(tile.coarse, tile.coarse) / coarse, 1e-30))
    return Motion((float(column - reach), float(row - reach)), peak / here if here > 0 else np.inf, peak, float(contrast),
                  _power(tile.fine, other.fine) / fine / slope if slope > 0 else 1.0)


def _power(band: np.ndarray, other: np.ndarray) -> float:
    return float((band * other).sum())
