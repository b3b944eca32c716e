"""Phases of several frequencies → range: maximum likelihood over the wraps, and a vote of the neighbourhood on what stays open.

Every range d that explains the phase of the most precise frequency is a hypothesis; each is moved to the weighted least-squares range of
all frequencies, and its cost is the sum of squared phase errors over their variances: -2 log likelihood. The best HYPOTHESES of a pixel
stay with their probabilities, so that neighbours can decide between them.
"""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type, scalars
from kernels.status import Status
from kernels.tof.continuous import Correlation
from kernels.tof.modulation import radians_per_metre, require_span

HYPOTHESES = 3
"""Kept a pixel: a fourth has had no influence on the result in the simulated scenes."""
FLOOR_RAD = 1e-3
"""Phases are not trusted further than this, however bright: 0.3 mm at 80 MHz."""
FAR = 1e20
"""Cost of what is no hypothesis."""
AGREEMENT_RAD = 0.01
"""Systematic error of a phase that is no sign of multipath: what calibration leaves."""
MULTIPATH_Z = 3.72
"""Standard normal quantile: one pixel in ten thousand with a single return is called multipath."""
SIGNAL_Z = 4.75
"""One pixel in a million without signal is taken to have one."""
DECIDED = 2 / 3
"""Probability that the chosen wrap must have."""
VOTE_RADIUS = 2
"""Pixels: 24 neighbours."""
VOTE_ROUNDS = 2
SAME_SURFACE = 0.3
"""Neighbours within this part of the wrap distance count as the same surface."""
CERTAIN = 1 - 1e-5
"""Probability from which a pixel is not asked again: two rounds multiply the odds of another wrap by at most 1 / STRANGER²."""
STRANGER = 0.02
"""Prior of a pixel on a surface that none of its neighbours is on: how far they can outvote what it measured itself."""

_OK, _UNDECIDED, _MULTIPATH = int(Status.OK), int(Status.UNDECIDED), int(Status.MULTIPATH)
_LOW, _SATURATED, _OUT = int(Status.LOW_MODULATION), int(Status.SATURATED), int(Status.OUT_OF_RANGE)

wp.set_module_options({"enable_backward": False})


class Hypotheses(NamedTuple):
    """The best wraps of each pixel, on the device; pixels are padded to whole packs."""

    range: wp.array  # [HYPOTHESES, pixel] float32 metres; 0 where there are fewer
    probability: wp.array  # [HYPOTHESES, pixel] float32, adds up to 1 where there is any
    sigma: wp.array  # [pixel] float32 metres: standard deviation of the range, given that the wrap is right
    spacing_m: float  # between wraps of the highest frequency


class Ranges(NamedTuple):
    """Range of each pixel, on the device; pixels are padded to whole packs."""

    range: wp.array  # [pixel] float32 metres along the ray; kept for UNDECIDED and MULTIPATH too, else 0
    sigma: wp.array  # [pixel] float32 metres
    confidence: wp.array  # [pixel] float32: probability of the wrap
    wraps: wp.array  # [pixel] int32: whole turns of the highest frequency in the range
    status: wp.array  # [pixel] int32, kernels.status.Status


def quantile(freedom: int, z: float) -> float:
    """Of the chi-squared distribution, by Wilson and Hilferty's approximation (PNAS 1931): error below 3 % here."""
    a = 2 / (9 * freedom)
    return float(freedom * (1 - a + z * a**0.5) ** 3)


def unwrap(found: Correlation, *, nearest_m: float, farthest_m: float) -> Hypotheses:
    """Weigh every wrap of every pixel.

    Args:
        found: phases with their standard deviations.
        nearest_m, farthest_m: the span to look in; three standard deviations beyond either end are looked at too.

    Returns:
        The hypotheses, on the device.

    Raises:
        ArrayError: the frequencies cannot tell the whole span apart; the message says what they can.

    Source:
        Droeschel, Holz, Behnke, "Multi-frequency phase unwrapping for time-of-flight cameras", IROS 2010; weights from photon noise
        and hypotheses as Järemo Lawin, Forssén, Ovrén, "Efficient multi-frequency phase unwrapping using kernel density estimation",
        ECCV 2016, section 3.
    """
    require_span(found.modulation_hz, nearest_m, farthest_m)
    device, pixels = str(found.phase.device), found.phase.shape[1]
    pack = devices.pack_width(device)
    per_metre = radians_per_metre(found.modulation_hz)
    wave = 2 * np.pi / per_metre[-1]
    ranges, probability = (scalars(pixels, HYPOTHESES, wp.float32, device) for _ in range(2))
    sigma = scalars(pixels, None, wp.float32, device)
    scratch = scalars(pixels, len(per_metre), wp.float32, device)
    devices.launch(unwrap_kernel(pack), pixels // pack, [
        as_packs(found.phase, device), as_packs(found.sigma, device), _floats(per_metre, device), int(np.floor(nearest_m / wave)) - 1,
        int(np.ceil(farthest_m / wave)), float(nearest_m), float(farthest_m), as_packs(scratch, device)],
        [as_packs(array, device) for array in (ranges, probability, sigma)], device=device)
    return Hypotheses(ranges, probability, sigma, float(wave))


