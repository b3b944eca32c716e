"""Phase errors that nobody declared, estimated from what the frequencies disagree by beyond their noise.

Where noise alone bends the phases, the misfit Σ (phase error / σ)² of F frequencies is distributed as chi-squared with F - 1 degrees of
freedom. A misfit beyond that, of the pixel or of the pixels around it together, tells of wiggling that is not calibrated, of a second
return, or of light that came by way of other surfaces. If each phase has a further variance τ², the misfit grows on average by τ²·D with
D = Σ w - Σ w²k² / Σ wk², w = 1/σ² and k radians a metre: that gives τ². Phases whose variance is larger by it are then unwrapped again.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.status import Status
from kernels.tof.continuous.continuous import Correlation
from kernels.tof.continuous.decide import MULTIPATH_Z, Ranges
from kernels.tof.continuous.modulation import radians_per_metre
from kernels.tof.continuous.unwrap import FLOOR_RAD

RADIUS = 2
"""Half-width of the window in pixels: with two frequencies it has 25 degrees of freedom, and shows a τ of seven tenths of σ."""
WINDOW_Z = 2.0
"""Standard normal quantile of the window's test: one window in forty without a further error passes it, and raises σ by a fifth."""

_OK, _MULTIPATH = int(Status.OK), int(Status.MULTIPATH)


class Disagreement(NamedTuple):
    """Phases with the standard deviations that their disagreement shows."""

    found: Correlation
    further: wp.array  # [pixel] float32: τ², radians²; 0 where noise explains the misfit


def widen(found: Correlation, ranges: Ranges, rows: int, cols: int, *, light_speed: float) -> Disagreement:
    """Add the variance that frequencies disagree by to that of the phases; those of a single frequency stay the same.

    Args:
        found: phases; rows · cols pixels and padding.
        ranges: what `decide` took from them: of pixels that are OK or MULTIPATH the misfit is known.
        light_speed: metres a second.

    Source:
        DerSimonian and Laird, "Meta-analysis in clinical trials", Controlled Clinical Trials 7, 1986: the moment estimate of τ², here of a
        line through the origin in place of a mean.
    """
    device, (count, pixels) = str(found.phase.device), found.phase.shape
    if not 0 < rows * cols <= pixels:
        raise ArrayError(f"there are {pixels} pixels, the image is {rows} x {cols}: give the image's own size")
    per_metre = wp.array(radians_per_metre(found.modulation_hz, light_speed), dtype=wp.float32, device=device)
    misfit = wp.zeros((3, pixels), dtype=wp.float32, device=device)
    sigma, further = wp.clone(found.sigma), wp.zeros(pixels, dtype=wp.float32, device=device)
    if count > 1:
        devices.launch(_misfit_kernel, rows * cols, [found.phase, found.sigma, ranges.range, ranges.status, per_metre], [misfit],
                       device=device)
        devices.launch(_widen_kernel, rows * cols, [found.sigma, misfit, ranges.status, rows, cols], [sigma, further], device=device)
    return Disagreement(found._replace(sigma=sigma), further)


@wp.kernel(module="unique")
def _misfit_kernel(first: int,
                   phase: wp.array2d(dtype=wp.float32),  # [F, pixel]
                   sigma: wp.array2d(dtype=wp.float32),  # [F, pixel]
                   ranges: wp.array(dtype=wp.float32),  # [pixel] metres
                   status: wp.array(dtype=wp.int32),  # [pixel]
                   per_metre: wp.array(dtype=wp.float32),  # [F]
                   # outputs
                   misfit: wp.array2d(dtype=wp.float32)):  # [3, pixel]: χ², degrees of freedom, D
    p = first + wp.tid()
    if status[p] == _OK or status[p] == _MULTIPATH:
        cost = float(0.0)
        used = float(0.0)
        w1 = float(0.0)
        w2 = float(0.0)
        w3 = float(0.0)
        for f in range(per_metre.shape[0]):
            if sigma[f, p] > 0.0:
                k = per_metre[f]
                turns = (phase[f, p] - k * ranges[p]) * (0.5 / wp.pi)
                away = (turns - wp.rint(turns)) * 2.0 * wp.pi
                w = 1.0 / (sigma[f, p] * sigma[f, p] + FLOOR_RAD * FLOOR_RAD)
                used += 1.0
                cost += w * away * away
                w1 += w
                w2 += w * k * k
                w3 += w * w * k * k
        if used > 1.0:
            misfit[0, p] = cost
            misfit[1, p] = used - 1.0
            misfit[2, p] = w1 - w3 / w2


@wp.func
def further_variance(misfit: float, freedom: float, stiffness: float, z: float):
    """Return τ² if the misfit is beyond the quantile z of chi-squared (Wilson and Hilferty, PNAS 1931), else 0."""
    a = 2.0 / (9.0 * wp.max(freedom, 1.0))
    root = 1.0 - a + z * wp.sqrt(a)
    beyond = freedom > 0.0 and misfit > freedom * root * root * root
    return wp.where(beyond, (misfit - freedom) / wp.max(stiffness, 1.0e-12), 0.0)


@wp.kernel(module="unique")
def _widen_kernel(first: int,
                  before: wp.array2d(dtype=wp.float32),  # [F, pixel] radians
                  misfit: wp.array2d(dtype=wp.float32),  # [3, pixel]
                  status: wp.array(dtype=wp.int32),  # [pixel]
                  rows: int,
                  cols: int,
                  # outputs
                  sigma: wp.array2d(dtype=wp.float32),  # [F, pixel] radians
                  further: wp.array(dtype=wp.float32)):  # [pixel]
    p = first + wp.tid()
    if misfit[1, p] > 0.0:
        r = p // cols
        c = p - r * cols
        around = wp.vec3()
        for i in range(wp.max(r - RADIUS, 0), wp.min(r + RADIUS + 1, rows)):
            for j in range(wp.max(c - RADIUS, 0), wp.min(c + RADIUS + 1, cols)):
                q = i * cols + j
                if status[q] == _OK:
                    around += wp.vec3(misfit[0, q], misfit[1, q], misfit[2, q])
        own = further_variance(misfit[0, p], misfit[1, p], misfit[2, p], MULTIPATH_Z)
        variance = wp.max(own, further_variance(around[0], around[1], around[2], WINDOW_Z))
        further[p] = variance
        for f in range(before.shape[0]):
            if before[f, p] > 0.0:
                sigma[f, p] = wp.sqrt(before[f, p] * before[f, p] + variance)
