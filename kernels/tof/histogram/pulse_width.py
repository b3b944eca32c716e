"""The shape of the pulse, estimated from the histograms: the one under which the brightest of them are most likely."""

from collections.abc import Callable, Iterable
from itertools import product
from typing import NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse, flat_topped, gaussian, with_tail
from kernels.tof.histogram.returns import find_returns, threshold

WIDTHS = np.geomspace(0.1, 4.0, 17)
"""Standard deviations, in bins, of the Gaussian pulses that are tried; of narrower ones all returns but those at the border of a bin look
alike."""
WIDTH_PIXELS = 512
"""Number of brightest pixels that decide on the width."""
WIDTH_WINDOW = 8
"""Number of neighbouring bins whose photons rank a pixel: the highest bin alone would prefer histograms that are narrow by chance."""
WIDTH_RETURNS = 3
"""Most returns fitted per pixel in the width search; each extra one is penalised, because narrow pulses could imitate any shape."""
TAIL_PIXELS = 128
"""Number of brightest pixels that decide on the tail."""
TAIL_PARTS, TAIL_TIMES = (0.2, 0.5, 1.0), (1.0, 2.5, 6.0)
"""Tails that are tried first: parts of the photons, and decay times in standard deviations of the best Gaussian, whose width then shrinks
to CORE of it, and the shortest decay time, in bins, that histograms tell."""
CORE, SHORTEST_TAIL = 0.75, 0.25
FLAT_BINS, FLAT_EDGES = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0), (0.05, 0.2)
"""Flat tops that are tried first: lengths in bins, and standard deviations of their edges as a part of these."""
TAIL_GAIN = 12.0
"""Log likelihood that a tail or a flat top must add: two more numbers fitted to a thousand photons or so deserve 7 (Schwarz 1978)."""
TAIL_SPAN = 0.5
"""Longest pulse with a tail, as a part of the histogram: what is longer cannot be told from background."""
STRETCHES = np.geomspace(0.25, 4.0, 9)
"""Factors, each √2 times the one before, by which the length of a declared pulse is tried."""
ROUNDS, STEP = 7, 1.35
"""Rounds of the search that multiplies or divides each number of a pulse, and its first factor, whose root the next round takes."""

LEAST_SIGMA = 1e-6
"""Least standard deviation of a return's time that enters the cost, in bins: float32 resolves no smaller one."""


class PulseShape(NamedTuple):
    """A pulse and the numbers that describe it."""

    pulse: Pulse
    sigma: float  # bins: of the Gaussian
    tail: float  # bins: decay time of the delayed photons, 0 without a tail
    part: float  # of the photons that are delayed
    flat: float = 0.0  # bins: for how long the light is on, 0 for a mere peak


class _Tried(NamedTuple):
    evidence: float
    numbers: tuple[float, ...]
    shape: PulseShape


def estimate_pulse(histograms: LiveCounts, counts: np.ndarray) -> PulseShape:
    """Return the pulse under which the brightest histograms are likeliest: Gaussian, or with an exponential tail or a flat top where that
    explains them better; waits for the device.

    Args:
        counts: [pixel, bin] the same as recorded, to pick the brightest.

    Raises:
        ArrayError: none of them shows a return.

    Convention:
        The time of each return counts with all its values, not the best alone (its posterior is about √(2π)·σ wide): a time fitted to n
        photons takes one of their n deviations away, and the pulse would come out too narrow by half a part in n.

    Source:
        Neyman, Scott, "Consistent estimates based on partially consistent observations", Econometrica 16(1), 1948.
    """
    chosen = brightest(counts)[:WIDTH_PIXELS]
    some = histograms.of(chosen)
    totals = [_evidence(some, gaussian(float(width))) for width in WIDTHS]
    best = int(np.argmax(totals))
    if not np.isfinite(totals[best]):
        raise ArrayError("no histogram shows a return: the width of the pulse cannot be told from them")
    place = 0.0
    if 0 < best < len(WIDTHS) - 1 and np.isfinite(totals[best - 1]) and np.isfinite(totals[best + 1]):
        before, here, after = totals[best - 1 : best + 2]
        place = 0.5 * (before - after) / (before - 2 * here + after)  # of the parabola through the three
    sigma = float(WIDTHS[best] * (WIDTHS[1] / WIDTHS[0]) ** place)
    few = histograms.of(chosen[:TAIL_PIXELS])
    return _shaped(lambda pulse: _evidence(some, pulse), lambda pulse: _evidence(few, pulse), (float(WIDTHS[best]), sigma),
                   longest=TAIL_SPAN * counts.shape[1])


