"""Phases of several frequencies → range: maximum likelihood over the wraps.

Every range d that explains the phase of the most precise frequency is a hypothesis; each is moved to the weighted least-squares range of
all frequencies, and its cost is the sum of squared phase errors over their variances: -2 log likelihood. The best HYPOTHESES of a pixel
stay with their probabilities, so that neighbours can decide between them.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.tof.continuous.continuous import Correlation
from kernels.tof.continuous.modulation import radians_per_metre, require_span

HYPOTHESES = 3
"""Number of hypotheses kept for a pixel: a fourth has had no influence on the result in the simulated scenes."""
FLOOR_RAD = 3e-4
"""Least standard deviation of a phase, in radians, however bright the pixel is: 0.1 mm at 80 MHz."""
NO_HYPOTHESIS_COST = 1e20
"""Sentinel cost of a slot that holds no hypothesis."""
END_SIGMAS = 3.0
"""Standard deviations by which a hypothesis may lie beyond either end of the span."""
TURN = 2 * np.pi
"""One turn in radians."""


class Hypotheses(NamedTuple):
    """The best wraps of each pixel, on the device; pixels are padded to whole packs."""

    range: wp.array  # [HYPOTHESES, pixel] float32 metres; 0 where there are fewer
    probability: wp.array  # [HYPOTHESES, pixel] float32, adds up to 1 where there is any
    sigma: wp.array  # [pixel] float32 metres: standard deviation of the range, given that the wrap is right
    spacing_m: float  # between wraps of the highest frequency


def unwrap(found: Correlation, *, nearest_m: float, farthest_m: float, light_speed: float) -> Hypotheses:
    """Weigh every wrap of every pixel.

    Args:
        found: phases with their standard deviations.
        nearest_m, farthest_m: the span to look in; END_SIGMAS standard deviations beyond either end are looked at too.
        light_speed: metres a second.

    Raises:
        ArrayError: the frequencies cannot tell the whole span apart; the message says what they can.

    Source:
        Droeschel, Holz, Behnke, "Multi-frequency phase unwrapping for time-of-flight cameras", IROS 2010; weights from photon noise
        and hypotheses as Järemo Lawin, Forssén, Ovrén, "Efficient multi-frequency phase unwrapping using kernel density estimation",
        ECCV 2016.
    """
    require_span(found.modulation_hz, nearest_m, farthest_m, light_speed)
    device, pixels = str(found.phase.device), found.phase.shape[1]
    pack = devices.pack_width(device)
    per_metre = radians_per_metre(found.modulation_hz, light_speed)
    wave = 2 * np.pi / per_metre[-1]
    shapes = (HYPOTHESES, pixels), (HYPOTHESES, pixels), (pixels,), (len(per_metre), pixels)
    ranges, probability, sigma, scratch = (wp.empty(shape, dtype=wp.float32, device=device) for shape in shapes)  # the kernel writes all
    devices.launch(unwrap_kernel(pack), pixels // pack, [
        as_packs(found.phase, device), as_packs(found.sigma, device), wp.array(per_metre, dtype=wp.float32, device=device),
        int(np.floor(nearest_m / wave)) - 1, int(np.ceil(farthest_m / wave)), float(nearest_m), float(farthest_m),
        as_packs(scratch, device)], [as_packs(array, device) for array in (ranges, probability, sigma)], device=device)
    return Hypotheses(ranges, probability, sigma, float(wave))


@wp.func
def decay(x: float):
    """Return exp(-x) for 0…80, to 3e-7 of it, and exp(-80) beyond, without branches, so that a pack becomes SIMD instructions."""
    near = wp.min(x, 80.0)
    halvings = wp.rint(near * 1.44269504)
    y = (halvings * 0.693359375 - near) - halvings * 2.12194440e-4  # ln 2 in two parts, the first product exact; -½ ln 2 … ½ ln 2
    power = float(1.0 / 720.0)
    power = power * y + 1.0 / 120.0
    power = power * y + 1.0 / 24.0
    power = power * y + 1.0 / 6.0
    power = power * y + 0.5
    power = power * y + 1.0
    power = power * y + 1.0
    return power * wp.cast((127 - int(halvings)) << 23, float)  # the exponent of a float32


@once
def unwrap_kernel(pack: int) -> Any:
    """Return the kernel for packs of this many pixels."""
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
                wave[k] = wp.where(about > sharpest[k], TURN / per_metre[f], wave[k])
                sharpest[k] = wp.max(about, sharpest[k])
            weight[f, p] = w
        spread, variance, d0, d1, d2 = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        c0, c1, c2, low, high = float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            variance[k] = 1.0 / wp.max(total[k], 1.0e-12)
            spread[k] = wp.sqrt(variance[k])
            low[k] = nearest - END_SIGMAS * spread[k]
            high[k] = farthest + END_SIGMAS * spread[k]
            c0[k] = NO_HYPOTHESIS_COST
            c1[k] = NO_HYPOTHESIS_COST
            c2[k] = NO_HYPOTHESIS_COST
        for n in range(lowest, highest + 1):
            d, moved, cost = float_pack(), float_pack(), float_pack()
            for k in range(pack):
                d[k] = start[k] + float(n) * wave[k]
            for f in range(per_metre.shape[0]):
                angle = phase[f, p]
                w = weight[f, p]
                slope = per_metre[f]
                for k in range(pack):
                    turns = (angle[k] - slope * d[k]) * (1.0 / TURN)
                    away = turns - wp.rint(turns)  # turns from the hypothesis
                    pull = w[k] * away
                    moved[k] += slope * pull
                    cost[k] += pull * away
            for k in range(pack):
                step = TURN * moved[k] * variance[k]
                here = d[k] + step
                c = TURN * (TURN * cost[k] - moved[k] * step)
                c = wp.where(here < low[k], NO_HYPOTHESIS_COST, wp.where(here > high[k], NO_HYPOTHESIS_COST, c))
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
            one = wp.where(c0[k] < NO_HYPOTHESIS_COST, wp.where(total[k] > 0.0, 1.0, 0.0), 0.0)
            two = one * wp.where(c1[k] < NO_HYPOTHESIS_COST, decay(0.5 * (c1[k] - c0[k])), 0.0)
            three = one * wp.where(c2[k] < NO_HYPOTHESIS_COST, decay(0.5 * (c2[k] - c0[k])), 0.0)
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


VOTE_RADIUS = 2
"""Half-width of the voting window, pixels: it holds 24 neighbours."""
VOTE_ROUNDS = 2
"""Number of votes: in the second, neighbours vote with the probabilities that the first gave them."""
SAME_SURFACE = 0.3
"""Largest difference of two ranges on the same surface, as a part of the wrap distance."""
CERTAIN = 1 - 1e-5
"""Probability of the best hypothesis from which a pixel keeps it without a vote: two rounds multiply the odds of another wrap by at most 1
/ UNSEEN_SURFACE²."""
UNSEEN_SURFACE = 0.02
"""Prior weight of a surface that none of the pixel's neighbours is on: it limits how far they can outvote the pixel's own measurement."""


def vote(weighed: Hypotheses, rows: int, cols: int) -> Hypotheses:
    """Let neighbours decide between the hypotheses of each pixel; ranges stay what they are, probabilities move.

    The probability of a hypothesis is multiplied by the density that the neighbours' hypotheses, weighed by their probabilities, have at
    its range, plus a little for a pixel that is on none of their surfaces. Nothing is smoothed.

    Source:
        Järemo Lawin, Forssén, Ovrén, "Efficient multi-frequency phase unwrapping using kernel density estimation", ECCV 2016; here
        as a factor on the pixel's own measurement.
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


