"""Correlation images → phase, amplitude and offset at each modulation frequency, by least squares.

A reading is I(δ) = P + Q·cos(φ - δ) = P + a·cos δ + b·sin δ with a = Q cos φ and b = Q sin φ: linear in (P, a, b), so that any three or
more different reference phases δ give all three, and ambient light, which is the same at every δ, stays in P.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type, place, unwritten
from kernels.tof.continuous.modulation import require_frequencies

LEAST_PHASES = 3
"""Least number of different reference phases of a frequency: the fit has three unknowns."""
WORST_CONDITION = 100.0
"""Largest ratio of the largest to the smallest singular value of the least-squares matrix: beyond it the phases lie too close together."""
ROUNDING = 2e-7
"""Relative rounding of a reading kept in float32: it is the least noise of an image."""


class Noise(NamedTuple):
    """Variance of a reading: read² + shot · reading, at least that of one electron; all in the unit of the images."""

    shot: float
    """Variance of a reading of one unit: one over the electrons that a unit stands for."""
    read: float
    """Standard deviation of a reading without light."""


class Correlation(NamedTuple):
    """Phase, amplitude and offset at each frequency, ascending; [frequency, pixel] on the device, pixels padded to whole packs."""

    phase: wp.array  # float32, 0…2π
    sigma: wp.array  # float32 radians: standard deviation of the phase; 0 where nothing was modulated, -1 where a reading saturates
    amplitude: wp.array  # float32, unit of the images
    offset: wp.array  # float32, unit of the images: ambient and the constant part of the signal
    evidence: wp.array  # float32: (amplitude / its standard deviation)²
    residual: wp.array  # float32: sum of squared residuals, unit of the images squared; 0 with three phases
    modulation_hz: np.ndarray  # [frequency] float64
    freedom: np.ndarray  # [frequency] int: images beyond three


def weights(modulation_hz: Sequence[float] | np.ndarray, reference_phase_rad: Sequence[float] | np.ndarray,
            scale: Sequence[float] | np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows that turn images into (P, a, b), and the frequency of each image.

    Args:
        modulation_hz: [M] of each image.
        reference_phase_rad: [M] δ of each image.
        scale: [M] factor that each reading is to be multiplied by (unequal exposures), above zero; None: 1.

    Returns:
        rows [M, 3] float64, columns P, a, b; frequencies [F] ascending; index [M] of the frequency of each image.

    Raises:
        ArrayError: lengths differ, a frequency is not above zero, or one has fewer than three different phases.
    """
    hz, delta = np.asarray(modulation_hz, dtype=np.float64), np.asarray(reference_phase_rad, dtype=np.float64)
    factor = np.ones_like(hz) if scale is None else np.asarray(scale, dtype=np.float64)
    if not hz.shape == delta.shape == factor.shape or hz.ndim != 1:
        raise ArrayError(f"there are {hz.size} frequencies, {delta.size} reference phases and {factor.size} scales: give one an image")
    require_frequencies(hz)
    if not np.all(np.isfinite(delta)) or not np.all(np.isfinite(factor) & (factor > 0)):
        raise ArrayError("reference phases must be finite, and scales above zero")
    frequencies, index = np.unique(hz, return_inverse=True)
    rows = np.zeros((hz.size, 3))
    for f, frequency in enumerate(frequencies):
        mine = index == f
        turned = np.exp(1j * delta[mine])
        different = len(np.unique(np.round(turned, 6)))
        if different < LEAST_PHASES:
            raise ArrayError(f"{frequency / 1e6:g} MHz has {different} different reference phase{'' if different == 1 else 's'}: "
                             f"phase, amplitude and offset need {LEAST_PHASES}")
        matrix = np.stack([np.ones_like(delta[mine]), turned.real, turned.imag], axis=1)
        if np.linalg.cond(matrix) > WORST_CONDITION:
            raise ArrayError(f"{frequency / 1e6:g} MHz has reference phases that lie too close together: spread them over the turn")
        rows[mine] = np.linalg.pinv(matrix).T * factor[mine, None]
    return rows, frequencies, index