def likeliest_stretch(histograms: LiveCounts, counts: np.ndarray, pulse: Pulse) -> float:
    """Return by which of STRETCHES a pulse is to be stretched so that the brightest histograms are likeliest: 1 where they fit the pulse as
    it is, or tell nothing; waits for the device.

    Args:
        counts: [pixel, bin] the same as recorded, to pick the brightest.
    """
    some = histograms.of(brightest(counts)[:WIDTH_PIXELS])
    gains = np.array([_evidence(some, pulse.stretched(float(factor))) for factor in STRETCHES])
    best = int(np.argmax(gains))
    return float(STRETCHES[best]) if gains[best] > gains[len(gains) // 2] + TAIL_GAIN else 1.0


def brightest(counts: np.ndarray) -> np.ndarray:
    """Return the pixels from that with the strongest return on, [pixel]; `counts` is [pixel, bin]."""
    total = np.cumsum(counts, axis=1, dtype=np.float64)
    window = min(WIDTH_WINDOW, counts.shape[1] - 1)
    peak = (total[:, window:] - total[:, :-window]).max(axis=1) - window * np.median(counts, axis=1)
    return np.argsort(-peak, kind="stable")


def _evidence(some: LiveCounts, pulse: Pulse) -> float:
    """Return the log likelihood of histograms under a pulse, less the price of their returns; -inf where there is none."""
    found = find_returns(some, pulse, most=WIDTH_RETURNS)
    sigma = to_numpy(found.sigma)[to_numpy(found.photons) > 0].astype(np.float64)
    cost = len(sigma) * 0.5 * threshold(some.counts.shape[0]) - np.log((2 * np.pi) ** 0.5 * np.maximum(sigma, LEAST_SIGMA)).sum()
    return float(to_numpy(found.likelihood).sum(dtype=np.float64) - cost) if len(sigma) else -np.inf


def _shaped(of_many: Callable[[Pulse], float], of_few: Callable[[Pulse], float], sigmas: tuple[float, ...], *, longest: float
            ) -> PulseShape:
    """Return the likeliest pulse of Gaussians, by the evidence `of_many` pixels, and of those with a tail or a flat top, by that `of_few`;
    `sigmas`, where Gaussians are sought, and `longest` in bins."""

    def peak(core: float) -> PulseShape:
        core = max(core, WIDTHS[0])
        return PulseShape(gaussian(core), core, 0.0, 0.0)

    def tailed(core: float, tail: float, part: float) -> PulseShape:
        core, tail, part = max(core, WIDTHS[0]), max(tail, SHORTEST_TAIL), min(part, 1.0)
        return PulseShape(with_tail(core, tail, part), core, tail, part)

    def flat_top(core: float, flat: float) -> PulseShape:
        return PulseShape(flat_topped(core, flat), core, 0.0, 0.0, flat)

    def valued(evidence: Callable[[Pulse], float], make: Callable[..., PulseShape], numbers: tuple[float, ...]) -> _Tried:
        shape = make(*numbers)
        return _Tried(evidence(shape.pulse) if shape.pulse.end - shape.pulse.begin < longest else -np.inf, numbers, shape)

    def likeliest(evidence: Callable[[Pulse], float], make: Callable[..., PulseShape], starts: Iterable[tuple[float, ...]]) -> _Tried:
        found = max((valued(evidence, make, start) for start in starts), key=lambda tried: tried.evidence)
        factor = STEP
        for _ in range(ROUNDS):
            for index in range(len(found.numbers)):
                for change in (factor, 1 / factor):
                    numbers = (number * change if index == k else number for k, number in enumerate(found.numbers))
                    tried = valued(evidence, make, tuple(numbers))
                    if tried.evidence > found.evidence:
                        found = tried
                        break
            factor = factor**0.5
        return found

    best = likeliest(of_many, peak, ((sigma,) for sigma in sigmas)).shape
    most, sigma = of_few(best.pulse), best.sigma
    for make, starts in ((tailed, [(CORE * sigma, ratio * sigma, part) for ratio, part in product(TAIL_TIMES, TAIL_PARTS)]),
                         (flat_top, [(edge * flat, flat) for flat, edge in product(FLAT_BINS, FLAT_EDGES)])):
        found = likeliest(of_few, make, starts)
        if found.evidence > most + TAIL_GAIN:
            most, best = found.evidence, found.shape
    return best
