"""Estimate the time of a return from a histogram: mean and standard deviation of the time's posterior.

The Fisher information bounds the error, and meets it where it is small beside the pulse and the bins. With few photons over some
background the error is larger (the threshold effect), and where one bin holds the whole pulse the information about its time is zero
though the time is known to a bin. The posterior has neither limit. With every time as likely beforehand,

    p(t | counts) ∝ max_s L(t, s),       time = E[t],      sigma² = E[(t - time)²]

over the peak of the return, its strength s at its best for each t. Where the model holds, sigma² is the expected squared error by
definition, and the mean is the estimate for which it is least. With more photons it goes over into the bound.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices
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
    returns_found,
    shape,
    share_before,
)
from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse

NODES = 4
"""Number of intervals in a segment of the integral, which Simpson's rule sums."""
LONGEST_PART = 0.25
"""Longest segment, as a part of one side of the peak. The first segment is as long as the bound on the deviation, and each next one is
twice as long."""
NEGLIGIBLE = 12.0
"""Log likelihood below the top at which a side of the peak ends: everything beyond adds a hundred-thousandth."""
HIGHEST = 30.0
"""Largest log likelihood above the found maximum whose exponential float32 sums can hold; it occurs where the search stopped short of the
maximum."""
STRENGTH_STEPS, SMALL_CHANGE = 6, 0.2
"""Most Newton steps towards the best strength, and the relative step size below which the remaining gain is taken from the parabola."""
LEAST_DETERMINANT = 1e-9
"""Least determinant of the information matrix of two returns, in units of their photons: below it, float32 cannot tell the returns
apart."""


class Times(NamedTuple):
    """Time of each return, on the device; 0 where there is none."""

    position: wp.array  # [return, pixel] float32 bins
    sigma: wp.array  # [return, pixel] float32 bins


def return_times(histograms: LiveCounts, pulse: Pulse, position: wp.array, photons: wp.array, background: wp.array, *, first_bin: float,
                 last_bin: float) -> Times:
    """Return the mean and the standard deviation of the time of each return.

    Args:
        position: [return, pixel] float32 times of greatest likelihood, bins.
        photons: [return, pixel] float32 their strengths; the first 0 ends the list.
        background: [pixel] float32 photons a bin.
        first_bin, last_bin: where returns may be.

    Convention:
        The peak reaches half the pulse's width and a bin to both sides (`peak_reach`). That another peak is the right one is no part of
        sigma, but of `Returns.confidence`. Of several returns the others are held still, and sigma grows by what the nearest of them takes
        from the information: the bound with both unknown, over the bound with one.

    Source:
        Bar-David, "Communication under the Poisson regime", IEEE Trans. Information Theory 15(1), 1969: likelihood of Poisson arrivals,
        its bound, and the threshold. Van Trees, "Detection, Estimation, and Modulation Theory" I, 1968, section 2.4: the posterior's mean
        as the estimate of least squared error, and its variance as that error.
    """
    device = str(histograms.counts.device)
    mean, sigma = (wp.zeros(position.shape, dtype=wp.float32, device=device) for _ in range(2))
    devices.launch(_times_kernel, histograms.counts.shape[1], [recorded(histograms), shape(pulse, device), first_bin, last_bin, position,
                                                            photons, background], [mean, sigma], device=device, uneven=True)
    return Times(mean, sigma)


@wp.func
def peak_reach(pulse: Shape):
    """Return the bins to each side of a peak that belong to it.

    Two returns nearer than the width are one, and a narrow pulse may be anywhere in its bin.
    """
    return 0.5 * pulse.width + 1.0


@wp.func
def _slopes(pulse: Shape, i: int, t: float, s: float):
    """Return the derivatives of the mean of a bin by the time of a return and by the logarithm of its strength."""
    return wp.vec2f(s * (density_at(pulse, float(i) - t) - density_at(pulse, float(i + 1) - t)),
                    s * (share_before(pulse, float(i + 1) - t) - share_before(pulse, float(i) - t)))


@wp.func
def _bounds(given: Recorded, pulse: Shape, k: int, p: int, found: int, b: float,
            position: wp.array2d(dtype=wp.float32), photons: wp.array2d(dtype=wp.float32)):
    """Return three numbers about return k: the Fisher information about its time, the derivative of the logarithm of its best strength by
    its time, and the factor by which its variance grows because its nearest neighbour is unknown too."""
    t = position[k, p]
    s = photons[k, p]
    near = wp.int32(-1)
    away = pulse.end - pulse.begin
    for m in range(found):
        if m != k and wp.abs(position[m, p] - t) < away:
            near = m
            away = wp.abs(position[m, p] - t)
    other_t = t
    other_s = float(0.0)
    if near >= 0:
        other_t = position[near, p]
        other_s = photons[near, p]
    per_photon = 1.0 / (s + other_s)  # float32 holds the determinant
    both = wp.mat44f()
    for i in range(first_bin_of(pulse, wp.min(t, other_t)), end_bin_of(pulse, wp.max(t, other_t), given.counts.shape[0])):
        mine = _slopes(pulse, i, t, s)
        others = _slopes(pulse, i, other_t, other_s)
        moves = wp.vec4f(mine[0], mine[1], others[0], others[1])
        w = information(given, i, p, mean_of_bin(pulse, i, p, -1, found, b, position, photons)) * per_photon
        both += w * wp.outer(moves, moves)
    wider = float(1.0)
    alone = both[0, 0] * both[1, 1] - both[0, 1] * both[0, 1]
    if near >= 0 and wp.determinant(both) > LEAST_DETERMINANT and alone > 0.0:
        wider = wp.max(wp.inverse(both)[0, 0] * alone / both[1, 1], 1.0)
    return wp.vec3f(both[0, 0] / per_photon, -both[0, 1] / wp.max(both[1, 1], 1.0e-30), wider)


