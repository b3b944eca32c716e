"""Bins of photon histograms that all pixels share, which show no surface: the camera's own light, and bins that its timer fills."""

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.tof.histogram.pileup import LiveCounts

SAME_BIN = 1
"""Bins by which the highest bin of a pixel may be off that of the pattern."""
MOST_PIXELS = 0.95
"""Part of the pixels whose highest bin is the pattern's."""
EVEN = 0.3
"""Largest robust relative deviation of the pattern's height over the pixels: surfaces differ more, in albedo and distance."""
HIDDEN = 0.5
"""Least part of the pixels that show a return elsewhere: without one, a single flat wall is all there is."""
RETURN_SIGMAS = 6.0
"""Standard deviations above the background from which a bin elsewhere is a return."""
VARIED_BINS = 2.0
"""Least standard deviation of the bins of these returns: what follows the pattern at one distance belongs to it."""
RAISED = 1.1
"""Ratio of the median pixel's count to the background up to which a bin is free of the pattern."""


def pattern_bins(counts: np.ndarray) -> np.ndarray:
    """Return the bins that hold a pattern which all pixels share, [bin] bool, in [pixel, bin] photons; none if there is no such pattern."""
    bins = counts.shape[1]
    none = np.zeros(bins, dtype=bool)
    bright = counts[counts.sum(axis=1) > 0]
    if len(bright) == 0:
        return none
    typical = np.median(bright, axis=0)
    inside = _shared_pulse(bright, typical)
    if not inside.any():
        inside = _hot_bins(typical)
    if not 0 < inside.sum() <= bins // 2:
        return none
    rest = np.where(inside, 0, bright)
    background = np.median(bright[:, ~inside], axis=1)
    there = rest.max(axis=1) > background + RETURN_SIGMAS * np.sqrt(np.maximum(background, 1))
    if there.mean() < HIDDEN or rest[there].argmax(axis=1).std() < VARIED_BINS:
        return none
    return inside


def _shared_pulse(bright: np.ndarray, typical: np.ndarray) -> np.ndarray:
    """Return the bins of a pulse that is the highest of nearly all pixels, and even, [bin] bool.
    `bright`: [pixel, bin] photons. `typical`: [bin] those of the median pixel."""
    inside = np.zeros(len(typical), dtype=bool)
    highest = bright.argmax(axis=1)
    place = int(np.median(highest))
    if (np.abs(highest - place) <= SAME_BIN).mean() < MOST_PIXELS:
        return inside
    height = bright[:, max(place - SAME_BIN, 0) : place + SAME_BIN + 1].sum(axis=1)
    low, middle, high = np.quantile(height, [0.16, 0.5, 0.84])
    if 0.5 * (high - low) > EVEN * middle:
        return inside
    raised = typical > RAISED * np.median(typical)
    inside[max(place - SAME_BIN, 0) : place + SAME_BIN + 1] = True
    for step in (-1, 1):
        i = place + step * (SAME_BIN + 1)
        while 0 <= i < len(inside) and raised[i]:
            inside[i] = True
            i += step
    return inside


def _hot_bins(typical: np.ndarray) -> np.ndarray:
    """Return single bins that are far fuller than those beside them in most pixels, as those of a timer that counts its own clock, [bin]
    bool; a pulse is wider. `typical`: [bin] photons of the median pixel."""
    framed = np.pad(typical, 1, mode="reflect")
    beside = np.maximum(framed[:-2], framed[2:])
    return np.asarray((typical - beside > RETURN_SIGMAS * np.sqrt(np.maximum(beside, 1))) & (beside <= RAISED * np.median(typical) + 1))


def without_bins(histograms: LiveCounts, bins: np.ndarray) -> LiveCounts:
    """Return histograms in which these bins, [bin] bool, count as never open; waits for the device."""
    device = str(histograms.counts.device)
    kept = [np.where(bins[:, None], 0, to_numpy(array)) for array in (histograms.counts, histograms.live)]
    return LiveCounts(*(wp.array(values, dtype=wp.float32, device=device) for values in kept), histograms.pulses)
