"""The saturation level of a camera, from readings that accumulate at the top of the histogram of a capture."""

from typing import NamedTuple

import numpy as np

from stage.errors import CalibrationError

BIN = 0.01
"""The width of the compared bins, relative to the largest value."""
MIN_COUNT = 20
"""The least count of saturated readings: fewer may belong to one highlight."""
EXCESS = 3.0
"""The least ratio of the readings in the top bin to the mean of the two bins below, because a smooth histogram falls towards its end."""


class ChannelSaturation(NamedTuple):
    """The saturation of one channel."""

    level: float | None
    """The value at and above which readings are saturated, or None when none are."""
    readings: int
    """The count of readings at or above the level."""


class TopHistogram:
    """The three topmost bins of the histogram of one channel over many images, whose largest value must be known."""

    def __init__(self, peak: float) -> None:
        """Start with empty bins.

        Args:
            peak: the largest value of the channel in all images.
        """
        self.peak = peak
        self._counts = np.zeros(3, dtype=np.int64)

    def add(self, values: np.ndarray) -> None:
        """Count the recorded values of an image, an array of any shape."""
        if self.peak > 0:
            edges = self.peak * (1 - BIN * np.array([3, 2, 1]))
            above = [int((values >= edge).sum()) for edge in edges]
            self._counts += [above[2], above[1] - above[2], above[0] - above[1]]

    def saturation(self) -> ChannelSaturation:
        """Return the saturation of the channel: whether the top bin holds more readings than the bins below explain."""
        top, *below = (int(count) for count in self._counts)
        saturated = top >= MIN_COUNT and top > EXCESS * (sum(below) / len(below) + 1)
        return ChannelSaturation(self.peak * (1 - BIN) if saturated else None, top if saturated else 0)


def capture_saturation(channels: list[ChannelSaturation]) -> float:
    """Return the saturation of a capture, one number for all channels: the least level of a channel, to four digits.

    Raises:
        CalibrationError: no channel saturates.
    """
    levels = [channel.level for channel in channels if channel.level is not None]
    if not levels:
        raise CalibrationError("no channel piles up at its largest value: nothing shows where readings saturate")
    return float(f"{min(levels):.4g}")
