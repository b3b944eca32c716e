"""Estimate the recorded units of a photon: the dispersion of the background, and the step between recorded values.

Counts of photons have a variance equal to their mean. Counts that were multiplied by g, averaged over 1/g frames or divided by a sum have
a variance of g times their mean, and divided by g they are as precise as photons again.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import convolve1d

from kernels.spread import MAD_TO_SIGMA

POISSON = (0.7, 1.4)
"""Dispersions that are taken for counts of photons: the estimate is within a fifth of the truth where it is given at all."""
BLOCK_COUNTS = 100.0
"""Effective counts that a block should hold: the median of the dispersions of such blocks is within a few per cent of their mean."""
LEAST_BLOCK_COUNTS = 15.0
"""Effective counts in the middle block below which the dispersion is not estimated: its distribution is too skewed."""
BLOCK_PAIRS = (32, 1024)
"""Fewest and most pairs of neighbouring pixels in a block: more would hold returns at every time."""
COARSE = (2, 4, 8, 16)
"""Numbers of bins that are added up to see noise that neighbouring bins share."""
SHARED = 1.6
"""Ratio of the dispersions of added and of single bins from which the noise of neighbouring bins is called shared; noise
of single bins leaves it within a quarter of one."""
FEW = 0.3
"""Part of the background counts that is not zero below which most of these are one photon: five in six."""
NEAR_PAIRS, NEAR_BINS = 2, 2
"""Pairs and bins to each side of a pair and a bin that tell whether there is a return."""
NEAR_PART, NEAR_SIGMAS = 0.03, 3.0
"""Part of the height of their highest bins, and standard deviations of all their bins, above the lower of which they do."""
STEP_VALUES = 50
"""Fewest non-zero counts of which a common step counts as evidence."""
STEP_TOLERANCE = 1e-3
"""Largest distance of a value from a multiple of the step, in steps: float32 values of up to a thousand steps hold it."""


class CountScale(NamedTuple):
    """The size of a photon in a capture's counts."""

    units: float  # recorded units a photon; counts divided by it vary as photons do
    shared: bool  # neighbouring bins vary together: the histograms were smoothed
    measured: bool  # from the background; else from the step between values, or assumed


def estimate_count_scale(counts: np.ndarray) -> CountScale:
    """Estimate the recorded units a photon.

    Blocks of neighbouring pixels and two bins give the dispersion: the squared double difference (between pixels and between bins) over
    the sum of the counts, which neither even light nor a pattern of the bins changes. Returns make a few blocks larger; the median block
    has none. Where there is too little background, values that are all multiples of a step tell the scale.

    Args:
        counts: [pixel, bin] as recorded, neighbouring pixels side by side.

    Source:
        Index of dispersion: Cox, Lewis, "The Statistical Analysis of Series of Events", 1966, section 6.3.
    """
    common = _step(counts)
    single = _dispersion(counts, common)
    step = 1.0 if common is None else common
    if single is None:
        return CountScale(step, False, False)
    added = [single, *(_dispersion(_added(counts, bins), common) or 0.0 for bins in COARSE if counts.shape[1] >= 4 * bins)]
    if single < POISSON[0] and max(added) > SHARED * single:
        return CountScale(_rounded(max(added), step), True, True)
    return CountScale(_rounded(single, step), False, True)


def _added(counts: np.ndarray, bins: int) -> np.ndarray:
    """Return the sums over so many neighbouring bins."""
    return np.asarray(counts[:, : counts.shape[1] // bins * bins].reshape(len(counts), -1, bins).sum(axis=2))


def _rounded(dispersion: float, step: float) -> float:
    """Return 1 or the step where the dispersion agrees with it, else the dispersion."""
    for units in (1.0, step):
        if POISSON[0] <= dispersion / units <= POISSON[1]:
            return units
    return dispersion


def _dispersion(counts: np.ndarray, step: float | None) -> float | None:
    """Return variance over mean of the background; None where there is too little of it. `step`: of which all counts are multiples."""
    pairs = counts[: len(counts) // 2 * 2].reshape(-1, 2, counts.shape[1]).astype(np.float64)
    if len(pairs) == 0 or counts.shape[1] < 2:
        return None
    between, total = pairs[:, 0] - pairs[:, 1], pairs.sum(axis=1)
    dark = _is_background(total)
    lone = total[dark & (total > 0)]
    if len(lone) >= STEP_VALUES and len(lone) < FEW * dark.sum():
        return step or float(np.quantile(lone, 0.25))  # nearly every count is one photon, but where it is of the foot of a pulse
    dark = dark[:, 1:] & dark[:, :-1]
    squared, mean = dark * (between[:, 1:] - between[:, :-1]) ** 2, dark * (total[:, 1:] + total[:, :-1])
    size = BLOCK_PAIRS[0]
    while True:
        size = min(size, len(pairs))
        blocks = len(pairs) // size
        over, under = (array[: blocks * size].reshape(blocks, size, -1).sum(axis=1) for array in (squared, mean))
        typical = float(np.median(under))
        dispersion = float(np.median(over[under > 0] / under[under > 0])) if typical > 0 else 0.0
        effective = typical / dispersion if dispersion > 0 else 0.0
        if effective >= BLOCK_COUNTS or size >= min(len(pairs), BLOCK_PAIRS[1]):
            return dispersion if effective >= LEAST_BLOCK_COUNTS else None
        size *= 2


def _is_background(total: np.ndarray) -> np.ndarray:
    """Return where the pairs on both sides of a pair have no return, [pair, bin]; the pair's own noise has no part in it."""
    bins = convolve1d(total, np.ones(2 * NEAR_BINS + 1), axis=1, mode="constant")
    summed = convolve1d(bins, np.ones(2 * NEAR_PAIRS + 1), axis=0, mode="constant") - bins
    level = np.median(summed, axis=1, keepdims=True)
    noise = NEAR_SIGMAS * MAD_TO_SIGMA * np.median(np.abs(summed - level), axis=1, keepdims=True)
    height = NEAR_PART * (summed.max(axis=1, keepdims=True) - level)
    return np.asarray(summed <= level + np.where(noise > 0, np.minimum(noise, height), height))


def _step(counts: np.ndarray) -> float | None:
    """Return the step of which all counts are multiples, the smallest count; None where there is none."""
    values = counts[counts > 0]
    if len(values) < STEP_VALUES:
        return None
    step = float(values.min())
    multiples = values.astype(np.float64) / step
    return step if np.abs(multiples - np.rint(multiples)).max() < STEP_TOLERANCE else None
