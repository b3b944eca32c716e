"""Light in photon histograms that all pixels share and that shows no surface: the camera's own, bins that its timer fills, and fog.

Fog is seen by every pixel from near on, and falls with distance until the pixel's surface stands there. Its peak is often the strongest
return; and a surface within it stands on a slope, which shifts its time.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.tof.histogram.pileup import LiveCounts

SAME_BIN = 1
"""Bins by which the highest bin of a pixel may be off that of the pattern."""
MOST_PIXELS = 0.95
"""Part of the pixels whose highest bin is the pattern's."""
EVEN, EVEN_FOG = 0.3, 0.35
"""Largest robust relative deviations of the height of a pattern, and of fog, over the pixels: surfaces differ more, in albedo and
distance."""
HIDDEN = 0.5
"""Least part of the pixels that show a return elsewhere: without one, a single flat wall is all there is."""
RETURN_SIGMAS = 6.0
"""Standard deviations above the background from which a bin elsewhere is a return."""
VARIED_BINS = 2.0
"""Least standard deviation of the bins of these returns, and of those behind fog: what follows at one distance belongs to it."""
RAISED = 1.1
"""Ratio of the median pixel's count to the background up to which a bin is free of the pattern."""
SHARED = 0.9
"""Part of the pixels that must show the foot of fog."""
CLEAR_SIGMAS = 5.0
"""Deviations of photon noise from which a count is light."""
TYPICAL = 35.0
"""Percentile over the pixels that a bin of the foot is taken from: some surfaces lie before it, and none or few at it."""
END = 0.02
"""Part of the foot's peak at which it ends."""
LONGER = 2.0
"""Bins by which the foot ends behind its peak, over those by which it begins before: a pulse is as long on both sides."""
LEAST_BINS = 3
"""The least number of these bins."""
HEAD = 0.3
"""Part of the foot's peak above which its bins hold no return that could be told."""
ELSEWHERE = 0.3
"""Least part of the pixels with a return behind the foot's peak that is none of the foot."""
NEAR_M = 0.6
"""Distance of the foot's peak up to which it is fog whatever is seen behind it."""
ABOVE = 1.0
"""Least photons of a return over those of the foot in its bins, for it to be a surface."""


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


class Fog(NamedTuple):
    """Light that fog returns to all pixels."""

    foot: np.ndarray  # [bin] photons
    head: np.ndarray  # [bin] bool: its brightest bins

    def stands_out(self, counts: np.ndarray, background: np.ndarray, position: np.ndarray, width: float) -> np.ndarray:
        """Return where returns at positions [pixel] in bins are brighter than the fog about them, [pixel] bool, by photons [pixel, bin]
        and the background [pixel] in bins that are not the head's."""
        pixels, bins = counts.shape
        reach = 2 * max(width, 0.5)
        first = np.clip(np.floor(position - reach), 0, bins).astype(int)
        last = np.clip(np.ceil(position + reach), 0, bins).astype(int)
        own = np.cumsum(np.pad(np.where(self.head, 0, counts), ((0, 0), (1, 0))), axis=1, dtype=np.float64)
        foot, even = (np.cumsum(np.append(0.0, np.where(self.head, 0, values))) for values in (self.foot, np.ones(bins)))
        seen, of_fog, level = (own[np.arange(pixels), last] - own[np.arange(pixels), first], foot[last] - foot[first],
                               (even[last] - even[first]) * background)
        more = seen - of_fog - level
        return np.asarray((more > ABOVE * of_fog) & (more > CLEAR_SIGMAS * np.sqrt(of_fog + level + 1)))

    def shift(self, position: np.ndarray, photons: np.ndarray, width: float) -> np.ndarray:
        """Return by how many bins the slope of the foot may shift returns of so many photons: the moment of the slope over two widths."""
        slope = np.interp(position - 0.5, np.arange(len(self.foot)), np.abs(np.gradient(self.foot)))
        return np.asarray(slope * 2 * (2 * max(width, 0.5)) ** 3 / 3 / np.maximum(photons, 1))


def find_fog(counts: np.ndarray, start_m: float, bin_m: float) -> Fog | None:
    """Return the light of fog in photons [pixel, bin]; None if there is none, or if it may be an even wall that a pulse with a tail lights:
    farther than NEAR_M, with no returns behind it."""
    bright = counts[counts.sum(axis=1) > 0]
    if len(bright) < 50:
        return None
    typical = np.percentile(bright, TYPICAL, axis=0)
    level = float(np.percentile(typical, 20))
    place = int(typical.argmax())
    peak = float(typical[place]) - level
    if peak <= CLEAR_SIGMAS * np.sqrt(level + 1):
        return None
    height = bright[:, max(place - 1, 0) : place + 2].sum(axis=1) - 3 * level
    low, middle, high = np.quantile(height, [0.16, 0.5, 0.84])
    chance = np.sqrt(max(middle, 0) + 3 * level)
    if 0.5 * (high - low) > np.hypot(EVEN_FOG * middle, chance) or (height > 0.4 * middle).mean() < SHARED:
        return None
    foot = np.maximum(typical - level, 0)
    foot[place:] = np.minimum.accumulate(foot[place:])
    least = max(END * peak, 0.5 * np.sqrt(level + 1))
    behind = int(np.argmax(np.append(foot[place:], 0) < least))
    before = int(np.argmax(np.append(foot[: place + 1][::-1], 0) < least))
    if behind < max(LONGER * before, before + LEAST_BINS):
        return None
    head = foot > HEAD * peak
    rest = np.where(np.arange(len(foot)) > place + 1, bright - foot - level, 0) * ~head
    noise = np.sqrt(foot + level + 1)
    there = (rest > CLEAR_SIGMAS * noise).any(axis=1)
    if start_m + place * bin_m < NEAR_M:
        return Fog(foot, head)
    if there.mean() < ELSEWHERE or (rest[there] / noise).argmax(axis=1).std() < VARIED_BINS:
        return None
    return Fog(foot, head)
