"""Light and electrical pulses that every histogram shows at the same time: the camera's own cover, a reference channel, crosstalk."""

import numpy as np
import warp as wp

from kernels.tof.pileup import LiveCounts

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
    """Return the bins that hold a pattern which all pixels share, [bin] bool; none where there is no such pattern.

    Args:
        counts: [pixel, bin] photons.
    """
    bins = counts.shape[1]
    none = np.zeros(bins, dtype=bool)
    bright = counts[counts.sum(axis=1) > 0]
    if len(bright) == 0:
        return none
    highest = bright.argmax(axis=1)
    place = int(np.median(highest))
    if (np.abs(highest - place) <= SAME_BIN).mean() < MOST_PIXELS:
        return none
    height = bright[:, max(place - SAME_BIN, 0) : place + SAME_BIN + 1].sum(axis=1)
    low, middle, high = np.quantile(height, [0.16, 0.5, 0.84])
    if 0.5 * (high - low) > EVEN * middle:
        return none
    typical = np.median(bright, axis=0)
    level = np.median(typical)
    raised = typical > RAISED * level
    inside = none.copy()
    inside[max(place - SAME_BIN, 0) : place + SAME_BIN + 1] = True
    for step in (-1, 1):
        i = place + step * (SAME_BIN + 1)
        while 0 <= i < bins and raised[i]:
            inside[i] = True
            i += step
    if inside.sum() > bins // 2:
        return none
    rest = np.where(inside, 0, bright)
    background = np.median(bright[:, ~inside], axis=1)
    there = rest.max(axis=1) > background + RETURN_SIGMAS * np.sqrt(np.maximum(background, 1))
    if there.mean() < HIDDEN or rest[there].argmax(axis=1).std() < VARIED_BINS:
        return none
    return inside


def without_bins(histograms: LiveCounts, bins: np.ndarray) -> LiveCounts:
    """Return histograms in which these bins, [bin] bool, count as never open; waits for the device."""
    device = str(histograms.counts.device)
    kept = [np.where(bins[:, None], 0, array.numpy()) for array in (histograms.counts, histograms.live)]
    return LiveCounts(*(wp.array(values, dtype=wp.float32, device=device) for values in kept), histograms.pulses)