@wp.func
def nearness(distance: float, inverse: float):
    """Return how near two ranges are: 1 where they are equal, 0 from a radius on (biweight)."""
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
        for n in range(HYPOTHESES):
            after[n, p] = before[n, p]
    elif before[0, p] + before[1, p] + before[2, p] > 0.0:
        r = p // cols
        c = p - r * cols
        support = wp.vec3()
        voters = float(0.0)
        for i in range(wp.max(r - VOTE_RADIUS, 0), wp.min(r + VOTE_RADIUS + 1, rows)):
            for j in range(wp.max(c - VOTE_RADIUS, 0), wp.min(c + VOTE_RADIUS + 1, cols)):
                q = i * cols + j
                if q != p:
                    for k in range(HYPOTHESES):
                        w = before[k, q]
                        if w > 1.0e-3:
                            voters += w
                            for n in range(HYPOTHESES):
                                support[n] += w * nearness(ranges[k, q] - ranges[n, p], inverse)
        prior = UNSEEN_SURFACE * wp.max(voters, 1.0)
        odds = wp.vec3()
        for n in range(HYPOTHESES):
            odds[n] = before[n, p] * (prior + support[n])
        share = 1.0 / (odds[0] + odds[1] + odds[2])
        for n in range(HYPOTHESES):
            after[n, p] = odds[n] * share
