"""Shift and blur of a tile against the same tile of another picture or of a prediction, by their details.

Details are a band of spatial frequencies. The peak of the cross-correlation of both tiles' details is at the shift between them: of details
as they are, which the brightest parts lead, and of details over the light around them, which every part that is lit in both tiles shares,
so that a lamp that lights a rim alone is judged too. Blur takes details away: their contrast falls against that of a coarser band, and only
what is left of them fits those of the other tile. Where two tiles merely differ, as under another light, the contrast stays.
"""

from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

FINE_PX, DETAIL_PX, COARSE_PX = 0.7, 2.0, 6.0
"""Details lie between smoothing by the first and the second standard deviation, what is coarser between the second and the third."""
FARTHEST_PX = 12
"""The farthest shift that is looked for."""
LEVEL_PX = 4.0
"""The standard deviation of the smoothing that leaves the light around details."""
SHADE_PART = 0.03
"""The light around details, as a part of the usual light, below which they count less."""

MOVED_PX, MOVED_GAIN, MOVED_PEAK = 1.5, 1.6, 5.0
"""A tile has moved if it fits better by this factor at a shift of more pixels, and stands out so far from the correlation of what lies too
far apart."""
AGREEING_QUARTERS = 2
"""The fewest quarters of the tile that fit at the shift of all of it; shadows alone agreed in none."""


class Motion(NamedTuple):
    """How the details of a tile differ from those of another one."""

    shift_px: tuple[float, float]
    """Columns to the right, rows down, in whole pixels."""
    gain: float
    """The correlation at the shift over that without one; inf where there is none without."""
    peak: float
    """The correlation at the shift over its standard deviation at shifts that are too far."""
    contrast: float
    """The contrast of details over that of the other tile, of equal coarser contrast."""
    match: float
    """The slope of the details against those of the other tile, of equal slope of what is coarser."""


class Bands(NamedTuple):
    """A tile in two bands of spatial frequencies, and the light around its details."""

    fine: np.ndarray  # [rows, cols] float32
    coarse: np.ndarray  # [rows, cols] float32
    level: np.ndarray  # [rows, cols] float32


def bands_of(tile: np.ndarray) -> Bands:
    """Return the bands of a tile, [rows, cols]."""
    fine, detail, coarse, level = (ndimage.gaussian_filter(tile, sigma, truncate=3.0)
                                  for sigma in (FINE_PX, DETAIL_PX, COARSE_PX, LEVEL_PX))
    return Bands(fine - detail, detail - coarse, level)


def motion_between(tile: Bands, other: Bands, usual: float) -> Motion | None:
    """Return the shift and the blur of a tile against another one; None where one of them has no details, or is too small.

    Args:
        usual: the mean of pictures under lamps as these are, of which a part counts as shade.
    """
    shape, reach = tile.fine.shape, FARTHEST_PX
    if min(shape) < 4 * reach or min(float(np.abs(band).max()) for bands in (tile, other) for band in bands) <= 0:
        return None
    window = np.outer(np.hanning(shape[0]), np.hanning(shape[1])).astype(np.float32)
    found = fft.irfft2(_correlation(tile.fine * window, other.fine * window)
                       + _correlation(*(window * relative for relative in _relative(tile, other, SHADE_PART * usual))), s=shape)
    near = np.roll(found, (reach, reach), axis=(0, 1))[:2 * reach + 1, :2 * reach + 1]
    row, column = np.unravel_index(near.argmax(), near.shape)
    here, peak = float(near[reach, reach]), float(near.max())
    far = np.roll(found, (2 * reach, 2 * reach), axis=(0, 1))
    apart = np.sqrt(((far**2).sum() - (far[:4 * reach, :4 * reach] ** 2).sum()) / max(1, far.size - (4 * reach) ** 2))
    coarse, fine = _power(other.coarse, other.coarse), _power(other.fine, other.fine)
    slope = _power(tile.coarse, other.coarse) / coarse
    contrast = np.sqrt(_power(tile.fine, tile.fine) / fine / max(_power(tile.coarse, tile.coarse) / coarse, 1e-30))
    return Motion((float(column - reach), float(row - reach)), peak / here if here > 0 else np.inf,
                  peak / max(float(apart), 1e-30), float(contrast),
                  _power(tile.fine, other.fine) / fine / slope if slope > 0 else 1.0)


def shift_between(tile: Bands, other: Bands, usual: float) -> tuple[float, float] | None:
    """Return the shift at which all of a tile and two of its quarters fit another tile, columns to the right and rows down, or None.

    The edge of a shadow, which no prediction has in its place, looks shifted too, in its quarter alone. Quarters that are too small are not
    asked.
    """
    whole = motion_between(tile, other, usual)
    if whole is None or np.hypot(*whole.shift_px) < MOVED_PX or whole.gain < MOVED_GAIN or whole.peak < MOVED_PEAK:
        return None
    rows, cols = (length // 2 for length in tile.fine.shape)
    quarters = [(slice(row, row + rows), slice(col, col + cols)) for row in (0, rows) for col in (0, cols)]
    parts = [motion_between(_part(tile, quarter), _part(other, quarter), usual) for quarter in quarters]
    asked = [part for part in parts if part is not None]
    agreeing = [part for part in asked if part.peak >= MOVED_PEAK and np.hypot(*np.subtract(part.shift_px, whole.shift_px)) < MOVED_PX]
    return None if asked and len(agreeing) < AGREEING_QUARTERS else whole.shift_px


def _part(bands: Bands, place: tuple[slice, slice]) -> Bands:
    return Bands(*(band[place] for band in bands))


def _correlation(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Fourier transform of the cross-correlation of two bands, 1 where they are alike."""
    size = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return np.asarray(fft.rfft2(first) * fft.rfft2(second).conj() / max(size, 1e-30))


def _relative(tile: Bands, other: Bands, shade: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the details of both tiles over the light around them, less where either is dark."""
    lit, expected = (np.maximum(each.level, 0) + max(shade, 1e-30) for each in (tile, other))
    both = (1 - shade / lit) * (1 - shade / expected)
    return both * tile.fine / lit, both * other.fine / expected


def _power(band: np.ndarray, other: np.ndarray) -> float:
    return float((band * other).sum())
