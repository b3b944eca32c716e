"""Choose between the times that a histogram leaves open by the returns of the neighbours.

The best RIVALS peaks of the likelihood are hypotheses, beside "another time" and "no return at all". The neighbours' hypotheses, weighed
by their probabilities, are the prior distribution of a pixel's time and strength; each pixel's own likelihood enters once. The vote
chooses between peaks and moves none: a return's time follows from its own histogram.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.tof.histogram.likelihood import Recorded, Shape, likelihood_gain, recorded, shape
from kernels.tof.histogram.pileup import LiveCounts
from kernels.tof.histogram.pulse import Pulse
from kernels.tof.histogram.returns import Returns, added_at, positions_per_bin, scored
from kernels.tof.histogram.times import peak_reach, return_times

RIVALS = 3
"""Peaks of the likelihood that are kept for a pixel."""
SURE = 0.9999
"""Confidence from which a pixel keeps its return without a vote: neighbours change the odds of a peak by less than 1 / FLAT."""
FLAT = 0.02
"""Part of the prior that does not come from the neighbours but is even over all times, for a pixel on a surface that none of them shows."""
RADIUS = 2
"""Half width of the window of neighbours, pixels."""
STRENGTH, STRENGTH_RANGE = 0.7, 3.0
"""Standard deviation of the logarithm of the strength from a pixel to the next on one surface (its albedo), and the span of the logarithms
that a return may have."""
ROUNDS = 2
"""Votes: in the second, neighbours vote with the probabilities that the first gave them."""
SLOPE_WIDTHS = 0.25
"""Standard deviation of the time's change from a pixel to the next on one surface, in pulse widths (and bins, where these are wider)."""


class Voted(NamedTuple):
    """The most probable return of each pixel, on the host."""

    position: np.ndarray  # [pixel] float32 bins; 0 where there is no estimate
    sigma: np.ndarray  # [pixel] float32 bins
    photons: np.ndarray  # [pixel] float32
    confidence: np.ndarray  # [pixel] float32: probability of a return at this peak
    weak: np.ndarray  # [pixel] bool: not significant by itself; the return is the best guess
    none: np.ndarray  # [pixel] float32: probability of no return


def vote_on_returns(histograms: LiveCounts, pulse: Pulse, found: Returns, rows: int, cols: int, *, usable: np.ndarray, first_bin: float,
                    last_bin: float) -> Voted:
    """Return the most probable return of each pixel; waits for the device.

    Args:
        found: what it found; pixels whose first return is SURE keep it.
        usable: [pixel] bool: the others neither vote nor get a return.
        first_bin, last_bin: where returns may be.

    Source:
        Neighbours' hypotheses as a density: Järemo Lawin, Forssén, Ovrén, "Efficient multi-frequency phase unwrapping using kernel
        density estimation", ECCV 2016; here of photon arrival times. A posterior for every time and its neighbours' as a prior: Altmann,
        Ren, McCarthy, Buller, McLaughlin, "Lidar waveform-based analysis of depth images constructed using sparse single-photon data",
        IEEE Trans. Image Processing 25(5), 2016.
    """
    device = str(histograms.counts.device)
    pixels = histograms.counts.shape[1]
    position, sigma, photons, confidence = (to_numpy(array)[0].copy() for array in (found.position, found.sigma, found.photons,
                                                                                  found.confidence))
    times, spread, likely, strength = (np.zeros((RIVALS, pixels), dtype=np.float32) for _ in range(4))
    times[0], spread[0], likely[0], strength[0] = position, sigma, confidence, photons
    elsewhere, none = np.zeros(pixels, dtype=np.float32), np.where(confidence > 0, 1 - confidence, 0).astype(np.float32)
    open_ones = np.nonzero(usable & (confidence < SURE) & (to_numpy(found.background) > 0))[0]
    likely[:, ~usable], none[~usable] = 0, 0
    if len(open_ones) == 0:
        return Voted(position, sigma, photons, confidence, np.zeros(pixels, dtype=bool), none)
    some = histograms.of(open_ones)
    background = wp.array(to_numpy(found.background)[open_ones], dtype=wp.float32, device=device)
    outputs = [*(wp.zeros((RIVALS, len(open_ones)), dtype=wp.float32, device=device) for _ in range(4)),
               *(wp.zeros(len(open_ones), dtype=wp.float32, device=device) for _ in range(2))]
    devices.launch(_rivals_kernel, len(open_ones), [recorded(some), shape(pulse, device), positions_per_bin(pulse), first_bin, last_bin,
                                                    background], outputs, device=device, uneven=True)
    times[:, open_ones], strength[:, open_ones], spread[:, open_ones], likely[:, open_ones] = (to_numpy(array) for array in outputs[:4])
    elsewhere[open_ones], none[open_ones] = (to_numpy(array) for array in outputs[4:])
    after, none[open_ones] = _vote(times, spread, strength, likely, elsewhere, none, rows, cols, open_ones, span=last_bin - first_bin,
                                   slope=SLOPE_WIDTHS * max(pulse.width, 1.0), device=device)
    best = np.argmax(after, axis=0)
    chosen = np.arange(len(open_ones))
    place, photon = (wp.array(array[best, open_ones][None], dtype=wp.float32, device=device) for array in (times, strength))
    exact = return_times(some, pulse, place, photon, background, first_bin=first_bin, last_bin=last_bin)
    there = strength[best, open_ones] > 0
    before = photons[open_ones] > 0
    kept = before & (np.abs(times[best, open_ones] - position[open_ones]) < pulse.width)  # with the other returns taken into account
    new = open_ones[there & ~kept]
    taken = there & ~kept
    position[new], sigma[new] = to_numpy(exact.position)[0][taken], to_numpy(exact.sigma)[0][taken]
    photons[new] = strength[best, open_ones][taken]
    confidence[open_ones] = np.where(there, after[best, chosen], 0)
    weak = np.zeros(pixels, dtype=bool)
    weak[new] = True
    return Voted(position, sigma, photons, confidence, weak, none)


