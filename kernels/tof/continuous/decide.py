"""The most probable wrap of each pixel, and a status that tells why there is none, or why it cannot be trusted."""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.packs import as_packs, pack_type
from kernels.status import Status
from kernels.tof.continuous.continuous import Correlation, quantile, signal_limits
from kernels.tof.continuous.modulation import radians_per_metre
from kernels.tof.continuous.unwrap import Hypotheses

AGREEMENT_RAD = 0.01
"""Systematic phase error, in radians, that remains after calibration: frequencies that disagree by no more are no sign of multipath."""
UNCALIBRATED_RAD = 0.04
"""Systematic phase error, in radians, of a camera whose wiggling is not calibrated: a third harmonic of 8 % bends phases by up to 0.1
rad."""
MULTIPATH_Z = 3.72
"""Standard normal quantile of the multipath test: one pixel in ten thousand with a single return is called multipath."""
DECIDED = 2 / 3
"""Least probability of a wrap that counts as solved, unless another one is asked for."""

_OK, _MULTIPATH = int(Status.OK), int(Status.MULTIPATH)
_LOW, _SATURATED, _OUT = int(Status.LOW_MODULATION), int(Status.SATURATED), int(Status.OUT_OF_RANGE)


class Ranges(NamedTuple):
    """Range of each pixel, on the device; pixels are padded to whole packs."""

    range: wp.array  # [pixel] float32 metres along the ray; kept for MULTIPATH too, else 0
    sigma: wp.array  # [pixel] float32 metres
    confidence: wp.array  # [pixel] float32: probability of the wrap
    wraps: wp.array  # [pixel] int32: whole turns of the highest frequency in the range
    status: wp.array  # [pixel] int32, kernels.status.Status


def decide(found: Correlation, weighed: Hypotheses, *, light_speed: float, agreement_rad: float = AGREEMENT_RAD) -> Ranges:
    """Take the most probable hypothesis of each pixel and say why where it is not good enough.

    LOW_MODULATION: no more amplitude than noise has; SATURATED: no frequency is left; OUT_OF_RANGE: nothing in the span of `unwrap` fits;
    MULTIPATH: frequencies disagree by more than noise and `agreement_rad` explain.
    `light_speed`: metres a second. `agreement_rad`: systematic error of a phase up to which frequencies count as agreeing."""
    device, pixels = str(weighed.range.device), weighed.range.shape[1]
    pack, count = devices.pack_width(device), len(found.modulation_hz)
    agree = [float("inf"), *(quantile(freedom, MULTIPATH_Z) for freedom in range(1, count))]
    signal = [float("inf"), *signal_limits(count)]
    result = Ranges(*(wp.empty(pixels, dtype=dtype, device=device)  # the kernel writes every pixel
                      for dtype in (wp.float32, wp.float32, wp.float32, wp.int32, wp.int32)))
    devices.launch(decide_kernel(pack), pixels // pack, [
        *(as_packs(array, device) for array in (found.phase, found.sigma, found.evidence)),
        *(wp.array(values, dtype=wp.float32, device=device)
          for values in (radians_per_metre(found.modulation_hz, light_speed), agree, signal)),
        *(as_packs(array, device) for array in (weighed.range, weighed.probability, weighed.sigma)), float(agreement_rad) ** 2,
    ], [as_packs(array, device) for array in result], device=device)
    return result


@once
def decide_kernel(pack: int) -> Any:
    """Return the kernel for packs of this many pixels."""
    float_pack, int_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32)

    @wp.kernel(enable_backward=False, module="unique")
    def choice_kernel(first: int,
                      phase: wp.array2d(dtype=float_pack),  # [F, P]
                      sigma: wp.array2d(dtype=float_pack),  # [F, P]
                      evidence: wp.array2d(dtype=float_pack),  # [F, P]
                      per_metre: wp.array(dtype=wp.float32),  # [F]
                      agree: wp.array(dtype=wp.float32),  # [F] largest cost, by frequencies used less one
                      signal: wp.array(dtype=wp.float32),  # [F + 1] least evidence, by frequencies used
                      ranges: wp.array2d(dtype=float_pack),  # [3, P]
                      probability: wp.array2d(dtype=float_pack),  # [3, P]
                      hypothesis_sigma: wp.array(dtype=float_pack),  # [P]
                      agreement: float,  # radians²
                      # outputs
                      chosen: wp.array(dtype=float_pack),  # [P]
                      range_sigma: wp.array(dtype=float_pack),
                      confidence: wp.array(dtype=float_pack),
                      wraps: wp.array(dtype=int_pack),
                      status: wp.array(dtype=int_pack)):
        p = first + wp.tid()
        d, best = float_pack(), float_pack()
        for n in range(probability.shape[0]):
            likely = probability[n, p]
            there = ranges[n, p]
            for k in range(pack):
                d[k] = wp.where(likely[k] > best[k], there[k], d[k])
                best[k] = wp.where(likely[k] > best[k], likely[k], best[k])
        used, blind, sure, cost = float_pack(), float_pack(), float_pack(), float_pack()
        for f in range(per_metre.shape[0]):
            s = sigma[f, p]
            angle = phase[f, p]
            e = evidence[f, p]
            slope = per_metre[f]
            for k in range(pack):
                usable = wp.where(s[k] > 0.0, 1.0, 0.0)
                turns = (angle[k] - slope * d[k]) * (0.5 / wp.pi)
                away = (turns - wp.floor(turns + 0.5)) * (2.0 * wp.pi)
                used[k] += usable
                blind[k] += wp.where(s[k] < 0.0, 1.0, 0.0)
                sure[k] += usable * e[k]
                cost[k] += usable * away * away / (s[k] * s[k] + agreement)
        spread = hypothesis_sigma[p]
        codes, turned = int_pack(), int_pack()
        last = per_metre[per_metre.shape[0] - 1] * (0.5 / wp.pi)
        least, most = float_pack(), float_pack()
        for n in range(signal.shape[0]):  # limits by frequencies used: no table that each pixel looks up
            low, high = signal[n], agree[wp.max(n - 1, 0)]
            for k in range(pack):
                least[k] = wp.where(used[k] == float(n), low, least[k])
                most[k] = wp.where(used[k] == float(n), high, most[k])
        for k in range(pack):
            code = wp.where(cost[k] > most[k], _MULTIPATH, _OK)
            code = wp.where(best[k] == 0.0, _OUT, code)
            code = wp.where(sure[k] < least[k], _LOW, code)
            codes[k] = wp.where(used[k] == 0.0, wp.where(blind[k] > 0.0, _SATURATED, _LOW), code)
            kept = wp.where(codes[k] == _OK or codes[k] == _MULTIPATH, 1.0, 0.0)
            d[k] *= kept
            spread[k] *= kept
            best[k] *= kept
            turned[k] = int(wp.floor(d[k] * last))
        chosen[p] = d
        range_sigma[p] = spread
        confidence[p] = best
        wraps[p] = turned
        status[p] = codes

    return choice_kernel
