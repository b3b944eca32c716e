"""Where readings stop following the light: the top of the histogram, when it piles up there."""

from typing import NamedTuple

import numpy as np

from stage.errors import CalibrationError

BAND = 0.01
"""Width of the bands that are compared, as a part of the largest value."""
MIN_COUNT = 20
"""Readings that make a pile: fewer may be the sparkle of one highlight."""
PILE = 3.0
"""A pile holds this many times what the two bands below it hold on average: a smooth histogram falls off towards its end."""


class Pile(NamedTuple):
    """What one channel's histogram says."""

    level: float | None
    """The value at and above which readings are saturated; None: nothing piles up."""
    readings: int
    """Readings at or above it."""


class TopHistogram:
    """The top of the histogram of one channel over many images; `peak` must be known first."""

    def __init__(self, peak: float) -> None:
        """Args: peak: the largest value of the channel in any of the images."""
        self.peak = peak
        self._counts = np.zeros(3, dtype=np.int64)

    def add(self, values: np.ndarray) -> None:
        """Count recorded values of any shape."""
        if self.peak > 0:
            edges = self.peak * (1 - BAND * np.array([3, 2, 1]))
            above = [int((values >= edge).sum()) for edge in edges]
            self._counts += [above[2], above[1] - above[2], above[0] - above[1]]

    def pile(self) -> Pile:
        """Whether the last band holds more than those below it explain."""
        top, *below = (int(count) for count in self._counts)
        piled = top >= MIN_COUNT and top > PILE * (sum(below) / len(below) + 1)
        return Pile(self.peak * (1 - BAND) if piled else None, top if piled else 0)


def suggest(piles: list[Pile]) -> float:
    """The capture's saturation: the least level of any channel, since one number stands for all.

    Raises:
        CalibrationError: no channel piles up.
    """
    levels = [pile.level for pile in piles if pile.level is not None]
    if not levels:
        raise CalibrationError("no channel piles up at its largest value: nothing shows where readings saturate")
    return float(f"{min(levels):.4g}")
