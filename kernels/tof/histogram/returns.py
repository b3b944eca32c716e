"""Photon histograms → returns: background, matched filter, and maximum likelihood of time and strength, several returns a pixel.

Counts are Poisson variables of mean live · (b + Σ s·p(t)): background b, and for each return its photons s spread over the bins by the
pulse p at time t (pile-up: kernels.tof.histogram.likelihood). A return is looked for where it adds most to the likelihood, which is the
matched filter of low counts as well as of high ones; then time and strength are moved to the maximum by Fisher scoring, and so between the
bins. What the histogram leaves open about the time is worked out in kernels.tof.histogram.times.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.histogram.likelihood import (
    Recorded,
    Shape,
    density_at,
    end_bin_of,
    first_bin_of,
    information,
    likelihood_gain,
    likelihood_slope,
    mean_of_bin,
    recorded,
    shape,
    share_before,
)
from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse
from kernels.tof.histogram.times import peak_reach, return_times

FALSE_ALARMS = 1e-3
"""Fraction of the pixels without a return in which noise alone is taken for one."""
POSITIONS_PER_BIN = 2
"""Positions that the search tries in a bin: the refinement then starts at most a quarter of a bin away."""
POSITIONS_PER_WIDTH = 2
"""Minimum number of search positions per pulse width, so that a pulse narrower than a bin is placed on the right side of it."""
LEAST_SHARE = 0.05
"""Least share of a return's photons that must fall into the histogram."""
ROUNDS, ROUNDS_TOGETHER = 2, 8
"""Rounds of background and refinement over all returns, for returns that do not overlap and for returns that do."""
LEAST_OUTSIDE = 4
"""Least number of bins outside all returns from which the background is measured; with fewer, the background keeps the value that the
search assumed."""
SCORING_STEPS = 8
"""Steps of Fisher scoring: with steps of at most half a bin, five of them settle the time to a thousandth of its deviation."""
KNOWN_TO_A_BIN = 12.0
"""Fisher information, in 1/bin², about a time that is evenly distributed over one bin: it keeps steps short where a bin holds the whole
pulse."""

_OK, _LOW, _SATURATED = int(Status.OK), int(Status.LOW_MODULATION), int(Status.SATURATED)


class Returns(NamedTuple):
    """Returns of each pixel, the most certain first; on the device. What was not found is 0."""

    position: wp.array  # [return, pixel] float32: time in bins from the start of the histogram
    sigma: wp.array  # [return, pixel] float32 bins: standard deviation of the position, if the peak is the right one
    photons: wp.array  # [return, pixel] float32: of the return, as if no pulse had been lost to pile-up
    evidence: wp.array  # [return, pixel] float32: twice the log likelihood that the return adds
    confidence: wp.array  # [return, pixel] float32: probability that there is a return, and at this peak
    background: wp.array  # [pixel] float32 photons a bin
    likelihood: wp.array  # [pixel] float32: log likelihood of the whole histogram
    status: wp.array  # [pixel] int32: of the first return


def find_returns(histograms: LiveCounts, pulse: Pulse, *, most: int = 1, first_bin: float = 0.0, last_bin: float | None = None) -> Returns:
    """Find the returns of each histogram.

    Args:
        most: returns to look for, 1 to 4; later ones only where they are as significant as the first must be.
        first_bin, last_bin: where returns may be, in bins from the start; None: to the end.

    Returns:
        The returns. LOW_MODULATION: nothing stands out from the background (an empty histogram too); SATURATED: pile-up left no pulse
        in any bin of the return.

    Raises:
        ArrayError: `most` is not 1 to 4, or the bins leave no place for a return.

    Convention:
        Confidence is Σ_peak e^g / (Σ e^g + J·√s·e^g₀): g is the log likelihood that a return adds at each of J times, every time being as
        likely beforehand, and none at all as likely as one; g₀ what the same photons add as even background. √s is the price of the
        strength s that was fitted to its photons.

    Source:
        Matched filter and Poisson likelihood: Snyder, "Random Point Processes", 1975; Bar-David, "Communication under the
        Poisson regime", IEEE Trans. Information Theory 15(1), 1969. Price of a fitted number: Schwarz, "Estimating the dimension of a
        model", Annals of Statistics 6(2), 1978.
    """
    bins, pixels = histograms.counts.shape
    last = float(bins) if last_bin is None else min(float(last_bin), float(bins))
    if not 1 <= most <= 4:
        raise ArrayError(f"{most} returns are asked for: 1 to 4 can be")
    first_bin = max(first_bin, 0.0)
    if not first_bin < last:
        raise ArrayError(f"returns from bin {first_bin:g} to bin {last:g} leave no place: the histogram has {bins} bins")
    device = str(histograms.counts.device)
    position, photons, evidence, confidence = (wp.zeros((most, pixels), dtype=wp.float32, device=device) for _ in range(4))
    background, likelihood = (wp.zeros(pixels, dtype=wp.float32, device=device) for _ in range(2))
    status = wp.zeros(pixels, dtype=wp.int32, device=device)
    devices.launch(_returns_kernel, pixels, [recorded(histograms), shape(pulse, device), positions_per_bin(pulse), first_bin, last,
                                             threshold(bins)],
                   [position, photons, evidence, confidence, background, likelihood, status], device=device, uneven=True)
    times = return_times(histograms, pulse, position, photons, background, first_bin=first_bin, last_bin=last)
    return Returns(times.position, times.sigma, photons, evidence, confidence, background, likelihood, status)


