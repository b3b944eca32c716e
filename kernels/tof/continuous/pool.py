"""Pixels too dark to be decoded alone: their phasors are added to those of the dark pixels around them.

A phasor is amplitude · exp(i·phase). Over n pixels of one surface the phasors add up n-fold and their noise only √n-fold, so that the
sum of a window shows a signal that no pixel of it shows by itself. Pixels with a signal of their own take no part: light from a bright
object beside a dark one would outweigh it. A window without light adds up to noise, and its pixel stays without an estimate.

The range varies over a window, by τ: phases scatter about that of the sum by more than their noise. The sum says where the pixel is to
√(σ² + (kτ)²) at k radians a metre, and is combined with the pixel's own phase by their variances.
"""

from math import inf
from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.tof.continuous.continuous import Correlation, signal_limits
from kernels.tof.continuous.modulation import radians_per_metre

REACHES = (1, 2, 3)
"""Half-widths of the windows in pixels, tried one after the other: 9, 25 and 49 pixels, which show what is too dark by a factor of seven
for one pixel."""
LEAST_PART = 1 / 3
"""Least part of a window that must be dark: fewer pixels are the rim of something bright."""


class Pooled(NamedTuple):
    """Phases in which dark pixels are decoded with their neighbours."""

    found: Correlation
    reach: wp.array  # [pixel] int32: half-width of the window that was added up; 0 where the pixel was taken alone


def pool(found: Correlation, rows: int, cols: int, *, light_speed: float) -> Pooled:
    """Add the phasors of dark neighbours up where a pixel has no signal of its own.

    Pixels with a signal of their own, or with none in any window, are as they were. Amplitude is the mean of the window.
    `found`: phases of `decode`, corrected for wiggling; rows · cols pixels and padding. `light_speed`: metres a second."""
    device, pixels, count = str(found.phase.device), found.phase.shape[1], found.phase.shape[0]
    if not 0 < rows * cols <= pixels:
        raise ArrayError(f"there are {pixels} pixels, the image is {rows} x {cols}: give the image's own size")
    outputs = [wp.clone(array) for array in (found.phase, found.sigma, found.amplitude, found.evidence)]
    reach = wp.zeros(pixels, dtype=wp.int32, device=device)
    scratch = wp.empty((6, count, pixels), dtype=wp.float32, device=device)
    devices.launch(_pool_kernel, rows * cols, [
        found.phase, found.sigma, found.amplitude, found.evidence,
        wp.array([inf, *signal_limits(count)], dtype=wp.float32, device=device),
        wp.array(radians_per_metre(found.modulation_hz, light_speed), dtype=wp.float32, device=device),
        wp.array(REACHES, dtype=wp.int32, device=device), rows, cols, scratch], [*outputs, reach], device=device)
    phase, sigma, amplitude, evidence = outputs
    return Pooled(found._replace(phase=phase, sigma=sigma, amplitude=amplitude, evidence=evidence), reach)


@wp.func
def dark(sigma: wp.array2d(dtype=wp.float32), evidence: wp.array2d(dtype=wp.float32), signal: wp.array(dtype=wp.float32), p: int):
    """Return whether every frequency is usable and the pixel shows no signal by itself."""
    total = float(0.0)
    whole = bool(True)
    for f in range(sigma.shape[0]):
        total += evidence[f, p]
        if sigma[f, p] < 0.0:
            whole = False
    return whole and total < signal[sigma.shape[0]]


@wp.func
def add(phase: wp.array2d(dtype=wp.float32), amplitude: wp.array2d(dtype=wp.float32), evidence: wp.array2d(dtype=wp.float32), q: int,
        p: int, sums: wp.array3d(dtype=wp.float32)):
    """Add the phasors z of pixel q to the sums of pixel p, at each frequency: Re z, Im z, variance, |z|², Re z², Im z²."""
    for f in range(phase.shape[0]):
        strength = amplitude[f, q]
        x = strength * wp.cos(phase[f, q])
        y = strength * wp.sin(phase[f, q])
        sums[0, f, p] += x
        sums[1, f, p] += y
        sums[2, f, p] += strength * strength / wp.max(evidence[f, q], 1.0e-12)
        sums[3, f, p] += strength * strength
        sums[4, f, p] += x * x - y * y
        sums[5, f, p] += 2.0 * x * y


