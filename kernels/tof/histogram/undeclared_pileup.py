"""Pile-up that nobody declared: the number of laser pulses under which first-photon counts are likelier than counts of all photons.

Pile-up bends a histogram in proportion to its own counts: background falls with every photon that came before it, returns lean forward,
and the sum approaches the number of pulses. All of it is in the likelihood, so that the number of pulses is found as the width of the
pulse is: by trying.
"""

from collections.abc import Callable
from math import ceil, lgamma
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.tof.histogram.pileup import LiveCounts, correct_pileup, without_pileup
from kernels.tof.histogram.pulse import Pulse
from kernels.tof.histogram.returns import Returns, find_returns

PARTS = (0.1, 0.25, 0.5, 0.75, 0.92, 0.99)
"""Numbers of pulses that are tried: the largest sum of a histogram is this part of them."""
LEAST_PART = 0.06
"""Part of the pulses that the fullest histogram must have used: less bends no return by a tenth of its width."""
HALF_PIXELS = 256
"""Number of fullest histograms that decide, and of others of every brightness."""
RETURNS = 3
"""Most returns fitted in a pixel."""
LEAST_GAIN = 8.0
"""Log likelihood by which pile-up must explain the histograms better, beyond what it gains without any: four standard deviations."""
SURE = 4.0
"""Standard deviations, by how much histograms differ in it, by which the gain must be above nothing."""
DIMMER = 0.7
"""Largest ratio of the fullest histogram of the dimmer half to the fullest of all at which the two halves are compared."""
SKEWED, FULL = 0.05, 0.9
"""Mean time of a pulse, in its widths, from which it is estimated again as if the fullest histogram had used this part of the pulses."""
LEAST_EXPOSURE = 8.0
"""Bins' worth of pulses that a histogram must have left for the test, were all its pulses used up."""
PINNED = 0.95
"""Part of the pulses from which the fullest histogram itself says how many they are."""
NEARBY = 1.1
"""Ratio of the numbers of pulses between which the curvature of the likelihood is taken."""
LEAST_MEAN = 1.0
"""Expected count from which a bin enters the test of the fit: the chi-squared distribution holds from there."""
ROUNDS = 3
"""Most rounds of the pulse for the number of pulses, and the number for the pulse."""
CHANCE_SIGMAS = 3.0
"""Standard deviations up to which the sum of squared residuals is left to chance."""
REFINEMENTS = 5
"""Steps of the search between the numbers tried; each halves the interval."""


class PulseCount(NamedTuple):
    """An estimated number of pulses."""

    pulses: int
    relative: float  # standard deviation of its logarithm
    used: float  # part of the pulses that the fullest histogram used