def threshold(bins: int) -> float:
    """Return the evidence that chance reaches in FALSE_ALARMS of the histograms: chi-squared with two degrees of freedom in any bin."""
    return float(2 * np.log(bins / FALSE_ALARMS))


def positions_per_bin(pulse: Pulse) -> int:
    """Return the positions that the search tries in a bin."""
    return max(POSITIONS_PER_BIN, int(np.ceil(POSITIONS_PER_WIDTH / pulse.width)))


@wp.func
def added_at(given: Recorded, pulse: Shape, t: float, b: float, p: int, found: int,
              position: wp.array2d(dtype=wp.float32), photons: wp.array2d(dtype=wp.float32)):
    """Return the log likelihood that a return at t would add to those found, and its photons; both are 0 where a return would add
    nothing."""
    low = first_bin_of(pulse, t)
    high = end_bin_of(pulse, t, given.counts.shape[0])
    excess = float(0.0)
    share = float(0.0)
    before = share_before(pulse, float(low) - t)
    for i in range(low, high):
        after = share_before(pulse, float(i + 1) - t)
        excess += given.counts[i, p] - given.live[i, p] * mean_of_bin(pulse, i, p, -1, found, b, position, photons)
        share += given.live[i, p] * (after - before)
        before = after
    added = float(0.0)
    s = float(0.0)
    if excess > 0.0 and share > LEAST_SHARE:
        s = excess / share
        before = share_before(pulse, float(low) - t)
        for i in range(low, high):
            after = share_before(pulse, float(i + 1) - t)
            mean = mean_of_bin(pulse, i, p, -1, found, b, position, photons)
            added += likelihood_gain(given, i, p, mean, mean + s * (after - before))
            before = after
    return wp.vec2f(added, s)


@wp.func
def scored(given: Recorded, pulse: Shape, k: int, p: int, found: int, b: float, first_bin: float, last_bin: float,
            position: wp.array2d(dtype=wp.float32), photons: wp.array2d(dtype=wp.float32)):
    """Return the time and strength of return k at the maximum of likelihood, by Fisher scoring, while the others stay as they are."""
    t = position[k, p]
    s = photons[k, p]
    for _step in range(SCORING_STEPS):
        gs = float(0.0)
        gt = float(0.0)
        ss = float(0.0)
        st = float(0.0)
        tt = float(KNOWN_TO_A_BIN)
        low = first_bin_of(pulse, t)
        before = share_before(pulse, float(low) - t)
        edge = density_at(pulse, float(low) - t)
        for i in range(low, end_bin_of(pulse, t, given.counts.shape[0])):
            after = share_before(pulse, float(i + 1) - t)
            next_edge = density_at(pulse, float(i + 1) - t)
            part = after - before
            moves = edge - next_edge
            before = after
            edge = next_edge
            mean = s * part + mean_of_bin(pulse, i, p, k, found, b, position, photons)
            off = likelihood_slope(given, i, p, mean)
            gs += off * part
            gt += off * s * moves
            w = information(given, i, p, mean)
            ss += w * part * part
            st += w * s * part * moves
            tt += w * s * s * moves * moves
        determinant = wp.max(ss * tt - st * st, 1.0e-30)
        s = wp.max(s + (gs * tt - gt * st) / determinant, 0.3 * s)
        t = wp.clamp(t + wp.clamp((gt * ss - gs * st) / determinant, -0.5, 0.5), first_bin, last_bin)
    return wp.vec2f(t, s)