def decode(images: np.ndarray, modulation_hz: Sequence[float] | np.ndarray, reference_phase_rad: Sequence[float] | np.ndarray, *,
           noise: Noise, saturation: float | None = None, scale: Sequence[float] | np.ndarray | None = None,
           device: str) -> Correlation:
    """Fit phase, amplitude and offset of each frequency by least squares, with the noise that they inherit; not synchronised on CUDA.

    Args:
        images: [M, pixel] float32 readings, in any order; those that are not finite count as saturated ones.
        modulation_hz, reference_phase_rad, scale: [M] as `weights` takes them.
        saturation: readings at or above it are none; the frequency is then not usable at that pixel. None: none saturates.

    Source:
        Lange, "3D time-of-flight distance measurement with custom solid-state image sensors in CMOS/CCD-technology", Siegen 2000
        (four phases); here for any phases. The variance is propagated: Var(x) = Σ row² · Var(I).
    """
    if images.ndim != 2 or images.dtype != np.float32:
        raise ArrayError(f"images are {images.ndim}-dimensional {images.dtype}: give [image, pixel] float32")
    rows, frequencies, index = weights(modulation_hz, reference_phase_rad, scale)
    if len(rows) != len(images):
        raise ArrayError(f"there are {len(images)} images and {len(rows)} reference phases: give one an image")
    order = np.argsort(index, kind="stable")
    counts = np.bincount(index, minlength=len(frequencies))
    delta = np.asarray(reference_phase_rad, dtype=np.float64)[order]
    factor = np.ones(len(rows)) if scale is None else np.asarray(scale, dtype=np.float64)[order]
    basis = np.stack([rows[order, 0], rows[order, 1], rows[order, 2], np.cos(delta), np.sin(delta), factor], axis=1)
    readings, _owner = place(images, device)  # the owner keeps the memory
    outputs = [unwritten(images.shape[1], wp.float32, device, rows=len(frequencies)) for _ in range(6)]
    devices.launch(decode_kernel(devices.pack_width(device)), len(frequencies) * readings.shape[1], [
        readings, wp.array(order, dtype=wp.int32, device=device),
        wp.array(np.concatenate([[0], np.cumsum(counts)]), dtype=wp.int32, device=device), wp.array(basis, dtype=wp.float32, device=device),
        float(noise.shot), float(noise.read) ** 2, float("inf") if saturation is None else float(saturation),
    ], [as_packs(array, device) for array in outputs], device=device)
    return Correlation(*outputs, frequencies, counts - LEAST_PHASES)


@wp.func
def arctangent(z: float):
    """Return the arctangent of 0…1, to 3e-8 (Abramowitz and Stegun 4.4.49), without branches, so that a pack becomes SIMD instructions."""
    x = z * z
    even = float(0.0028662257)
    even = even * x - 0.0161657367
    even = even * x + 0.0429096138
    even = even * x - 0.0752896400
    even = even * x + 0.1065626393
    even = even * x - 0.1420889944
    even = even * x + 0.1999355085
    even = even * x - 0.3333314528
    return z + z * x * even


@wp.func
def phase_of(a: float, b: float):
    """Return the angle of (a, b), 0…2π; 0 for (0, 0)."""
    across = wp.abs(a)
    up = wp.abs(b)
    angle = arctangent(wp.min(across, up) / wp.max(wp.max(across, up), 1.0e-30))
    angle = wp.where(up > across, 0.5 * wp.pi - angle, angle)
    angle = wp.where(a < 0.0, wp.pi - angle, angle)
    return wp.where(b < 0.0, 2.0 * wp.pi - angle, angle)


@once
def decode_kernel(pack: int) -> Any:
    """Return the kernel for packs of this many pixels."""
    float_pack = pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def correlation_kernel(first: int,
                           images: wp.array2d(dtype=float_pack),  # [M, P]
                           order: wp.array(dtype=wp.int32),  # [M] images by frequency
                           begin: wp.array(dtype=wp.int32),  # [F + 1] where a frequency begins in order
                           basis: wp.array2d(dtype=wp.float32),  # [M, 6] rows of P, a, b; cos δ, sin δ; scale
                           shot: float,
                           read_variance: float,
                           saturation: float,
                           # outputs
                           phase: wp.array2d(dtype=float_pack),  # [F, P]
                           sigma: wp.array2d(dtype=float_pack),
                           amplitude: wp.array2d(dtype=float_pack),
                           offset: wp.array2d(dtype=float_pack),
                           evidence: wp.array2d(dtype=float_pack),
                           residual: wp.array2d(dtype=float_pack)):
        t = first + wp.tid()
        f = t // images.shape[1]  # one frequency after the other: fewer arrays are written side by side
        p = t - f * images.shape[1]
        level, a, b = float_pack(), float_pack(), float_pack()
        aa, ab, bb = float_pack(), float_pack(), float_pack()
        blind, left = float_pack(), float_pack()
        for j in range(begin[f], begin[f + 1]):
            y = images[order[j], p]
            row_p, row_a, row_b = basis[j, 0], basis[j, 1], basis[j, 2]
            for k in range(pack):
                blind[k] += wp.where(wp.abs(y[k]) < saturation, 0.0, 1.0)  # NaN is not below it either
                variance = read_variance + shot * wp.max(y[k], shot) + (ROUNDING * y[k]) * (ROUNDING * y[k])  # at least an electron
                level[k] += row_p * y[k]
                a[k] += row_a * y[k]
                b[k] += row_b * y[k]
                aa[k] += row_a * row_a * variance
                ab[k] += row_a * row_b * variance
                bb[k] += row_b * row_b * variance
        for j in range(begin[f], begin[f + 1]):
            y = images[order[j], p]
            cosine, sine, factor = basis[j, 3], basis[j, 4], basis[j, 5]
            for k in range(pack):
                e = y[k] * factor - level[k] - a[k] * cosine - b[k] * sine
                left[k] += e * e
        angle, spread, strength, sure = float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            q2 = a[k] * a[k] + b[k] * b[k]
            safe = wp.max(q2, 1.0e-36)
            across = (b[k] * b[k] * aa[k] - 2.0 * a[k] * b[k] * ab[k] + a[k] * a[k] * bb[k]) / safe  # at right angles to (a, b)
            angle[k] = wp.where(blind[k] > 0.0, 0.0, phase_of(a[k], b[k]))
            strength[k] = wp.where(blind[k] > 0.0, 0.0, wp.sqrt(q2))
            level[k] = wp.where(blind[k] > 0.0, 0.0, level[k])
            left[k] = wp.where(blind[k] > 0.0, 0.0, left[k])
            lit = wp.where(q2 > 0.0, wp.sqrt(wp.max(across, 0.0) / safe), 0.0)
            spread[k] = wp.where(blind[k] > 0.0, -1.0, lit)
            sure[k] = wp.where(blind[k] > 0.0, 0.0, 2.0 * q2 / wp.max(aa[k] + bb[k], 1.0e-36))
        phase[f, p] = angle
        sigma[f, p] = spread
        amplitude[f, p] = strength
        offset[f, p] = level
        evidence[f, p] = sure
        residual[f, p] = left

    return correlation_kernel


