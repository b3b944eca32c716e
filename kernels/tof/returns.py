"""Photon histograms → returns: background, matched filter, and maximum likelihood of time and strength, several returns a pixel.

Counts are Poisson variables of mean awake · (b + Σ s·p(t)): background b, and for each return its photons s spread over the bins by the
pulse p at time t. A return is looked for where it adds most to the likelihood, which is the matched filter of low counts as well as of
high ones; then its time and strength are moved to the maximum by Fisher scoring, and so between the bins.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.pileup import Exposed
from kernels.tof.pulse import Pulse

FALSE_ALARMS = 1e-3
"""Part of the pixels without a return in which one is found."""
POSITIONS_PER_BIN = 2
"""Of the search: the refinement starts at most a quarter of a bin away."""
SCORING_STEPS = 8
"""Of the refinement: with steps of at most half a bin it settles to a thousandth of its deviation in five."""
BACKGROUND_ROUNDS = 2
LEAST_OUTSIDE = 4
"""Bins without a return that the background is taken from; with fewer it stays at what the search took it for."""

_OK, _LOW, _SATURATED = int(Status.OK), int(Status.LOW_MODULATION), int(Status.SATURATED)

wp.set_module_options({"enable_backward": False})


class Returns(NamedTuple):
    """Returns of each pixel, the most certain first; on the device. What was not found is 0."""

    position: wp.array  # [return, pixel] float32: time in bins from the start of the histogram
    sigma: wp.array  # [return, pixel] float32 bins: standard deviation of the position
    photons: wp.array  # [return, pixel] float32: of the return, as if no pulse had been lost to pile-up
    evidence: wp.array  # [return, pixel] float32: twice the log likelihood that the return adds
    background: wp.array  # [pixel] float32 photons a bin
    likelihood: wp.array  # [pixel] float32: log likelihood of the whole histogram
    status: wp.array  # [pixel] int32: of the first return


def find_returns(exposed: Exposed, pulse: Pulse, *, most: int = 1, first_bin: float = 0.0, last_bin: float | None = None) -> Returns:
    """Find the returns of each histogram.

    Args:
        exposed: counts, and the part of the pulses that saw each bin.
        pulse: shape of a return.
        most: returns to look for, 1 to 4; later ones only where they are as significant as the first must be.
        first_bin, last_bin: where returns may be, in bins from the start; None: to the end.

    Returns:
        The returns. LOW_MODULATION: nothing stands out from the background (an empty histogram too); SATURATED: pile-up left no pulse
        in any bin of the return.

    Raises:
        ArrayError: `most` is not 1 to 4, or the bins leave no place for a return.

    Source:
        Matched filter and Poisson likelihood: Snyder, "Random Point Processes", 1975; Bar-David, "Communication under the
        Poisson regime", IEEE Trans. Information Theory 15(1), 1969. σ from the Fisher information, with the strength unknown.
    """
    bins, pixels = exposed.counts.shape
    last = float(bins) if last_bin is None else min(float(last_bin), float(bins))
    if not 1 <= most <= 4:
        raise ArrayError(f"{most} returns are asked for: 1 to 4 can be")
    first_bin = max(first_bin, 0.0)
    if not first_bin < last:
        raise ArrayError(f"returns from bin {first_bin:g} to bin {last:g} leave no place: the histogram has {bins} bins")
    device = str(exposed.counts.device)
    perms = [wp.zeros((most, pixels), dtype=wp.float32, device=device) for _ in range(4)]
    background, likelihood = (wp.zeros(pixels, dtype=wp.float32, device=device) for _ in range(2))
    status = wp.zeros(pixels, dtype=wp.int32, device=device)
    devices.launch(_returns_kernel, pixels, [
        exposed.counts, exposed.awake, wp.array(pulse.cumulative.astype(np.float32), dtype=wp.float32, device=device),
        wp.array(pulse.density.astype(np.float32), dtype=wp.float32, device=device), float(pulse.begin), float(1 / pulse.step),
        float(pulse.end), float(pulse.width), first_bin, last, threshold(bins)],
        [*perms, background, likelihood, status], device=device, uneven=True)
    return Returns(*perms, background, likelihood, status)


def threshold(bins: int) -> float:
    """Evidence that chance reaches in FALSE_ALARMS of the histograms: chi-squared of two degrees of freedom, in any of the bins."""
    return float(2 * np.log(bins / FALSE_ALARMS))


def returns_kernel(pack: int) -> Any:
    """For tests that compile it; single pixels whatever the pack."""
    return _returns_kernel


@wp.func
def at(table: wp.array(dtype=wp.float32), x: float, begin: float, per_step: float):
    """Of a table, linearly; its first entry before it begins, its last after it ends."""
    u = wp.clamp((x - begin) * per_step, 0.0, float(table.shape[0] - 1))
    k = wp.min(int(u), table.shape[0] - 2)
    part = u - float(k)
    return table[k] * (1.0 - part) + table[k + 1] * part


@wp.func
def slope_at(table: wp.array(dtype=wp.float32), x: float, begin: float, per_step: float):
    """Density, zero outside the table."""
    u = (x - begin) * per_step
    value = float(0.0)
    if u > 0.0 and u < float(table.shape[0] - 1):
        value = at(table, x, begin, per_step)
    return value


@wp.kernel(module="unique")
def _returns_kernel(first: int,
                    counts: wp.array2d(dtype=wp.float32),  # [bin, pixel]
                    awake: wp.array2d(dtype=wp.float32),  # [bin, pixel]
                    cumulative: wp.array(dtype=wp.float32),
                    density: wp.array(dtype=wp.float32),
                    begin: float,  # bins
                    per_step: float,
                    end: float,  # bins
                    width: float,  # bins: nearer than this two returns are one
                    first_bin: float,
                    last_bin: float,
                    threshold: float,
                    # outputs
                    position: wp.array2d(dtype=wp.float32),  # [K, pixel]
                    sigma: wp.array2d(dtype=wp.float32),
                    photons: wp.array2d(dtype=wp.float32),
                    evidence: wp.array2d(dtype=wp.float32),
                    background: wp.array(dtype=wp.float32),
                    likelihood: wp.array(dtype=wp.float32),
                    status: wp.array(dtype=wp.int32)):
    p = first + wp.tid()
    bins = counts.shape[0]
    everything = float(0.0)
    exposure = float(0.0)
    top = float(-1.0)
    top_bin = wp.int32(0)
    for i in range(bins):
        everything += counts[i, p]
        exposure += awake[i, p]
        if counts[i, p] > top * wp.max(awake[i, p], 1.0e-6):
            top = counts[i, p] / wp.max(awake[i, p], 1.0e-6)
            top_bin = i
    code = int(_LOW)
    if exposure < float(LEAST_OUTSIDE):
        code = int(_SATURATED)
    elif everything > 0.0:
        least = 0.5 / exposure  # half a count in the whole histogram
        # background without the highest bin and what a pulse about it covers
        inside = float(0.0)
        hidden = float(0.0)
        reach = int(wp.ceil(end - begin))
        for i in range(wp.max(top_bin - reach, 0), wp.min(top_bin + reach + 1, bins)):
            inside += counts[i, p]
            hidden += awake[i, p]
        b = everything / exposure
        if exposure - hidden > float(LEAST_OUTSIDE):
            b = wp.min((everything - inside) / (exposure - hidden), b)
        b = wp.max(b, least)
        found = wp.int32(0)
        going = wp.int32(1)
        while going == 1 and found < position.shape[0]:
            # where a return adds most to the likelihood
            gain = float(0.0)
            place = float(-1.0)
            strength = float(0.0)
            j = int(wp.ceil(first_bin * float(POSITIONS_PER_BIN)))
            while j <= int(last_bin * float(POSITIONS_PER_BIN)):
                t = float(j) / float(POSITIONS_PER_BIN)
                free = wp.int32(1)
                for m in range(found):
                    if wp.abs(position[m, p] - t) < width:
                        free = 0
                if free == 1:
                    low = wp.max(int(wp.floor(t + begin)), 0)
                    high = wp.min(int(wp.ceil(t + end)), bins)
                    excess = float(0.0)
                    share = float(0.0)
                    before = at(cumulative, float(low) - t, begin, per_step)
                    for i in range(low, high):
                        after = at(cumulative, float(i + 1) - t, begin, per_step)
                        mean = float(b)
                        for m in range(found):
                            mean += photons[m, p] * (at(cumulative, float(i + 1) - position[m, p], begin, per_step)
                                                     - at(cumulative, float(i) - position[m, p], begin, per_step))
                        excess += counts[i, p] - awake[i, p] * mean
                        share += awake[i, p] * (after - before)
                        before = after
                    if excess > 0.0 and share > 0.05:
                        s = excess / share
                        added = -s * share
                        before = at(cumulative, float(low) - t, begin, per_step)
                        for i in range(low, high):
                            after = at(cumulative, float(i + 1) - t, begin, per_step)
                            if counts[i, p] > 0.0:
                                mean = float(b)
                                for m in range(found):
                                    mean += photons[m, p] * (at(cumulative, float(i + 1) - position[m, p], begin, per_step)
                                                             - at(cumulative, float(i) - position[m, p], begin, per_step))
                                added += counts[i, p] * wp.log(1.0 + s * (after - before) / mean)
                            before = after
                        if added > gain:
                            gain = added
                            place = t
                            strength = s
                j += 1
            if 2.0 * gain < threshold:
                going = 0
            else:
                position[found, p] = place
                photons[found, p] = strength
                found += 1
                for _turn in range(BACKGROUND_ROUNDS):
                    # background: what lies outside all returns
                    outside = float(0.0)
                    seen = float(0.0)
                    for i in range(bins):
                        covered = wp.int32(0)
                        for m in range(found):
                            if float(i + 1) > position[m, p] + begin and float(i) < position[m, p] + end:
                                covered = 1
                        if covered == 0:
                            outside += counts[i, p]
                            seen += awake[i, p]
                    if seen > float(LEAST_OUTSIDE):
                        b = wp.max(outside / seen, least)
                    # each return in turn to its maximum of likelihood, by Fisher scoring
                    for k in range(found):
                        t = position[k, p]
                        s = photons[k, p]
                        for _step in range(SCORING_STEPS):
                            gs = float(0.0)
                            gt = float(0.0)
                            ss = float(0.0)
                            st = float(0.0)
                            tt = float(0.0)
                            low = wp.max(int(wp.floor(t + begin)), 0)
                            high = wp.min(int(wp.ceil(t + end)), bins)
                            before = at(cumulative, float(low) - t, begin, per_step)
                            edge = slope_at(density, float(low) - t, begin, per_step)
                            for i in range(low, high):
                                after = at(cumulative, float(i + 1) - t, begin, per_step)
                                next_edge = slope_at(density, float(i + 1) - t, begin, per_step)
                                part = after - before
                                moves = edge - next_edge
                                before = after
                                edge = next_edge
                                mean = float(b)
                                for m in range(found):
                                    if m != k:
                                        mean += photons[m, p] * (at(cumulative, float(i + 1) - position[m, p], begin, per_step)
                                                                 - at(cumulative, float(i) - position[m, p], begin, per_step))
                                mean += s * part
                                off = counts[i, p] / mean - awake[i, p]
                                gs += off * part
                                gt += off * s * moves
                                w = awake[i, p] / mean
                                ss += w * part * part
                                st += w * s * part * moves
                                tt += w * s * s * moves * moves
                            tt_damped = tt + 12.0  # of a time known to a bin: keeps steps short where the pulse hides in one bin
                            determinant = wp.max(ss * tt_damped - st * st, 1.0e-30)
                            move_s = (gs * tt_damped - gt * st) / determinant
                            move_t = (gt * ss - gs * st) / determinant
                            s = wp.max(s + move_s, 0.3 * s)
                            t = wp.clamp(t + wp.clamp(move_t, -0.5, 0.5), first_bin, last_bin)
                            known = tt - st * st / wp.max(ss, 1.0e-30)
                            sigma[k, p] = wp.min(1.0 / wp.sqrt(wp.max(known, 1.0e-12)), 0.28867513)  # one over the root of twelve
                        position[k, p] = t
                        photons[k, p] = s
                evidence[found - 1, p] = 2.0 * gain
        if found > 0:
            code = int(_OK)
        background[p] = b
        total = float(0.0)
        for i in range(bins):
            mean = float(b)
            for m in range(found):
                mean += photons[m, p] * (at(cumulative, float(i + 1) - position[m, p], begin, per_step)
                                         - at(cumulative, float(i) - position[m, p], begin, per_step))
            total += counts[i, p] * wp.log(mean) - awake[i, p] * mean
        likelihood[p] = total
    status[p] = code
