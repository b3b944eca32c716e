"""Shift and blur of a tile against the same tile of another picture or of a prediction, by their details.

Details are a band of spatial frequencies. The peak of the cross-correlation of both tiles' details is at the shift between them. Blur takes
details away: their contrast falls against that of a coarser band, and only what is left of them fits those of the other tile. Where two
tiles merely differ, as under another light, the contrast stays.
"""

from typing import NamedTuple

import numpy as np
from scipy import fft, ndimage

FINE_PX, DETAIL_PX, COARSE_PX = 0.7, 2.0, 6.0
"""Details lie between smoothing by the first and the second standard deviation, what is coarser between the second and the third."""
FARTHEST_PX = 12
"""The farthest shift that is looked for."""


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
