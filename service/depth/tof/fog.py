"""Fog in histograms: light that every pixel sees from near on, and that falls with distance until the pixel's surface stands there.

Its peak is no surface, though it is often the strongest return; and a surface within it stands on a slope, which shifts its time.
"""

from typing import NamedTuple

import numpy as np

EVEN = 0.35
"""Largest robust relative deviation of the foot's height over the pixels: surfaces differ more, in albedo and distance."""
SHARED = 0.9
"""Part of the pixels that must show the foot."""
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
ELSEWHERE, VARIED_BINS = 0.3, 2.0
"""Least part of the pixels with a return behind the foot's peak that is none of the foot, and least deviation of their bins."""
NEAR_M = 0.6
"""Distance of the foot's peak up to which it is fog whatever is seen behind it."""
ABOVE = 1.0
"""Least photons of a return over those of the foot in its bins, for it to be a surface."""


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
    if 0.5 * (high - low) > np.hypot(EVEN * middle, chance) or (height > 0.4 * middle).mean() < SHARED:
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
