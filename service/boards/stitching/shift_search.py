"""The coarse search for the shift of one patch of heights against another: masked differences at every shift of whole pixels.

Source: Padfield, "Masked object registration in the Fourier domain", IEEE Transactions on Image Processing 21(5), 2012.
"""

import numpy as np
from scipy.ndimage import minimum_filter

from service.boards.stitching.form import without_plane
from service.boards.stitching.grid import HeightPatch, robust_sigma

MOST_CANDIDATES = 8
LEAST_PIXELS = 400
"""The fewest common pixels with which two patches overlap."""
SHARED_PX = 9.0
"""Pixels that share an error of interpolation: the evidence of the pixels is divided by it."""


def find_shifts(first: HeightPatch, second: HeightPatch, rows: slice, cols: slice, *, pixels: int, sigma_px: float,
                search_px: int) -> list[tuple[int, int]]:
    """Return the shifts of whole pixels at which the mean squared difference has a minimum, the most probable first, and no shift.

    Args:
        second: the patch that moves.
        rows, cols: of the grid: what both have in common where the stage says that they are.
        pixels: how many of these are measured in both.
        sigma_px: standard deviation of the shift, pixels.
        search_px: the largest shift; 0 gives no shift alone.
    """
    if search_px == 0:
        return [(0, 0)]
    top, left, shape = rows.start, cols.start, (rows.stop - rows.start, cols.stop - cols.start)
    a = _detrended(first, top, left, shape, 0)
    b = _detrended(second, top, left, shape, search_px)
    score = _differences(a, b, search_px)
    if not np.isfinite(score).any():
        return [(0, 0)]
    steps = np.arange(-search_px, search_px + 1)
    around = minimum_filter(np.where(np.isfinite(score), score, np.inf), 3, mode="constant", cval=np.inf)
    lowest = np.isfinite(score) & (score <= around)
    prior = (steps[:, None] ** 2 + steps[None] ** 2) / (2 * sigma_px**2)
    cost = pixels / SHARED_PX / 2 * np.log(np.maximum(score, 1e-30)) + prior
    at = np.argwhere(lowest)
    order = np.argsort(cost[lowest])[:MOST_CANDIDATES]
    found = [(int(steps[i]), int(steps[j])) for i, j in at[order]]
    return found if (0, 0) in found else [*found, (0, 0)]


def _detrended(patch: HeightPatch, top: int, left: int, shape: tuple[int, ...], margin: int) -> np.ndarray:
    """Return a window of a patch, `margin` larger on every side, less a plane and with spikes clipped; NaN outside."""
    window = np.full((shape[0] + 2 * margin, shape[1] + 2 * margin), np.nan)
    row, col = top - margin - patch.row, left - margin - patch.col
    rows = slice(max(row, 0), min(row + window.shape[0], patch.height.shape[0]))
    cols = slice(max(col, 0), min(col + window.shape[1], patch.height.shape[1]))
    window[rows.start - row : rows.stop - row, cols.start - col : cols.stop - col] = patch.height[rows, cols]
    there = np.isfinite(window)
    y, x = np.nonzero(there)
    values = window[there]
    kept = np.abs(values - np.median(values)) <= 5 * max(robust_sigma(values), 1e-12)
    values = without_plane(values, x / window.shape[1], y / window.shape[0], kept)
    window[there] = np.clip(values, *np.percentile(values, [0.5, 99.5]))
    return window


def _differences(a: np.ndarray, b: np.ndarray, reach: int) -> np.ndarray:
    """Return the variance of a − b over their common pixels for every shift of b up to `reach`, [2 reach + 1]²; NaN with too few."""
    shape = [length + 2 * reach for length in b.shape]

    def transform(values: np.ndarray) -> np.ndarray:
        return np.fft.rfft2(values, shape)

    mask_a, mask_b = np.isfinite(a), np.isfinite(b)
    fa, fb = np.where(mask_a, a, 0), np.where(mask_b, b, 0)
    ma, mb, ha, hb = (transform(values.astype(np.float64)) for values in (mask_a, mask_b, fa, fb))
    sa, sb = transform(fa * fa), transform(fb * fb)

    def correlate(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        whole = np.fft.irfft2(np.conj(one) * other, shape)[: 2 * reach + 1, : 2 * reach + 1]
        return whole[::-1, ::-1]  # the window of b begins `reach` before that of a: a shift of b by s is the lag reach − s

    count = correlate(ma, mb)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (correlate(ha, mb) - correlate(ma, hb)) / count
        square = (correlate(sa, mb) + correlate(ma, sb) - 2 * correlate(ha, hb)) / count
        return np.where(count >= max(LEAST_PIXELS, 0.3 * count.max()), square - mean**2, np.nan)
