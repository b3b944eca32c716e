"""The width of the pulse, estimated from the histograms: the Gaussian under which the brightest of them are most likely."""

import numpy as np
import warp as wp

from kernels.errors import ArrayError
from kernels.tof.pileup import LiveCounts
from kernels.tof.pulse import Pulse, gaussian
from kernels.tof.returns import find_returns, threshold

WIDTHS = np.geomspace(0.25, 4.0, 13)
"""Standard deviations, in bins, of the Gaussian pulses that are tried."""
WIDTH_PIXELS = 512
"""Number of brightest pixels that decide on the width."""
WIDTH_WINDOW = 8
"""Number of neighbouring bins whose photons rank a pixel: the highest bin alone would prefer histograms that are narrow by chance."""
WIDTH_RETURNS = 3
"""Most returns fitted per pixel in the width search; each extra one is penalised, because narrow pulses could imitate any shape."""

LEAST_SIGMA = 1e-6
"""Least standard deviation of a return's time that enters the cost, in bins: float32 resolves no smaller one."""


def estimate_pulse(histograms: LiveCounts, counts: np.ndarray) -> Pulse:
    """Return the Gaussian pulse under which the brightest histograms are likeliest; waits for the device.

    Args:
        histograms: of all pixels.
        counts: [pixel, bin] the same as recorded, to pick the brightest.

    Raises:
        ArrayError: none of them shows a return.

    Convention:
        The time of each return counts with all its values, not the best alone (its posterior is about √(2π)·σ wide): a time fitted to n
        photons takes one of their n deviations away, and the pulse would come out too narrow by half a part in n.

    Source:
        Neyman, Scott, "Consistent estimates based on partially consistent observations", Econometrica 16(1), 1948.
    """
    total = np.cumsum(counts, axis=1, dtype=np.float64)
    window = min(WIDTH_WINDOW, counts.shape[1] - 1)
    peak = (total[:, window:] - total[:, :-window]).max(axis=1) - window * np.median(counts, axis=1)
    chosen = np.argsort(-peak, kind="stable")[:WIDTH_PIXELS]
    device = str(histograms.counts.device)
    some = LiveCounts(*(wp.array(array.numpy()[:, chosen], dtype=wp.float32, device=device)
                     for array in (histograms.counts, histograms.live)), histograms.pulses)
    totals = []
    for width in WIDTHS:
        found = find_returns(some, gaussian(float(width)), most=WIDTH_RETURNS)
        sigma = found.sigma.numpy()[found.photons.numpy() > 0].astype(np.float64)
        cost = len(sigma) * 0.5 * threshold(histograms.counts.shape[0]) - np.log((2 * np.pi) ** 0.5 * np.maximum(sigma, LEAST_SIGMA)).sum()
        totals.append(float(found.likelihood.numpy().sum(dtype=np.float64) - cost) if len(sigma) else -np.inf)
    best = int(np.argmax(totals))
    if not np.isfinite(totals[best]):
        raise ArrayError("no histogram shows a return: the width of the pulse cannot be told from them")
    place = 0.0
    if 0 < best < len(WIDTHS) - 1 and np.isfinite(totals[best - 1]) and np.isfinite(totals[best + 1]):
        before, here, after = totals[best - 1 : best + 2]
        place = 0.5 * (before - after) / (before - 2 * here + after)  # of the parabola through the three
    return gaussian(float(WIDTHS[best] * (WIDTHS[1] / WIDTHS[0]) ** place))
