"""The most probable wrap of each pixel, and why where it is not good enough."""

from typing import Any, NamedTuple

import warp as wp

from kernels import device as devices
from kernels.status import Status
from kernels.tof.continuous import Correlation
from kernels.tof.modulation import radians_per_metre
from kernels.tof.unwrap import Hypotheses, floats

AGREEMENT_RAD = 0.01
"""Systematic error of a phase that is no sign of multipath: what calibration leaves."""
UNCALIBRATED_RAD = 0.04
"""The same of a camera whose wiggling is not known: a third harmonic of 8 % bends phases by up to 0.1 rad."""
MULTIPATH_Z = 3.72
"""Standard normal quantile: one pixel in ten thousand with a single return is called multipath."""
SIGNAL_Z = 4.75
"""One pixel in a million without signal is taken to have one."""
DECIDED = 2 / 3
"""Probability that the chosen wrap must have."""

_OK, _UNDECIDED, _MULTIPATH = int(Status.OK), int(Status.UNDECIDED), int(Status.MULTIPATH)
_LOW, _SATURATED, _OUT = int(Status.LOW_MODULATION), int(Status.SATURATED), int(Status.OUT_OF_RANGE)

wp.set_module_options({"enable_backward": False})


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


def decide(found: Correlation, weighed: Hypotheses, *, agreement_rad: float = AGREEMENT_RAD) -> Ranges:
    """Take the most probable hypothesis of each pixel and say why where it is not good enough.

    Args:
        found, weighed: phases and hypotheses of the same pixels.
        agreement_rad: systematic error of a phase up to which frequencies count as agreeing.

    Returns:
        Ranges, on the device. OUT_OF_RANGE: nothing in the span of `unwrap` fits; LOW_MODULATION: no more amplitude than noise has; SATURATED: no frequency is left; MULTIPATH: frequencies
        disagree by more than noise and `agreement_rad` explain; UNDECIDED: the wrap is less probable than DECIDED.
    """
    device, pixels = weighed.range.device, weighed.range.shape[1]
    count = len(found.modulation_hz)
    agree = [float("inf"), *(quantile(freedom, MULTIPATH_Z) for freedom in range(1, count))]
    signal = [float("inf"), *(quantile(2 * used, SIGNAL_Z) for used in range(1, count + 1))]
    result = Ranges(*(wp.zeros(pixels, dtype=dtype, device=device) for dtype in (wp.float32, wp.float32, wp.float32, wp.int32, wp.int32)))
    devices.launch(_decide_kernel, pixels, [
        found.phase, found.sigma, found.evidence, floats(radians_per_metre(found.modulation_hz), device), floats(agree, device),
        floats(signal, device), weighed.range, weighed.probability, weighed.sigma,
        float(agreement_rad) ** 2,
    ], list(result), device=str(device))
    return result


def decide_kernel(pack: int) -> Any:
    """For tests that compile it; single pixels whatever the pack."""
    return _decide_kernel


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