def _vote(times: np.ndarray, spread: np.ndarray, strength: np.ndarray, likely: np.ndarray, elsewhere: np.ndarray, none: np.ndarray,
          rows: int, cols: int, open_ones: np.ndarray, *, span: float, slope: float, device: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the probabilities of each rival, [rival, open pixel], and of no return, [open pixel], of the open pixels; the arguments are
    [rival, pixel] and [pixel]."""
    placed, width, strong, own = (wp.array(array, dtype=wp.float32, device=device) for array in (times, spread, strength, likely))
    own_elsewhere, own_none = (wp.array(array, dtype=wp.float32, device=device) for array in (elsewhere, none))
    turns = wp.array(open_ones.astype(np.int32), device=device)
    before, before_elsewhere, before_none = own, own_elsewhere, own_none
    for _ in range(ROUNDS):
        after, after_elsewhere, after_none = (wp.clone(array) for array in (own, own_elsewhere, own_none))
        devices.launch(_vote_kernel, len(open_ones), [turns, placed, width, strong, own, own_elsewhere, own_none, before, before_elsewhere,
                                                      before_none, rows, cols, span, slope], [after, after_elsewhere, after_none],
                       device=device)
        before, before_elsewhere, before_none = after, after_elsewhere, after_none
    return to_numpy(before)[:, open_ones], to_numpy(before_none)[open_ones]


@wp.func
def is_free(times: wp.array2d(dtype=wp.float32), found: int, t: float, reach: float, p: int) -> bool:
    """Tell whether a time is beyond the reach of every rival found."""
    free = bool(True)
    for m in range(found):
        if wp.abs(times[m, p] - t) <= reach:
            free = False
    return free


@wp.kernel(module="unique", module_options={"max_unroll": 0})  # unrolled, it is no faster and takes seconds to compile
def _rivals_kernel(first: int,
                   given: Recorded,
                   pulse: Shape,
                   per_bin: int,
                   first_bin: float,
                   last_bin: float,
                   background: wp.array(dtype=wp.float32),  # [pixel]
                   # outputs
                   times: wp.array2d(dtype=wp.float32),  # [RIVALS, pixel]
                   photons: wp.array2d(dtype=wp.float32),
                   spread: wp.array2d(dtype=wp.float32),
                   likely: wp.array2d(dtype=wp.float32),
                   elsewhere: wp.array(dtype=wp.float32),  # [pixel]
                   none: wp.array(dtype=wp.float32)):
    p = first + wp.tid()
    b = background[p]
    bins = given.counts.shape[0]
    low = int(wp.ceil(first_bin * float(per_bin)))
    high = int(last_bin * float(per_bin)) + 1
    reach = peak_reach(pulse)
    everything = float(0.0)
    exposure = float(0.0)
    start = wp.max(int(first_bin), 0)
    stop = wp.min(int(wp.ceil(last_bin)), bins)
    for i in range(start, stop):  # what lies outside of the span does not tell whether a return is in it
        everything += given.counts[i, p]
        exposure += given.live[i, p]
    top = float(0.0)
    everywhere = float(0.0)  # Σ e^gain / √strength, in units of e^top
    inside = float(0.0)  # the part of it at the rivals
    found = wp.int32(0)
    going = wp.int32(1)
    while going == 1 and found < RIVALS:
        gain = float(0.0)
        place = float(-1.0)
        strength = float(0.0)
        for j in range(low, high):
            t = float(j) / float(per_bin)
            if is_free(times, found, t, reach, p):
                added = added_at(given, pulse, t, b, p, 0, times, photons)
                if added[0] > gain:
                    if found == 0:
                        everywhere *= wp.exp(gain - added[0])
                    gain = added[0]
                    place = t
                    strength = added[1]
                if found == 0:
                    everywhere += wp.exp(added[0] - gain) / wp.sqrt(wp.max(added[1], 1.0))
        if place < 0.0:
            going = 0
        else:
            if found == 0:
                top = gain
            mass = float(0.0)
            once = float(0.0)
            twice = float(0.0)
            for j in range(wp.max(int(wp.ceil((place - reach) * float(per_bin))), low),
                           wp.min(int((place + reach) * float(per_bin)) + 1, high)):
                t = float(j) / float(per_bin)
                if is_free(times, found, t, reach, p):
                    added = added_at(given, pulse, t, b, p, 0, times, photons)
                    w = wp.exp(added[0] - top) / wp.sqrt(wp.max(added[1], 1.0))
                    mass += w
                    once += w * (t - place)
                    twice += w * (t - place) * (t - place)
            once /= mass
            times[found, p] = place
            photons[found, p] = strength
            spread[found, p] = wp.sqrt(wp.max(twice / mass - once * once, 0.0))
            likely[found, p] = mass
            inside += mass
            found += 1
    if found > 0:
        # a histogram of background alone, at its best
        flat = wp.max(everything / wp.max(exposure, 1.0), 1.0e-6)
        gain = float(0.0)
        for i in range(start, stop):
            gain += likelihood_gain(given, i, p, b, flat)
        nothing = float(high - low) * wp.exp(wp.min(gain - top, 60.0))
        rest = wp.max(everywhere - inside, 0.0)
        whole = inside + rest + nothing
        for m in range(found):
            likely[m, p] = likely[m, p] / whole
            at = scored(given, pulse, m, p, 0, b, first_bin, last_bin, times, photons)
            if wp.abs(at[0] - times[m, p]) < reach:
                times[m, p] = at[0]
                photons[m, p] = at[1]
        elsewhere[p] = rest / whole
        none[p] = nothing / whole


@wp.kernel(module="unique")
def _vote_kernel(first: int,
                 turns: wp.array(dtype=wp.int32),  # [open pixel]
                 times: wp.array2d(dtype=wp.float32),  # [RIVALS, pixel]
                 spread: wp.array2d(dtype=wp.float32),
                 strength: wp.array2d(dtype=wp.float32),
                 own: wp.array2d(dtype=wp.float32),  # by the pixel's own histogram
                 own_elsewhere: wp.array(dtype=wp.float32),  # [pixel]
                 own_none: wp.array(dtype=wp.float32),
                 before: wp.array2d(dtype=wp.float32),  # after the last vote
                 before_elsewhere: wp.array(dtype=wp.float32),
                 before_none: wp.array(dtype=wp.float32),
                 rows: int,
                 cols: int,
                 span: float,
                 slope: float,
                 # outputs
                 after: wp.array2d(dtype=wp.float32),
                 after_elsewhere: wp.array(dtype=wp.float32),
                 after_none: wp.array(dtype=wp.float32)):
    p = turns[first + wp.tid()]
    r = p // cols
    c = p - r * cols
    density = wp.vec3()
    missing = float(0.0)
    scattered = float(0.0)
    voters = float(0.0)
    for i in range(wp.max(r - RADIUS, 0), wp.min(r + RADIUS + 1, rows)):
        for j in range(wp.max(c - RADIUS, 0), wp.min(c + RADIUS + 1, cols)):
            q = i * cols + j
            whole = before[0, q] + before[1, q] + before[2, q] + before_elsewhere[q] + before_none[q]
            if q != p and whole > 0.0:
                voters += 1.0
                missing += before_none[q]
                scattered += before_elsewhere[q]
                apart = float((i - r) * (i - r) + (j - c) * (j - c)) * slope * slope
                for k in range(RIVALS):
                    if before[k, q] > 1.0e-3:
                        for n in range(RIVALS):
                            variance = spread[k, q] * spread[k, q] + spread[n, p] * spread[n, p] + apart
                            away = times[k, q] - times[n, p]
                            # and how alike their strengths are, relative to a prior that is even over STRENGTH_RANGE
                            doubt = STRENGTH * STRENGTH + 1.0 / wp.max(strength[k, q], 1.0) + 1.0 / wp.max(strength[n, p], 1.0)
                            ratio = wp.log(wp.max(strength[k, q], 0.1) / wp.max(strength[n, p], 0.1))
                            alike = STRENGTH_RANGE * wp.exp(-0.5 * (away * away / variance + ratio * ratio / doubt))
                            density[n] += before[k, q] * alike / (2.0 * wp.pi * wp.sqrt(variance * doubt))
    if voters > 0.0 and own[0, p] > 0.0:
        # relative to the prior that the own probabilities have: one half for no return, the other half even over the span
        share = (1.0 - FLAT) / voters
        spaced = FLAT + 2.0 * share * scattered
        whole = float(0.0)
        for n in range(RIVALS):
            after[n, p] = own[n, p] * (spaced + 2.0 * share * span * density[n])
            whole += after[n, p]
        after_elsewhere[p] = own_elsewhere[p] * spaced
        after_none[p] = own_none[p] * (FLAT + 2.0 * share * missing)
        whole += after_elsewhere[p] + after_none[p]
        for n in range(RIVALS):
            after[n, p] = after[n, p] / whole
        after_elsewhere[p] = after_elsewhere[p] / whole
        after_none[p] = after_none[p] / whole
