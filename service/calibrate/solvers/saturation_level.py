"""The level at which the readings of a sensor saturate: one exact value that many readings of several images share, because clipping takes
their noise away.

An evenly lit background piles up too, but its noise spreads it over many values, and another light gives it another value.
"""

from typing import NamedTuple

import numpy as np

from stage.errors import CalibrationError

CODES = 1 << 16
"""Values that are told apart from 0 to the peak, as many as those of 16 bits."""
BIN = 0.01
"""The width of the bins that the level is compared with, relative to it, and by how much the level is stated below it."""
BELOW = 2
"""The least count of occupied values in a bin: of eight bits one value may hold a hundredth."""
MIN_COUNT = 20
"""The least count of saturated readings: fewer may belong to one highlight."""
SHARED, SHARED_COUNT = 2, 3
"""Images that share the level where there are as many, and readings of it in each: an even background has it in one."""
EXCESS = 3.0
"""The least ratio of the readings at the level to the mean of the two bins below, because a smooth histogram falls towards its end."""
HOT, HOT_PART = 0.02, 0.005
"""The most readings above the level, as parts of those at it and of all: hot pixels read more than any light does."""
LEAST_VALUES = 16
"""Values of a channel from which one image of a card tells that it is clipped: an even card has four of eight bits, and most readings share
the largest."""


class ChannelSaturation(NamedTuple):
    """The saturation of one channel."""

    level: float | None
    """The value at and above which readings are saturated, or None when none are."""
    readings: int
    """The count of readings at or above the level."""


class ReadingHistogram:
    """The histogram of one channel over many images, the largest value of all of which is `peak`."""

    def __init__(self, peak: float) -> None:
        self.peak = peak
        self._counts = np.zeros(CODES, dtype=np.int64)
        self._sharing = np.zeros(CODES, dtype=np.int64)
        self._images = 0

    def add(self, values: np.ndarray) -> None:
        """Count the recorded values of an image, an array of any shape."""
        if self.peak > 0:
            parts = values.reshape(-1).astype(np.float32) / np.float32(self.peak)
            codes = np.rint(np.maximum(parts, 0) * (CODES - 1)).astype(np.int64)
            counts = np.bincount(codes, minlength=CODES)
            self._counts += counts
            self._sharing += counts >= SHARED_COUNT
        self._images += 1

    def saturation(self) -> ChannelSaturation:
        """Return the saturation of the channel: the value that most readings share of those with few above them, where they are more than
        the values below explain."""
        at_or_above = np.cumsum(self._counts[::-1])[::-1]
        above = at_or_above - self._counts
        possible = (self._counts >= MIN_COUNT) & (self._sharing >= min(SHARED, self._images))
        possible &= (above <= HOT * self._counts) & (above <= HOT_PART * at_or_above[0])
        found = [code for code in np.flatnonzero(possible).tolist() if code and self._counts[code] > EXCESS * (self._below(code) + 1)]
        if not found:
            return ChannelSaturation(None, 0)
        code = max(found, key=lambda each: int(self._counts[each]))
        least = int(np.ceil(code * (1 - BIN)))
        return ChannelSaturation(self.peak * code / (CODES - 1) * (1 - BIN), int(at_or_above[least]))

    @property
    def values(self) -> int:
        """Return how many values were read."""
        return int(np.count_nonzero(self._counts))

    def _below(self, code: int) -> float:
        """Return the mean count of readings in the two bins below a value."""
        occupied = np.flatnonzero(self._counts[:code])[-BELOW:]
        width = max(BIN * code, float(code - occupied[0]) if len(occupied) == BELOW else code)
        return float(self._counts[max(int(code - 2 * width), 0):code].sum()) / 2


def clipped_level(readings: np.ndarray) -> float:
    """Return the level at and above which the readings of one image of a card, [readings, 3] as recorded, are clipped; infinity where
    none are, or where no channel has values enough to tell."""
    histograms = [ReadingHistogram(float(channel.max(initial=0.0))) for channel in readings.T]
    for histogram, channel in zip(histograms, readings.T, strict=True):
        histogram.add(channel)
    if max(histogram.values for histogram in histograms) < LEAST_VALUES:
        return np.inf
    found = [histogram.saturation().level for histogram in histograms if histogram.values == 1 or histogram.values >= LEAST_VALUES]
    return min((level for level in found if level is not None), default=np.inf)


def capture_saturation(channels: list[ChannelSaturation]) -> float:
    """Return the saturation of a capture, one number for all channels: the least level of a channel, to four digits.
    Raises CalibrationError if no channel saturates."""
    levels = [channel.level for channel in channels if channel.level is not None]
    if not levels:
        raise CalibrationError("no channel piles up at one value that is its largest: nothing shows where readings saturate")
    return float(f"{min(levels):.4g}")
