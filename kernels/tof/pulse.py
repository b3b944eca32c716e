"""The shape of the light pulse as a histogram sees it: what share of a return falls into each bin, and how that moves with its time."""

from collections.abc import Sequence
from math import erf
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.tof.modulation import require_ascending

REACH_SIGMAS = 4.5
"""Half width of the table of a Gaussian pulse, in standard deviations: 7 in a million of its light lie outside."""
STEPS_PER_SIGMA = 24
"""Steps of the table of a Gaussian pulse in a standard deviation."""
STEPS_PER_BIN = 32
"""Steps of the table of a measured pulse in a bin."""


class Pulse(NamedTuple):
    """A pulse of unit area about time 0, tabulated evenly; times in bins."""

    begin: float  # time of the first entry
    step: float  # between entries
    cumulative: np.ndarray  # [entries] float64, 0 → 1
    density: np.ndarray  # [entries] float64, a bin

    @property
    def end(self) -> float:
        """Time of the last entry."""
        return self.begin + self.step * (len(self.density) - 1)

    @property
    def width(self) -> float:
        """Full width at half maximum, in bins."""
        return float(self.step * np.count_nonzero(self.density > 0.5 * self.density.max()))


def gaussian(sigma_bins: float) -> Pulse:
    """Return a Gaussian pulse.

    Args:
        sigma_bins: standard deviation, in bins, jitter of the detector included.

    Raises:
        ArrayError: it is not above zero.
    """
    if not (np.isfinite(sigma_bins) and sigma_bins > 0):
        raise ArrayError(f"the pulse is {sigma_bins} bins wide: give a width above zero")
    half = int(REACH_SIGMAS * STEPS_PER_SIGMA)
    x = np.arange(-half, half + 1) / STEPS_PER_SIGMA
    cumulative = np.array([0.5 * (1 + erf(value / 2**0.5)) for value in x])
    cumulative = (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])
    return Pulse(-half / STEPS_PER_SIGMA * sigma_bins, sigma_bins / STEPS_PER_SIGMA, cumulative,
                 np.exp(-0.5 * x * x) / (sigma_bins * (2 * np.pi) ** 0.5))


def measured(times_bins: Sequence[float] | np.ndarray, power: Sequence[float] | np.ndarray) -> Pulse:
    """Return a pulse from samples of its power; time 0 is that of a return at no distance.

    Args:
        times_bins: [n ≥ 3] ascending times, in bins.
        power: [n] in any unit, none negative, not all zero; between samples the power is linear, outside it is zero.

    Raises:
        ArrayError: the times are out of order, or the power is no pulse.
    """
    times, values = np.asarray(times_bins, dtype=np.float64), np.asarray(power, dtype=np.float64)
    if times.ndim != 1 or times.shape != values.shape or len(times) < 3:
        raise ArrayError(f"the pulse has {times.size} times and {values.size} powers: give three or more of each")
    require_ascending(times, "times of the pulse")
    if not np.isfinite(values).all() or values.min() < 0 or values.max() == 0:
        raise ArrayError("the powers of the pulse must be zero or more, and some above zero")
    count = max(int(np.ceil((times[-1] - times[0]) * STEPS_PER_BIN)), 2)
    grid = np.linspace(times[0], times[-1], count + 1)
    density = np.interp(grid, times, values)
    step = grid[1] - grid[0]
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]))]) * step
    return Pulse(float(times[0]), float(step), cumulative / cumulative[-1], density / cumulative[-1])
