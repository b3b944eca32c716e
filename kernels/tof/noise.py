"""The noise of correlation images, estimated from the images: variance against level, a photon transfer curve."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.tof.continuous import LEAST_PHASES, Noise, weights

BINS = 24
"""Number of bins over the level, each with the same number of pixels."""
LEAST_IN_BIN = 32
"""Least number of readings in a bin. With fewer than three bins no line is fitted, and all noise counts as read noise."""
LEAST_READ_ELECTRONS = 5.0
"""Read noise in electrons that is assumed where every part of the image is too bright to show it: black pixels must not pass for noise-free
ones."""
HIDDEN = 4.0
"""The read noise cannot be measured when the variance of shot noise in the darkest bin is more than this many times that of
LEAST_READ_ELECTRONS."""
CHI_SQUARED_MEDIAN = 0.4549
"""Median of chi-squared with one degree of freedom."""


def estimate_noise(images: np.ndarray, modulation_hz: Sequence[float] | np.ndarray, reference_phase_rad: Sequence[float] | np.ndarray,
                   *, cols: int, scale: Sequence[float] | np.ndarray | None = None, usable: np.ndarray | None = None) -> Noise:
    """Fit variance = read² + shot · level.

    Where frequencies have four images or more, what their least-squares fit leaves is noise whatever the scene is. Three images fit
    exactly; then two stand-ins are taken, which other things can make larger but nothing smaller, and of both the smaller one:
    differences of the offsets of two frequencies, and second differences along the rows.

    Args:
        images: [M, pixel] float32.
        modulation_hz, reference_phase_rad: [M].
        cols: of the image.
        scale: [M] factor of each image (unequal exposures); None: 1.
        usable: [pixel] bool; None: all.

    Returns:
        The noise, in the unit of the images; none where no pixel is usable.

    Raises:
        ArrayError: three images of one frequency on an image without three pixels in a row: the message says what to give instead.

    Source:
        Photon transfer: Janesick, "Photon Transfer", SPIE 2007.
    """
    keep = np.isfinite(images).all(axis=0)
    if usable is not None:
        keep &= usable
    rows, frequencies, index = weights(modulation_hz, reference_phase_rad, scale)
    delta = np.asarray(reference_phase_rad, dtype=np.float64)
    if not keep.any():
        return Noise(0.0, 0.0)
    factor = np.ones_like(delta) if scale is None else np.asarray(scale, dtype=np.float64)
    fitted, steady, spatial = _Pairs([], []), _Pairs([], []), _Pairs([], [])
    before: np.ndarray | None = None
    for f in range(len(frequencies)):
        mine = images[index == f].astype(np.float64)
        if len(mine) > LEAST_PHASES:
            matrix = np.stack([np.ones(len(mine)), np.cos(delta[index == f]), np.sin(delta[index == f])], axis=1)
            matrix /= factor[index == f, None]  # in units of what the exposure records
            left = np.linalg.svd(matrix)[0][:, LEAST_PHASES:]  # unit vectors that no (P, a, b) reaches: each sees pure noise
            fitted.add(((left**2).T @ mine)[:, keep], (left.T @ mine)[:, keep] ** 2)
            continue
        parts = rows[index == f, 0]
        offset = parts @ mine
        if before is not None:
            steady.add((0.5 * (offset + before))[keep], ((offset - before) ** 2 / (2 * (parts**2).sum()))[keep])
        before = offset
        grid, whole = mine.reshape(len(mine), -1, cols), keep.reshape(-1, cols)
        inside = (whole[:, :-2] & whole[:, 1:-1] & whole[:, 2:])[None].repeat(len(mine), axis=0)
        bend = grid[..., :-2] - 2 * grid[..., 1:-1] + grid[..., 2:]
        spatial.add(((grid[..., :-2] + 4 * grid[..., 1:-1] + grid[..., 2:]) / 6)[inside], (bend**2 / 6)[inside])
    given = [pairs.fit() for pairs in ((fitted,) if fitted.levels else (steady, spatial)) if sum(map(len, pairs.levels)) > 0]
    if not given:
        raise ArrayError("the image has no three usable pixels in a row to estimate the noise from: "
                         "give a calibration with the electrons of a unit and the read noise")
    level = float(np.median(images[:, keep]))
    return min(given, key=lambda noise: noise.read**2 + noise.shot * max(level, 0.0))


class _Pairs(NamedTuple):
    """Levels and the squared noise at them, from one estimator."""

    levels: list[np.ndarray]
    squares: list[np.ndarray]

    def add(self, level: np.ndarray, squared: np.ndarray) -> None:
        self.levels.append(level.reshape(-1))
        self.squares.append(squared.reshape(-1))

    def fit(self) -> Noise:
        return _fit(np.concatenate(self.levels), np.concatenate(self.squares))


def _fit(level: np.ndarray, squared: np.ndarray) -> Noise:
    """Return the noise model whose line passes through the medians of squared noise over bins of level; neither coefficient is below
    zero."""
    bins = min(BINS, len(level) // LEAST_IN_BIN)
    if bins < 3:
        return Noise(0.0, float(squared.mean()) ** 0.5)
    edges = np.array_split(np.argsort(level), bins)
    x = np.array([level[part].mean() for part in edges])
    y = np.array([np.median(squared[part]) for part in edges]) / CHI_SQUARED_MEDIAN
    weight = 1 / np.maximum(y, 1e-12 * max(float(np.abs(x).max()), 1e-30) ** 2)  # the error of a variance is in proportion to it
    for _ in range(3):
        sx, sy, s1 = (weight**2 * x).sum(), (weight**2 * y).sum(), (weight**2).sum()
        sxx, sxy = (weight**2 * x * x).sum(), (weight**2 * x * y).sum()
        bottom = s1 * sxx - sx * sx
        shot = (s1 * sxy - sx * sy) / bottom if bottom > 0 else 0.0
        base = (sy - shot * sx) / s1
        if shot < 0:
            shot, base = 0.0, sy / s1
        elif base < 0:
            shot, base = (sxy / sxx if sxx > 0 else 0.0), 0.0
        model = base + shot * np.maximum(x, 0)
        weight = 1 / np.maximum(model, model.max() * 1e-6 + 1e-30)
    shot, base = max(float(shot), 0.0), max(float(base), 0.0)
    unseen = (LEAST_READ_ELECTRONS * shot) ** 2
    if shot * float(x.min()) > HIDDEN * unseen:
        base = max(base, unseen)
    return Noise(shot, base**0.5)
