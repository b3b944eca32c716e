"""Limits of a set of modulation frequencies: radians a metre, and the range after which all phases repeat together."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from kernels.errors import ArrayError

REPEAT_TURNS = 0.02
"""Phases that differ by less than this part of a turn count as equal: noise of 0.1 rad cannot tell closer ones apart."""
MOST_TURNS = 1000
"""Largest number of turns of the lowest frequency within which a repeat is searched: 7.5 km at 20 MHz."""


def radians_per_metre(modulation_hz: Sequence[float] | np.ndarray, light_speed: float) -> np.ndarray:
    """Return the phase [F] that a metre of range adds, 4πf/c: light goes there and back. The speed of light is in metres a second."""
    return 4 * np.pi * require_frequencies(modulation_hz) / light_speed


def require_frequencies(modulation_hz: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return modulation frequencies as [F] float64, or refuse them.
    Raises ArrayError: no frequency, or one is not above zero."""
    hz = np.asarray(modulation_hz, dtype=np.float64).reshape(-1)
    if hz.size == 0 or not np.all(np.isfinite(hz) & (hz > 0)):
        raise ArrayError(f"modulation frequencies are {list(map(float, hz))}: give one or more above zero")
    return hz


def common_range_m(modulation_hz: Sequence[float] | np.ndarray, light_speed: float) -> float:
    """Return the shortest range after which every phase repeats, within REPEAT_TURNS; equal frequencies count once.

    For whole multiples of one frequency g it is c / (2g): 14.99 m for 20, 30 and 80 MHz. Where phases repeat later than that, it is
    MOST_TURNS turns of the lowest frequency.
    """
    turns_per_metre = np.unique(radians_per_metre(modulation_hz, light_speed)) / (2 * np.pi)
    turns = np.arange(1, MOST_TURNS + 1)
    others = turns[:, None] * (turns_per_metre / turns_per_metre[0])
    repeats = np.all(np.abs(others - np.round(others)) < REPEAT_TURNS, axis=1)
    first = int(np.argmax(repeats)) if repeats.any() else MOST_TURNS - 1
    return float(turns[first] / turns_per_metre[0])


def require_span(modulation_hz: Sequence[float] | np.ndarray, nearest_m: float, farthest_m: float, light_speed: float) -> None:
    """Refuse a span that is empty, or longer than the common range of the frequencies; the message says both."""
    if not 0 <= nearest_m < farthest_m:
        raise ArrayError(f"ranges from {nearest_m:g} to {farthest_m:g} m are no span: give 0 <= nearest < farthest")
    common = common_range_m(modulation_hz, light_speed)
    if farthest_m - nearest_m > common * (1 + 1e-6):
        names = ", ".join(f"{hz / 1e6:g}" for hz in np.unique(modulation_hz))
        raise ArrayError(f"phases at {names} MHz repeat after {common:.4g} m, {farthest_m - nearest_m:.4g} m were asked for: "
                         "ask for less, or measure at one more frequency")


def require_ascending(times: Sequence[float] | np.ndarray, what: str) -> None:
    """Refuse times that do not grow, naming the first."""
    for index, (before, after) in enumerate(pairwise(times)):
        if not after > before:
            raise ArrayError(f"{what} are out of order: number {index + 1} ({after:g} s) is not after number {index} ({before:g} s)")
