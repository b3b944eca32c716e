"""The shape of the light pulse as a histogram sees it: what share of a return falls into each bin, and how that moves with its time."""

from collections.abc import Sequence
from math import erf
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.tof.continuous.modulation import require_ascending

REACH_SIGMAS = 4.5
"""Half width of the table of a Gaussian pulse, in standard deviations: 7 in a million of its light lie outside."""
STEPS_PER_SIGMA = 24
"""Steps of the table of a Gaussian pulse in a standard deviation."""
STEPS_PER_BIN = 32
"""Steps of the table of a measured pulse in a bin."""
REACH_TAILS = 6.0
"""Length of the table of a tail, in decay times: 2 in a thousand of the tail's light come later."""


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

    @property
    def mean(self) -> float:
        """Mean time of the light, in bins after time 0."""
        times = self.begin + self.step * np.arange(len(self.density))
        return float((times * self.density).sum() / self.density.sum())

    def stretched(self, factor: float) -> "Pulse":
        """Return the pulse that is so many times as long."""
        return Pulse(factor * self.begin, factor * self.step, self.cumulative, self.density / factor)


def gaussian(sigma_bins: float) -> Pulse:
    """Return a Gaussian pulse of this standard deviation in bins, jitter of the detector included."""
    if not (np.isfinite(sigma_bins) and sigma_bins > 0):
        raise ArrayError(f"the pulse is {sigma_bins} bins wide: give a width above zero")
    half = int(REACH_SIGMAS * STEPS_PER_SIGMA)
    x = np.arange(-half, half + 1) / STEPS_PER_SIGMA
    cumulative = np.array([0.5 * (1 + erf(value / 2**0.5)) for value in x])
    cumulative = (cumulative - cumulative[0]) / (cumulative[-1] - cumulative[0])
    return Pulse(-half / STEPS_PER_SIGMA * sigma_bins, sigma_bins / STEPS_PER_SIGMA, cumulative,
                 np.exp(-0.5 * x * x) / (sigma_bins * (2 * np.pi) ** 0.5))


def with_tail(sigma_bins: float, tail_bins: float, part: float) -> Pulse:
    """Return a Gaussian pulse of which a part arrives late, after an exponentially distributed delay; time 0 is that of the highest power.

    Args:
        sigma_bins: standard deviation of the Gaussian, in bins.
        tail_bins: decay time of the tail, in bins.
        part: of the photons that are delayed, 0…1.

    Source:
        The jitter of a silicon photodiode, a Gaussian peak and a diffusion tail: Cova, Ghioni, Lacaita, Samori, Zappa, "Avalanche
        photodiodes and quenching circuits for single-photon detection", Applied Optics 35(12), 1996.
    """
    if not (np.isfinite(tail_bins) and tail_bins > 0 and 0 <= part <= 1):
        raise ArrayError(f"the tail decays in {tail_bins} bins and holds {part} of the photons: give a time above zero and a part of 0…1")
    prompt = gaussian(sigma_bins)
    late = int(np.ceil(REACH_TAILS * tail_bins / prompt.step))
    density = np.concatenate([prompt.density, np.zeros(late)])
    decay = np.exp(-prompt.step / tail_bins * np.arange(len(density)))
    delayed = np.convolve(density, decay / decay.sum())[: len(density)]
    power = (1 - part) * density + part * delayed
    return _tabulated(-prompt.step * int(np.argmax(power)), prompt.step, power)


def flat_topped(sigma_bins: float, flat_bins: float) -> Pulse:
    """Return a pulse that is on for `flat_bins`, a laser driven for longer than it takes to switch, seen with a Gaussian jitter of
    `sigma_bins`; time 0 is its middle."""
    edge = gaussian(sigma_bins)
    half = 0.5 * flat_bins
    steps = int(np.ceil((half - edge.begin) / edge.step))
    away = edge.step * np.arange(-steps, steps + 1)
    lit = np.interp(away + half, edge.begin + edge.step * np.arange(len(edge.cumulative)), edge.cumulative)
    return _tabulated(-steps * edge.step, edge.step, np.maximum(lit + lit[::-1] - 1, 0))


def measured(times_bins: Sequence[float] | np.ndarray, power: Sequence[float] | np.ndarray) -> Pulse:
    """Return a pulse from samples of its power; time 0 is that of a return at no distance.
    `times_bins`: [n ≥ 3] ascending times, in bins. `power`: [n] in any unit, none negative, not all zero; between samples the power is
    linear, outside it is zero."""
    times, values = np.asarray(times_bins, dtype=np.float64), np.asarray(power, dtype=np.float64)
    if times.ndim != 1 or times.shape != values.shape or len(times) < 3:
        raise ArrayError(f"the pulse has {times.size} times and {values.size} powers: give three or more of each")
    require_ascending(times, "times of the pulse")
    if not np.isfinite(values).all() or values.min() < 0 or values.max() == 0:
        raise ArrayError("the powers of the pulse must be zero or more, and some above zero")
    count = max(int(np.ceil((times[-1] - times[0]) * STEPS_PER_BIN)), 2)
    grid = np.linspace(times[0], times[-1], count + 1)
    density = np.interp(grid, times, values)
    return _tabulated(float(times[0]), float(grid[1] - grid[0]), density)


def _tabulated(begin: float, step: float, power: np.ndarray) -> Pulse:
    """Return the pulse of this power at even times, scaled to unit area."""
    cumulative = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]))]) * step
    return Pulse(begin, step, cumulative / cumulative[-1], power / cumulative[-1])