def vote(weighed: Hypotheses, rows: int, cols: int) -> Hypotheses:
    """Let neighbours decide between the hypotheses of each pixel; ranges stay what they are, probabilities move.

    The probability of a hypothesis is multiplied by the density that the neighbours' hypotheses, weighed by their probabilities, have at
    its range, plus a little for a pixel that is on none of their surfaces. Nothing is smoothed.

    Args:
        weighed: of `unwrap`; rows · cols pixels and padding.
        rows, cols: of the image.

    Raises:
        ArrayError: the image has another number of pixels.

    Source:
        Järemo Lawin, Forssén, Ovrén, ECCV 2016, equations 9 and 10 (kernel density over the neighbourhood).
    """
    device, pixels = weighed.range.device, weighed.range.shape[1]
    if not 0 < rows * cols <= pixels:
        raise ArrayError(f"there are {pixels} pixels, the image is {rows} x {cols}: give the image's own size")
    before = weighed.probability
    for _ in range(VOTE_ROUNDS):
        after = wp.zeros_like(before)
        devices.launch(_vote_kernel, rows * cols, [weighed.range, before, rows, cols, 1.0 / (SAME_SURFACE * weighed.spacing_m)], [after],
                       device=str(device))
        before = after
    return weighed._replace(probability=before)


def decide(found: Correlation, weighed: Hypotheses, *, nearest_m: float, farthest_m: float,
           agreement_rad: float = AGREEMENT_RAD) -> Ranges:
    """Take the most probable hypothesis of each pixel and say why where it is not good enough.

    Args:
        found, weighed: phases and hypotheses of the same pixels.
        nearest_m, farthest_m: ranges more than three standard deviations outside are OUT_OF_RANGE.
        agreement_rad: systematic error of a phase up to which frequencies count as agreeing.

    Returns:
        Ranges, on the device. LOW_MODULATION: no more amplitude than noise has; SATURATED: no frequency is left; MULTIPATH: frequencies
        disagree by more than noise and `agreement_rad` explain; UNDECIDED: the wrap is less probable than DECIDED.
    """
    device, pixels = weighed.range.device, weighed.range.shape[1]
    count = len(found.modulation_hz)
    agree = [float("inf"), *(quantile(freedom, MULTIPATH_Z) for freedom in range(1, count))]
    signal = [float("inf"), *(quantile(2 * used, SIGNAL_Z) for used in range(1, count + 1))]
    result = Ranges(*(wp.zeros(pixels, dtype=dtype, device=device) for dtype in (wp.float32, wp.float32, wp.float32, wp.int32, wp.int32)))
    devices.launch(_decide_kernel, pixels, [
        found.phase, found.sigma, found.evidence, _floats(radians_per_metre(found.modulation_hz), device), _floats(agree, device),
        _floats(signal, device), weighed.range, weighed.probability, weighed.sigma, float(nearest_m), float(farthest_m),
        float(agreement_rad) ** 2,
    ], list(result), device=str(device))
    return result


def vote_kernel(pack: int) -> Any:
    """For tests that compile it; single pixels whatever the pack."""
    return _vote_kernel


def decide_kernel(pack: int) -> Any:
    """For tests that compile it; single pixels whatever the pack."""
    return _decide_kernel


def _floats(values: Any, device: Any) -> wp.array:
    return wp.array(np.asarray(values, dtype=np.float32), dtype=wp.float32, device=device)