SIGNAL_Z = 4.75
"""Standard normal quantile of the signal test: one pixel in a million without signal is taken to have one."""


def quantile(freedom: int, z: float) -> float:
    """Return a quantile of the chi-squared distribution, by Wilson and Hilferty's approximation (PNAS 1931): error below 3 % here."""
    a = 2 / (9 * freedom)
    return float(freedom * (1 - a + z * a**0.5) ** 3)


def signal_limits(frequencies: int) -> list[float]:
    """Return the least sums of evidence that noise alone does not reach, over 1, 2, … frequencies."""
    return [quantile(2 * used, SIGNAL_Z) for used in range(1, frequencies + 1)]


ENTRIES = 512
"""Number of entries in the table: between two of them, the eighth harmonic of a correction departs from a straight line by less than 0.2 %
of its amplitude."""


def sample_harmonics(cosines: np.ndarray, sines: np.ndarray) -> np.ndarray:
    """Return Σ_h cosines[h]·cos hφ + sines[h]·sin hφ, radians, at the ENTRIES phases k · 2π / ENTRIES; h counts from 0."""
    angle = np.arange(ENTRIES)[:, None] * (2 * np.pi / ENTRIES) * np.arange(len(cosines))
    return np.cos(angle) @ np.asarray(cosines, dtype=np.float64) + np.sin(angle) @ np.asarray(sines, dtype=np.float64)


def straighten(found: Correlation, table: np.ndarray) -> Correlation:
    """Correct each phase by the table's value at it.

    Args:
        table: [frequency, entries] radians by measured phase, evenly spaced over the turn; interpolated linearly.

    Source:
        Lindner, Kolb, "Lateral and depth calibration of PMD-distance sensors", ISVC 2006 (the table); here harmonics of the phase.
    """
    if table.ndim != 2 or len(table) != len(found.modulation_hz):
        raise ArrayError(f"the table is {table.shape}, there are {len(found.modulation_hz)} frequencies: give [frequency, entries]")
    if not np.isfinite(table).all():
        raise ArrayError("the table has values that are not finite: measure it anew")
    device = found.phase.device
    straight = wp.zeros_like(found.phase)
    devices.launch(_straighten_kernel, found.phase.shape[1],
                   [found.phase, wp.array(table, dtype=wp.float32, device=device)], [straight],
                   device=str(device))
    return found._replace(phase=straight)


@wp.kernel(module="unique")
def _straighten_kernel(first: int,
                       phase: wp.array2d(dtype=wp.float32),  # [F, pixel]
                       table: wp.array2d(dtype=wp.float32),  # [F, entries]
                       # outputs
                       straight: wp.array2d(dtype=wp.float32)):
    p = first + wp.tid()
    entries = table.shape[1]
    for f in range(table.shape[0]):
        at = phase[f, p] * float(entries) / (2.0 * wp.pi)
        before = wp.floor(at)
        part = at - before
        k = int(before) % entries
        angle = phase[f, p] - (table[f, k] * (1.0 - part) + table[f, (k + 1) % entries] * part)
        straight[f, p] = angle - 2.0 * wp.pi * wp.floor(angle / (2.0 * wp.pi))