@wp.kernel(module="unique", module_options={"max_unroll": 0})  # unrolled, it is no faster and takes seconds to compile
def _returns_kernel(first: int,
                    given: Recorded,
                    pulse: Shape,
                    per_bin: int,  # positions of the search
                    first_bin: float,
                    last_bin: float,
                    threshold: float,
                    # outputs
                    position: wp.array2d(dtype=wp.float32),  # [K, pixel]
                    photons: wp.array2d(dtype=wp.float32),
                    evidence: wp.array2d(dtype=wp.float32),
                    confidence: wp.array2d(dtype=wp.float32),
                    background: wp.array(dtype=wp.float32),
                    likelihood: wp.array(dtype=wp.float32),
                    status: wp.array(dtype=wp.int32)):
    p = first + wp.tid()
    bins = given.counts.shape[0]
    everything = float(0.0)
    exposure = float(0.0)
    top = float(-1.0)
    top_bin = wp.int32(0)
    for i in range(bins):
        everything += given.counts[i, p]
        exposure += given.live[i, p]
        if given.counts[i, p] > top * wp.max(given.live[i, p], 1.0e-6):
            top = given.counts[i, p] / wp.max(given.live[i, p], 1.0e-6)
            top_bin = i
    code = int(_LOW)
    if exposure < float(LEAST_OUTSIDE):
        code = int(_SATURATED)
    elif everything > 0.0:
        least = 0.5 / exposure  # half a count in the whole histogram
        # background without the highest bin and what a pulse about it covers
        inside = float(0.0)
        hidden = float(0.0)
        live_bins = wp.int32(0)
        reach = int(wp.ceil(pulse.end - pulse.begin))
        for i in range(bins):
            if wp.abs(i - top_bin) <= reach:
                inside += given.counts[i, p]
                hidden += given.live[i, p]
            elif given.live[i, p] > 0.0:
                live_bins += 1
        b = everything / exposure
        if live_bins >= LEAST_OUTSIDE:
            b = wp.min((everything - inside) / (exposure - hidden), b)
        b = wp.max(b, least)
        found = wp.int32(0)
        going = wp.int32(1)
        while going == 1 and found < position.shape[0]:
            # where a return adds most to the likelihood
            gain = float(0.0)
            place = float(-1.0)
            strength = float(0.0)
            tries = float(0.0)
            everywhere = float(0.0)  # Σ e^g, in units of the highest
            for j in range(int(wp.ceil(first_bin * float(per_bin))), int(last_bin * float(per_bin)) + 1):
                t = float(j) / float(per_bin)
                free = wp.int32(1)
                for m in range(found):
                    if wp.abs(position[m, p] - t) < pulse.width:
                        free = 0
                if free == 1:
                    added = added_at(given, pulse, t, b, p, found, position, photons)
                    if added[0] > gain:
                        everywhere *= wp.exp(gain - added[0])
                        gain = added[0]
                        place = t
                        strength = added[1]
                    if added[0] > 0.0:  # the others are part of no return at all
                        everywhere += wp.exp(added[0] - gain)
                    tries += 1.0
            if 2.0 * gain < threshold:
                going = 0
            else:
                evidence[found, p] = 2.0 * gain
                # the part of the evidence that lies at this peak, and the evidence if the photons were background
                here = float(0.0)
                for j in range(int(wp.ceil(wp.max(place - peak_reach(pulse), first_bin) * float(per_bin))),
                               int(wp.min(place + peak_reach(pulse), last_bin) * float(per_bin)) + 1):
                    here += wp.exp(added_at(given, pulse, float(j) / float(per_bin), b, p, found, position, photons)[0] - gain)
                none = float(0.0)
                for i in range(bins):
                    mean = mean_of_bin(pulse, i, p, -1, found, b, position, photons)
                    none += likelihood_gain(given, i, p, mean, mean + strength / exposure)
                confidence[found, p] = wp.min(here / (everywhere + tries * wp.sqrt(strength) * wp.exp(none - gain)), 1.0)
                rounds = wp.int32(ROUNDS)
                for m in range(found):
                    if wp.abs(position[m, p] - place) < pulse.end - pulse.begin:
                        rounds = ROUNDS_TOGETHER
                position[found, p] = place
                photons[found, p] = strength
                found += 1
                for _turn in range(rounds):
                    # background: what lies outside all returns
                    outside = float(0.0)
                    seen = float(0.0)
                    live_bins = wp.int32(0)
                    for i in range(bins):
                        covered = wp.int32(0)
                        for m in range(found):
                            if float(i + 1) > position[m, p] + pulse.begin and float(i) < position[m, p] + pulse.end:
                                covered = 1
                        if covered == 0:
                            outside += given.counts[i, p]
                            seen += given.live[i, p]
                            live_bins += wp.where(given.live[i, p] > 0.0, 1, 0)
                    if live_bins >= LEAST_OUTSIDE:
                        b = wp.max(outside / seen, least)
                    for k in range(found):
                        at = scored(given, pulse, k, p, found, b, first_bin, last_bin, position, photons)
                        position[k, p] = at[0]
                        photons[k, p] = at[1]
        if found > 0:
            code = int(_OK)
        background[p] = b
        total = float(0.0)
        for i in range(bins):
            total += likelihood_gain(given, i, p, 1.0, mean_of_bin(pulse, i, p, -1, found, b, position, photons))
        likelihood[p] = total
    status[p] = code