@cache
def unwrap_kernel(pack: int) -> Any:
    """The kernel for packs of this many pixels; public for the test that compiles it for CUDA."""
    float_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def hypotheses_kernel(first: int,
                          phase: wp.array2d(dtype=float_pack),  # [F, P]
                          sigma: wp.array2d(dtype=float_pack),  # [F, P]
                          per_metre: wp.array(dtype=wp.float32),  # [F]
                          lowest: int,  # turns of the highest frequency to begin and end with
                          highest: int,
                          nearest: float,
                          farthest: float,
                          weight: wp.array2d(dtype=float_pack),  # [F, P] scratch: 1 / variance of the phase; 0 where not usable
                          # outputs
                          ranges: wp.array2d(dtype=float_pack),  # [3, P]
                          probability: wp.array2d(dtype=float_pack),  # [3, P]
                          range_sigma: wp.array(dtype=float_pack)):  # [P]
        p = first + wp.tid()
        total, sharpest, start, wave = float_pack(), float_pack(), float_pack(), float_pack()
        for f in range(per_metre.shape[0]):  # the frequency that says most about the range is the anchor
            s = sigma[f, p]
            angle = phase[f, p]
            w = float_pack()
            k2 = per_metre[f] * per_metre[f]
            for k in range(pack):
                w[k] = wp.where(s[k] > 0.0, 1.0 / (s[k] * s[k] + FLOOR_RAD * FLOOR_RAD), 0.0)
                about = w[k] * k2
                total[k] += about
                start[k] = wp.where(about > sharpest[k], angle[k] / per_metre[f], start[k])
                wave[k] = wp.where(about > sharpest[k], 2.0 * wp.pi / per_metre[f], wave[k])
                sharpest[k] = wp.max(about, sharpest[k])
            weight[f, p] = w
        spread, d0, d1, d2 = float_pack(), float_pack(), float_pack(), float_pack()
        c0, c1, c2 = float_pack(), float_pack(), float_pack()
        for k in range(pack):
            spread[k] = 1.0 / wp.sqrt(wp.max(total[k], 1.0e-12))
            c0[k] = FAR
            c1[k] = FAR
            c2[k] = FAR
        for n in range(lowest, highest + 1):
            d, moved, cost = float_pack(), float_pack(), float_pack()
            for k in range(pack):
                d[k] = start[k] + float(n) * wave[k]
            for f in range(per_metre.shape[0]):
                angle = phase[f, p]
                w = weight[f, p]
                slope = per_metre[f]
                for k in range(pack):
                    turns = (angle[k] - slope * d[k]) * (0.5 / wp.pi)
                    away = (turns - wp.floor(turns + 0.5)) * (2.0 * wp.pi)  # radians from the hypothesis
                    moved[k] += w[k] * slope * away
                    cost[k] += w[k] * away * away
            for k in range(pack):
                step = moved[k] / wp.max(total[k], 1.0e-12)
                here = d[k] + step
                beyond = wp.max(wp.max(nearest - here, here - farthest) - 3.0 * spread[k], 0.0)
                c = cost[k] - moved[k] * step + 1.0e30 * beyond
                below0 = c < c0[k]
                below1 = c < c1[k]
                below2 = c < c2[k]
                d2[k] = wp.where(below1, d1[k], wp.where(below2, here, d2[k]))
                c2[k] = wp.where(below1, c1[k], wp.where(below2, c, c2[k]))
                d1[k] = wp.where(below0, d0[k], wp.where(below1, here, d1[k]))
                c1[k] = wp.where(below0, c0[k], wp.where(below1, c, c1[k]))
                d0[k] = wp.where(below0, here, d0[k])
                c0[k] = wp.where(below0, c, c0[k])
        p0, p1, p2, kept = float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            one = wp.where(c0[k] < FAR and total[k] > 0.0, 1.0, 0.0)
            two = one * wp.where(c1[k] < FAR, wp.exp(-0.5 * wp.min(c1[k] - c0[k], 200.0)), 0.0)
            three = one * wp.where(c2[k] < FAR, wp.exp(-0.5 * wp.min(c2[k] - c0[k], 200.0)), 0.0)
            share = 1.0 / wp.max(one + two + three, 1.0)
            p0[k] = one * share
            p1[k] = two * share
            p2[k] = three * share
            d0[k] *= one
            d1[k] = wp.where(two > 0.0, d1[k], 0.0)
            d2[k] = wp.where(three > 0.0, d2[k], 0.0)
            kept[k] = one * spread[k]
        ranges[0, p] = d0
        ranges[1, p] = d1
        ranges[2, p] = d2
        probability[0, p] = p0
        probability[1, p] = p1
        probability[2, p] = p2
        range_sigma[p] = kept

    return hypotheses_kernel


@wp.func
def nearness(distance: float, inverse: float):
    """Of two ranges on one surface: 1 at none, 0 from a radius on (biweight)."""
    u = distance * inverse
    v = wp.max(1.0 - u * u, 0.0)
    return v * v


