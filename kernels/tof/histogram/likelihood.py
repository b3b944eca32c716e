"""Likelihood of a histogram: what each bin is expected to hold, and what its count says about that.

A bin of mean λ (background and returns, all pulses together) in which the detector was live for the part a of the pulses counts n photons:
a Poisson variable of mean a·λ; or, where each of N pulses counts one photon at most, binomial: a·N pulses of probability 1 - exp(-λ/N).
Both are one formula in r = (1 - e^-x)/x with x = λ/N, which is 1 where N has no limit:

    log likelihood   n·log(λ·r) - (a - n/N)·λ
    its slope in λ   n/(λ·r) - a
    information      a/(λ·r·e^x)

Source:
    Snyder, "Random Point Processes", 1975, for Poisson counts; the binomial ones are those that Coates (J. Phys. E 1(8), 1968) corrects.
"""

import warp as wp

from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse


@wp.struct
class Recorded:
    """Histograms on the device."""

    counts: wp.array2d(dtype=wp.float32)  # [bin, pixel] corrected for pile-up
    live: wp.array2d(dtype=wp.float32)  # [bin, pixel] 0…1
    per_pulse: float  # 1/N, 0 for Poisson counts


@wp.struct
class Shape:
    """A pulse on the device."""

    cumulative: wp.array(dtype=wp.float32)
    density: wp.array(dtype=wp.float32)
    begin: float  # bins
    per_step: float
    end: float  # bins
    width: float  # bins: nearer than this two returns are one


@wp.func
def returns_found(photons: wp.array2d(dtype=wp.float32), p: int) -> int:
    """Return how many returns a pixel has; they come first."""
    found = wp.int32(0)
    for m in range(photons.shape[0]):
        if photons[m, p] > 0.0:
            found = m + 1
    return found


def recorded(histograms: LiveCounts) -> Recorded:
    """Return the histograms as the kernels take them."""
    given = Recorded()
    given.counts, given.live, given.per_pulse = histograms.counts, histograms.live, 1 / histograms.pulses
    return given


def shape(pulse: Pulse, device: str) -> Shape:
    """Return the pulse as the kernels take it."""
    given = Shape()
    given.cumulative = wp.array(pulse.cumulative, dtype=wp.float32, device=device)
    given.density = wp.array(pulse.density, dtype=wp.float32, device=device)
    given.begin, given.per_step, given.end, given.width = pulse.begin, 1 / pulse.step, pulse.end, pulse.width
    return given


@wp.func
def table_at(table: wp.array(dtype=wp.float32), x: float, begin: float, per_step: float):
    """Return a table's value, interpolated linearly; its first entry before it begins, its last after it ends."""
    u = wp.clamp((x - begin) * per_step, 0.0, float(table.shape[0] - 1))
    k = wp.min(int(u), table.shape[0] - 2)
    part = u - float(k)
    return table[k] * (1.0 - part) + table[k + 1] * part


@wp.func
def share_before(pulse: Shape, x: float):
    """Return the part of a return that comes before x, in bins after its time."""
    return table_at(pulse.cumulative, x, pulse.begin, pulse.per_step)


@wp.func
def density_at(pulse: Shape, x: float):
    """Return the part of a return per bin at x bins after its time; zero outside the table."""
    u = (x - pulse.begin) * pulse.per_step
    value = float(0.0)
    if u > 0.0 and u < float(pulse.density.shape[0] - 1):
        value = table_at(pulse.density, x, pulse.begin, pulse.per_step)
    return value


@wp.func
def first_bin_of(pulse: Shape, t: float):
    """Return the first bin that a return at t reaches, not before the histogram."""
    return wp.max(int(wp.floor(t + pulse.begin)), 0)


@wp.func
def end_bin_of(pulse: Shape, t: float, bins: int):
    """Return the bin after the last that a return at t reaches, not after the histogram."""
    return wp.min(int(wp.ceil(t + pulse.end)), bins)


@wp.func
def mean_of_bin(pulse: Shape, i: int, p: int, without: int, found: int, background: float,
                position: wp.array2d(dtype=wp.float32),  # [return, pixel]
                photons: wp.array2d(dtype=wp.float32)):  # [return, pixel]
    """Return the photons of background and returns in a bin, without those of the return `without` (-1: with all)."""
    mean = float(background)
    for m in range(found):
        if m != without:
            t = position[m, p]
            mean += photons[m, p] * (share_before(pulse, float(i + 1) - t) - share_before(pulse, float(i) - t))
    return mean


@wp.func
def counted_part(x: float):
    """Return r, the part of the arriving photons that is counted, with x photons a pulse of which one at most is counted."""
    part = float(1.0)
    if x > 0.05:
        part = (1.0 - wp.exp(-x)) / x
    elif x > 0.0:
        part = 1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0))  # the difference would lose its digits
    return part


@wp.func
def counted(given: Recorded, i: int, p: int):
    """Return n, the photons that were counted, from what Coates's correction made of them."""
    count = given.counts[i, p]
    if given.per_pulse > 0.0 and given.live[i, p] > 0.0:
        count = count * counted_part(count * given.per_pulse / given.live[i, p])
    return count


@wp.func
def likelihood_gain(given: Recorded, i: int, p: int, old: float, new: float):
    """Return the log likelihood of a bin of mean `new`, less that of mean `old`."""
    count = counted(given, i, p)
    gain = -(given.live[i, p] - count * given.per_pulse) * (new - old)
    if count > 0.0:
        gain += count * wp.log(new * counted_part(new * given.per_pulse) / (old * counted_part(old * given.per_pulse)))
    return gain


@wp.func
def likelihood_slope(given: Recorded, i: int, p: int, mean: float):
    """Return the derivative of the log likelihood of a bin by its mean."""
    return counted(given, i, p) / (mean * counted_part(mean * given.per_pulse)) - given.live[i, p]


@wp.func
def information(given: Recorded, i: int, p: int, mean: float):
    """Return the Fisher information of a bin about its mean."""
    x = mean * given.per_pulse
    return given.live[i, p] / (mean * counted_part(x) * wp.exp(x))