def estimate_pulses(counts: np.ndarray, pulse: Pulse, device: str, shape_of: Callable[[LiveCounts, np.ndarray], Pulse], *,
                    declared: int | None = None) -> PulseCount | None:
    """Return the number of pulses where the histograms show pile-up, else None; waits for the device.

    Args:
        counts: [pixel, bin] photons.
        pulse: shape of a return, if there is no pile-up.
        shape_of: gives the pulse for histograms with pile-up and their counts.
        declared: number of pulses where it is known; it is tried alone.

    Convention:
        The gain is divided by the dispersion of what the fit leaves: a pulse that fits badly makes likelihoods too certain. A flux
        fitted to the same photons prefers pile-up where there is none, by what `spent` takes off. A pulse of
        another shape bends dim histograms as much as bright ones; pile-up does not, so that the dimmer half must agree.

    Source:
        The likelihood of first photons: Coates, J. Phys. E 1(8), 1968; as a maximum-likelihood problem: Heide, Diamond, Lindell,
        Wetzstein, "Sub-picosecond photon-efficient 3D imaging using single-photon sensors", Scientific Reports 8, 2018.
    """
    total = counts.sum(axis=1)
    order = np.argsort(-total, kind="stable")
    order = order[total[order] > 0]
    if len(order) == 0:
        return None
    top = int(np.rint(total[order[0]]))
    waiting = 1 - (np.cumsum(counts[order], axis=1) - counts[order]) / top  # part of the pulses left, if there are no more than `top`
    order = order[waiting.sum(axis=1) > LEAST_EXPOSURE]
    if len(order) == 0:
        return None
    chosen = np.unique(np.concatenate([order[:HALF_PIXELS], order[:: max(len(order) // HALF_PIXELS, 1)]]))
    some = _Counted(np.rint(counts[chosen]), device)
    top = max(top, int(some.top))  # sums of rounded bins may be larger than rounded sums
    if declared is not None and declared < top:
        return None
    return _among(some, top, pulse, shape_of, declared)


def _among(some: "_Counted", top: int, pulse: Pulse, shape_of: Callable[[LiveCounts, np.ndarray], Pulse], declared: int | None
           ) -> PulseCount | None:
    """Return the number of pulses of these histograms, not below `top`."""
    numbers = [ceil(top / part) for part in PARTS] if declared is None else [declared]
    without = some.likelihood(None, pulse)[0]
    if abs(pulse.mean) > SKEWED * pulse.width:  # what leans may be pile-up itself
        pulse = shape_of(correct_pileup(some.placed, pulses=ceil(top / FULL)), some.counts)

    def gain_of(pulses: int) -> float:
        return float((some.likelihood(pulses, pulse)[0] - without).sum())

    best, gain = 0, 0.0
    for _ in range(ROUNDS):
        gains = [gain_of(pulses) for pulses in numbers]
        last, best, gain = best, numbers[int(np.argmax(gains))], max(gains)
        if gain - some.spent(best) < LEAST_GAIN or top / best < LEAST_PART:
            return None
        if best == last:
            break
        pulse = shape_of(correct_pileup(some.placed, pulses=best), some.counts)
    if declared is None:
        best, gain = _refined(gain_of, best, gain, top)
    value, found = some.likelihood(best, pulse)
    refitted = some.likelihood(None, shape_of(without_pileup(some.placed), some.counts))[0]
    if refitted.sum() > without.sum():  # the pulse is that of these histograms in both cases
        without = refitted
        gain = float((value - without).sum())
    dispersion, unexplained = _misfit(some.counts, found, pulse, best)
    chance = SURE * float(np.sqrt(len(value)) * (value - without).std())
    if gain / dispersion - some.spent(best) < max(LEAST_GAIN, chance) or gain < unexplained:
        return None
    dim = some.dimmer_half()
    as_bent = ceil(max(best * dim.top / some.top, dim.top + 1))
    if dim.top < DIMMER * some.top and dim.likelihood(as_bent, pulse)[0].sum() > dim.likelihood(best, pulse)[0].sum() + dim.spent(as_bent):
        return None
    if declared is not None:
        return PulseCount(best, 0.0, top / best)
    lost = max((value - some.likelihood(max(int(best * NEARBY), best + 1), pulse)[0]).sum(), 0.5) / dispersion
    relative = np.log(NEARBY) / np.sqrt(2 * lost)
    if top < PINNED * best:
        relative = np.hypot(relative, 0.5 * some.spent(best) / gain)
    return PulseCount(best, float(relative), top / best)


def _refined(gain: Callable[[int], float], start: int, value: float, least: int) -> tuple[int, float]:
    """Return the number of pulses of the highest gain, and that, by trying beside the best so far; not below `least`."""
    best, factor = start, 1.25
    for _ in range(REFINEMENTS):
        for pulses in (int(best * factor), max(int(best / factor), least + 1)):
            tried = gain(pulses)
            if tried > value:
                best, value = pulses, tried
                break
        factor = factor**0.6
    return best, value


class _Counted:
    def __init__(self, counts: np.ndarray, device: str) -> None:
        self.counts, self.device = counts, device  # [pixel, bin]
        self.placed = wp.array(np.ascontiguousarray(counts.T, dtype=np.float32), device=device)
        self.total = counts.sum(axis=1)
        self.top = float(self.total.max())

    def dimmer_half(self) -> "_Counted":
        return _Counted(self.counts[self.total <= np.median(self.total)], self.device)

    def likelihood(self, pulses: int | None, pulse: Pulse) -> tuple[np.ndarray, Returns]:
        """Return the log probability of each histogram at its best returns, [pixel], less a part that does not depend on the pulses."""
        histograms = without_pileup(self.placed) if pulses is None else correct_pileup(self.placed, pulses=pulses)
        found = find_returns(histograms, pulse, most=RETURNS)
        value = to_numpy(found.likelihood)[: len(self.counts)].astype(np.float64)  # above that of one photon a bin
        if pulses is None:
            return value - self.counts.shape[1], found
        left = pulses - (np.cumsum(self.counts, axis=1) - self.counts)
        of_one = -np.expm1(-1 / pulses) * pulses
        value += self.total * np.log(of_one) - (left - self.counts).sum(axis=1) / pulses
        value += [lgamma(pulses + 1) - lgamma(pulses - t + 1) - t * np.log(pulses) for t in self.total]
        return value, found

    def spent(self, pulses: int) -> float:
        """Return what first photons gain in the log likelihood on counts without pile-up.

        A fitted flux makes each sum t as likely as can be: C(N, t) (t/N)^t (1 - t/N)^(N-t) for N pulses, t^t exp(-t) / t! for all photons.
        The logarithm of their ratio is about t / (2 N) where t is far below N, and rises to log(2π N) / 2.
        """
        every = np.minimum(self.total, pulses)
        left = pulses - every
        emptied = np.where(left > 0, left * np.log(np.maximum(left, 0.5) / pulses), 0.0)
        return float(sum(lgamma(pulses + 1) - lgamma(n + 1) for n in left) + (emptied + every - every * np.log(pulses)).sum())


def _expected(found: Returns, pulse: Pulse, bins: int) -> np.ndarray:
    """Return the photons a bin of the background and the returns that were found, [pixel, bin]."""
    edges = np.arange(bins + 1)
    times = pulse.begin + pulse.step * np.arange(len(pulse.cumulative))
    mean = np.repeat(to_numpy(found.background)[:, None].astype(np.float64), bins, axis=1)
    for position, photons in zip(to_numpy(found.position), to_numpy(found.photons), strict=True):
        mean += photons[:, None] * np.diff(np.interp(edges - position[:, None], times, pulse.cumulative), axis=1)
    return mean


def _misfit(counts: np.ndarray, found: Returns, pulse: Pulse, pulses: int) -> tuple[float, float]:
    """Return squared residuals over the variance that first photons have, 1 or more, and the log likelihood that a model without
    significant residuals would gain."""
    left = pulses - (np.cumsum(counts, axis=1) - counts)
    seen = -np.expm1(-_expected(found, pulse, counts.shape[1]) / pulses)
    mean = left * seen
    used = mean > LEAST_MEAN
    if not used.any():
        return 1.0, 0.0
    squares = (counts - mean)[used] ** 2 / (mean * (1 - seen))[used]
    chance = np.sqrt((2 + 1 / mean[used]).sum())
    return max(float(squares.mean()), 1.0), max(0.5 * float(squares.sum() - len(squares) - CHANCE_SIGMAS * chance), 0.0)