@wp.func
def length2(sums: wp.array3d(dtype=wp.float32), f: int, p: int):
    """Return the squared length of the summed phasor."""
    return sums[0, f, p] * sums[0, f, p] + sums[1, f, p] * sums[1, f, p]


@wp.func
def range_variance(sums: wp.array3d(dtype=wp.float32), per_metre: wp.array(dtype=wp.float32), members: float, p: int):
    """Return the variance of the range over the window, metres²: what phasors scatter across the summed one beyond their noise."""
    excess = float(0.0)
    scale = float(0.0)
    for f in range(per_metre.shape[0]):
        q2 = wp.max(length2(sums, f, p), 1.0e-30)
        turned = (sums[4, f, p] * (sums[0, f, p] * sums[0, f, p] - sums[1, f, p] * sums[1, f, p])
                  + sums[5, f, p] * 2.0 * sums[0, f, p] * sums[1, f, p]) / q2  # Re of Σz² turned by twice the phase of the sum
        excess += 0.5 * (sums[3, f, p] - turned) - sums[2, f, p]
        scale += q2 / members * per_metre[f] * per_metre[f]
    return wp.max(excess / scale, 0.0)


@wp.kernel(module="unique")
def _pool_kernel(first: int,
                 phase: wp.array2d(dtype=wp.float32),  # [F, pixel]
                 sigma: wp.array2d(dtype=wp.float32),
                 amplitude: wp.array2d(dtype=wp.float32),
                 evidence: wp.array2d(dtype=wp.float32),
                 signal: wp.array(dtype=wp.float32),  # [F + 1] least evidence of a signal, by frequencies used
                 per_metre: wp.array(dtype=wp.float32),  # [F]
                 reaches: wp.array(dtype=wp.int32),
                 rows: int,
                 cols: int,
                 sums: wp.array3d(dtype=wp.float32),  # [6, F, pixel] scratch: see _add
                 # outputs
                 pooled_phase: wp.array2d(dtype=wp.float32),
                 pooled_sigma: wp.array2d(dtype=wp.float32),
                 pooled_amplitude: wp.array2d(dtype=wp.float32),
                 pooled_evidence: wp.array2d(dtype=wp.float32),
                 reach: wp.array(dtype=wp.int32)):  # [pixel]
    p = first + wp.tid()
    count = phase.shape[0]
    if dark(sigma, evidence, signal, p):
        r = p // cols
        c = p - r * cols
        for n in range(reaches.shape[0]):
            if reach[p] == 0:
                radius = reaches[n]
                for f in range(count):
                    for k in range(6):
                        sums[k, f, p] = 0.0
                members = float(0.0)
                for i in range(wp.max(r - radius, 0), wp.min(r + radius + 1, rows)):
                    for j in range(wp.max(c - radius, 0), wp.min(c + radius + 1, cols)):
                        q = i * cols + j
                        if dark(sigma, evidence, signal, q):
                            members += 1.0
                            add(phase, amplitude, evidence, q, p, sums)
                side = float(2 * radius + 1)
                total = float(0.0)
                for f in range(count):
                    total += length2(sums, f, p) / wp.max(sums[2, f, p], 1.0e-30)
                if members >= LEAST_PART * side * side and total >= signal[count]:
                    reach[p] = radius
                    spread2 = range_variance(sums, per_metre, members, p)
                    for f in range(count):
                        q2 = wp.max(length2(sums, f, p), 1.0e-30)
                        own = wp.max(evidence[f, p] - 2.0, 0.0)  # 1 / variance of its own phase; noise alone has an evidence of 2
                        window = 1.0 / (sums[2, f, p] / q2 + per_metre[f] * per_metre[f] * spread2)
                        scale = window / wp.sqrt(q2)
                        x = own * wp.cos(phase[f, p]) + scale * sums[0, f, p]
                        y = own * wp.sin(phase[f, p]) + scale * sums[1, f, p]
                        angle = wp.atan2(y, x)
                        pooled_phase[f, p] = wp.where(angle < 0.0, angle + 2.0 * wp.pi, angle)
                        pooled_sigma[f, p] = 1.0 / wp.sqrt(own + window)
                        pooled_amplitude[f, p] = wp.sqrt(q2) / members
                        pooled_evidence[f, p] = q2 / wp.max(sums[2, f, p], 1.0e-30)
