"""The exponent of a projector from three or four phase frames alone: how the modulation of a wave changes along the wave.

Three shifts leave no reading over that a bent wave could misfit. But its second harmonic adds to the fitted amplitude in turn with three
times the phase; the amplitude over the mean does not depend on albedo, and under an unbent wave not on the phase. What else changes it,
ambient light and blur, changes slowly over the wave or not with it at all.
"""

from collections.abc import Sequence

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from kernels.structured.response import bent_wave, fitted_curve

BINS, IN_A_BIN, LEAST_BINS = 36, 30, 24
"""Parts of a turn, pixels that tell the modulation in one of them, and number of these that must be seen."""
CLEAR_SIGMAS = 20.0
"""Least amplitude of pixels that tell it, in its standard deviations."""
TREND = 3
"""Number of terms of the polynomial that other changes of the modulation may follow along the wave."""
MISFIT = 0.25
"""Part of the misfit of an unbent wave that a bent one must leave at most."""
LEAST_CHANGE = 0.02
"""Root mean square change of the modulation along the wave, as a part of it, below which it is even."""


def exponent_of_swing(grey: np.ndarray, shifts: Sequence[float], period_px: float, exponents: Sequence[float], noise: NoiseModel) -> float:
    """Return the exponent γ of light = level^γ that explains how the modulation changes along the wave; 1.0 where it does not change so.
    `grey`: [frames, pixels] readings of one period, without saturated ones. `shifts`: of each frame in turns."""
    own = np.array(shifts)
    table = weights(own, period_px)
    mean, along, across = table.T @ grey
    swing = np.hypot(along, across)
    deviation = np.sqrt((noise.read**2 + noise.gain * np.maximum(mean, 0)) * (table[:, 1:]**2).sum(axis=0).max())
    good = (swing > CLEAR_SIGMAS * deviation) & (mean > 0)
    ratio = np.log(swing[good] / mean[good])
    place = (np.arctan2(across[good], along[good]) / (2 * np.pi) % 1.0 * BINS).astype(int) % BINS
    seen = np.flatnonzero(np.bincount(place, minlength=BINS) >= IN_A_BIN)
    if len(seen) < LEAST_BINS:
        return 1.0
    modulation = np.array([np.median(ratio[place == part]) for part in seen])
    turns = (seen + 0.5) / BINS
    trend = np.vander(turns - 0.5, TREND)
    misfit = {}
    for exponent in exponents:
        curve, level = fitted_curve(bent_wave(np.linspace(0, 1, 256)**exponent), table, own)
        fitted = np.angle(curve) / (2 * np.pi) % 1.0
        order = np.argsort(fitted)
        expected = np.interp(turns, fitted[order], np.log(np.abs(curve) / level)[order], period=1.0)
        rest = modulation - expected
        misfit[exponent] = float(np.sqrt(np.mean((rest - trend @ np.linalg.lstsq(trend, rest, rcond=None)[0])**2)))
    best = min(misfit, key=lambda exponent: misfit[exponent])
    return best if misfit[1.0] > LEAST_CHANGE and misfit[best]**2 < MISFIT * misfit[1.0]**2 else 1.0