@wp.func
def _best_gain(given: Recorded, pulse: Shape, t: float, along: float, k: int, p: int, found: int, b: float,
               position: wp.array2d(dtype=wp.float32), photons: wp.array2d(dtype=wp.float32)):
    """Return the log likelihood of return k at t with its best strength, less the log likelihood at the position where it was found;
    float32 can hold this difference."""
    top = position[k, p]
    s = photons[k, p]
    strength = s * wp.exp(wp.clamp(along * (t - top), -2.0, 2.0))
    best = float(-1.0e30)
    going = wp.int32(STRENGTH_STEPS)
    while going > 0:
        gain = float(0.0)
        gs = float(0.0)
        ss = float(0.0)
        for i in range(first_bin_of(pulse, wp.min(t, top)), end_bin_of(pulse, wp.max(t, top), given.counts.shape[0])):
            part = share_before(pulse, float(i + 1) - t) - share_before(pulse, float(i) - t)
            was = share_before(pulse, float(i + 1) - top) - share_before(pulse, float(i) - top)
            others = mean_of_bin(pulse, i, p, k, found, b, position, photons)
            mean = others + strength * part
            gain += likelihood_gain(given, i, p, others + s * was, mean)
            gs += likelihood_slope(given, i, p, mean) * part
            ss += information(given, i, p, mean) * part * part
        change = gs / wp.max(ss, 1.0e-30) / strength
        rest = 0.5 * gs * gs / wp.max(ss, 1.0e-30)
        best = wp.max(best, gain)
        going -= 1
        if wp.abs(change) < SMALL_CHANGE:
            best = gain + rest
            going = 0
        elif gain + rest < -NEGLIGIBLE:
            going = 0
        strength *= wp.exp(wp.clamp(change, -1.0, 1.0))
    return best


@wp.kernel(module="unique", module_options={"max_unroll": 0})  # unrolled, it is no faster and takes seconds to compile
def _times_kernel(first: int,
                  given: Recorded,
                  pulse: Shape,
                  first_bin: float,
                  last_bin: float,
                  position: wp.array2d(dtype=wp.float32),  # [return, pixel]
                  photons: wp.array2d(dtype=wp.float32),  # [return, pixel]
                  background: wp.array(dtype=wp.float32),
                  # outputs
                  mean: wp.array2d(dtype=wp.float32),  # [return, pixel]
                  sigma: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    b = background[p]
    found = returns_found(photons, p)
    for k in range(found):
        top = position[k, p]
        known = _bounds(given, pulse, k, p, found, b, position, photons)
        longest = LONGEST_PART * peak_reach(pulse)
        whole = float(0.0)  # ∫ p dt, ∫ p (t - top) dt, ∫ p (t - top)² dt
        once = float(0.0)
        twice = float(0.0)
        for side in range(2):
            sign = 1.0 - 2.0 * float(side)
            stop = wp.min(wp.where(side == 0, last_bin - top, top - first_bin), peak_reach(pulse))
            start = float(0.0)
            step = wp.min(1.0 / wp.sqrt(wp.max(known[0], 1.0e-12)), longest)
            height = float(1.0)
            while start < stop:
                each = wp.min(step, stop - start) / float(NODES)
                gain = float(0.0)
                for node in range(NODES + 1):
                    away = start + each * float(node)
                    if node > 0:
                        gain = _best_gain(given, pulse, top + sign * away, known[1], k, p, found, b, position, photons)
                        height = wp.exp(wp.min(gain, HIGHEST))
                    weight = each * height / 3.0
                    if node > 0 and node < NODES:
                        weight *= wp.where(node % 2 == 1, 4.0, 2.0)
                    whole += weight
                    once += weight * sign * away
                    twice += weight * away * away
                start += each * float(NODES)
                step = wp.min(2.0 * step, longest)
                if gain < -NEGLIGIBLE or each < 1.0e-6:
                    start = stop
        moved = once / wp.max(whole, 1.0e-30)
        mean[k, p] = top + moved
        sigma[k, p] = wp.sqrt(wp.max(twice / wp.max(whole, 1.0e-30) - moved * moved, 0.0) * known[2])