@wp.kernel(module="unique")
def _vote_kernel(first: int,
                 ranges: wp.array2d(dtype=wp.float32),  # [3, pixel]
                 before: wp.array2d(dtype=wp.float32),  # [3, pixel]
                 rows: int,
                 cols: int,
                 inverse: float,  # 1/m: of the radius within which ranges are one surface
                 # outputs
                 after: wp.array2d(dtype=wp.float32)):  # [3, pixel]
    p = first + wp.tid()
    if before[0, p] >= CERTAIN:
        after[0, p] = before[0, p]
        after[1, p] = before[1, p]
        after[2, p] = before[2, p]
    elif before[0, p] + before[1, p] + before[2, p] > 0.0:
        r = p // cols
        c = p - r * cols
        d0 = ranges[0, p]
        d1 = ranges[1, p]
        d2 = ranges[2, p]
        s0 = float(0.0)
        s1 = float(0.0)
        s2 = float(0.0)
        voters = float(0.0)
        for i in range(wp.max(r - VOTE_RADIUS, 0), wp.min(r + VOTE_RADIUS + 1, rows)):
            for j in range(wp.max(c - VOTE_RADIUS, 0), wp.min(c + VOTE_RADIUS + 1, cols)):
                q = i * cols + j
                if q != p:
                    for k in range(HYPOTHESES):
                        w = before[k, q]
                        if w > 1.0e-3:
                            d = ranges[k, q]
                            voters += w
                            s0 += w * nearness(d - d0, inverse)
                            s1 += w * nearness(d - d1, inverse)
                            s2 += w * nearness(d - d2, inverse)
        prior = STRANGER * wp.max(voters, 1.0)
        a0 = before[0, p] * (prior + s0)
        a1 = before[1, p] * (prior + s1)
        a2 = before[2, p] * (prior + s2)
        share = 1.0 / (a0 + a1 + a2)
        after[0, p] = a0 * share
        after[1, p] = a1 * share
        after[2, p] = a2 * share


@wp.kernel(module="unique")
def _decide_kernel(first: int,
                   phase: wp.array2d(dtype=wp.float32),  # [F, pixel]
                   sigma: wp.array2d(dtype=wp.float32),  # [F, pixel]
                   evidence: wp.array2d(dtype=wp.float32),  # [F, pixel]
                   per_metre: wp.array(dtype=wp.float32),  # [F]
                   agree: wp.array(dtype=wp.float32),  # [F] largest cost, by frequencies used less one
                   signal: wp.array(dtype=wp.float32),  # [F + 1] least evidence, by frequencies used
                   ranges: wp.array2d(dtype=wp.float32),  # [3, pixel]
                   probability: wp.array2d(dtype=wp.float32),  # [3, pixel]
                   hypothesis_sigma: wp.array(dtype=wp.float32),
                   nearest: float,
                   farthest: float,
                   agreement: float,  # radians²
                   # outputs
                   chosen: wp.array(dtype=wp.float32),
                   range_sigma: wp.array(dtype=wp.float32),
                   confidence: wp.array(dtype=wp.float32),
                   wraps: wp.array(dtype=wp.int32),
                   status: wp.array(dtype=wp.int32)):
    p = first + wp.tid()
    used = wp.int32(0)
    sure = float(0.0)
    blind = wp.int32(0)
    for f in range(per_metre.shape[0]):
        if sigma[f, p] > 0.0:
            used += 1
            sure += evidence[f, p]
        elif sigma[f, p] < 0.0:
            blind += 1
    best = wp.int32(0)
    if probability[1, p] > probability[0, p]:
        best = 1
    if probability[2, p] > wp.max(probability[0, p], probability[1, p]):
        best = 2
    if used == 0:
        status[p] = wp.where(blind > 0, _SATURATED, _LOW)
    elif sure < signal[used]:
        status[p] = _LOW
    elif probability[best, p] == 0.0:
        status[p] = _OUT
    else:
        d = ranges[best, p]
        cost = float(0.0)
        for f in range(per_metre.shape[0]):
            s = sigma[f, p]
            if s > 0.0:
                turns = (phase[f, p] - per_metre[f] * d) / (2.0 * wp.pi)
                away = (turns - wp.round(turns)) * (2.0 * wp.pi)
                cost += away * away / (s * s + agreement)
        code = int(_OK)
        if probability[best, p] < DECIDED:
            code = int(_UNDECIDED)
        if cost > agree[used - 1]:
            code = int(_MULTIPATH)
        chosen[p] = d
        range_sigma[p] = hypothesis_sigma[p]
        confidence[p] = probability[best, p]
        wraps[p] = int(wp.floor(d * per_metre[per_metre.shape[0] - 1] / (2.0 * wp.pi)))
        status[p] = code
