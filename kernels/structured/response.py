"""Waves that a projector bends: what its response makes of a cosine, and the phase that a fit of sinusoids then reads, put right.

A projector shows g((1 + cos θ)/2) in place of (1 + cos θ)/2. The fitted sums C + iS of the readings are then a fixed curve F(φ) of the true
phase φ, whatever the surface reflects and whatever other light there is, because the weights of the fit add up to zero. So the angle of F
is a function of φ alone; it is tabulated and inverted, and the deviation of the phase grows by the slope of the inverse.

Source: Zhang and Huang, "Phase error compensation for a 3-D shape measurement system based on the phase-shifting method", Optical
Engineering 2007 (table of the error over the phase); here it follows from the measured response.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import TURN
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.status import OK

BINS = 1024
"""Number of steps of the table over a turn: linear between them, the phase is good to 1e-5 radians at a response of level^2.2."""
GRID = 8 * BINS
"""Number of phases at which the curve is computed before it is inverted."""
LIGHT_STEPS = 1024
"""Number of steps of the table of light over level that kernels interpolate."""
MIN_SLOPE = 0.1
"""Least slope of the fitted phase over the true one: below it, two places of a period look nearly alike."""


def light_of(response: Sequence[float] | np.ndarray | None, levels: np.ndarray) -> np.ndarray:
    """Return the light of a projector at levels […], 0…1, as a part of its white minus its black, float64.
    `response`: [n] the projector's light at n even levels from 0 to 1, rising; None: linear. Raises ArrayError: a response that does not
    rise."""
    if response is None:
        return np.asarray(levels, dtype=np.float64)
    given = np.asarray(response, dtype=np.float64)
    if given.ndim != 1 or len(given) < 2 or not np.isfinite(given).all() or not (np.diff(given) > 0).all():
        raise ArrayError(f"the response is {given.shape}: give two or more values, each above the one before")
    return np.asarray(np.interp(levels, np.linspace(0, 1, len(given)), (given - given[0]) / (given[-1] - given[0])))


def light_table(response: Sequence[float] | np.ndarray | None) -> np.ndarray:
    """Return the light at LIGHT_STEPS + 1 even levels from 0 to 1, [LIGHT_STEPS + 1] float64."""
    return light_of(response, np.linspace(0, 1, LIGHT_STEPS + 1))


def bent_wave(response: Sequence[float] | np.ndarray | None) -> np.ndarray:
    """Return the light of a raised cosine over one turn, [GRID] float64, 0…1."""
    return light_of(response, 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(GRID) / GRID))


def modulated_wave(response: Sequence[float] | np.ndarray | None, carrier_weights: np.ndarray) -> np.ndarray:
    """Return what a carrier tells of a modulated wave over one turn of the wave, as a mean over the carrier's phases.

    The wave is [GRID], its scale free; `carrier_weights` is [carrier steps, 3] of `phase.weights`, at even shifts.
    """
    steps = len(carrier_weights)
    wave = 0.5 + 0.5 * np.cos(2 * np.pi * np.arange(BINS // 4) / (BINS // 4))
    amplitude = np.zeros(len(wave))
    for start in np.arange(12) / 12 / steps:
        carrier = 0.5 + 0.5 * np.cos(2 * np.pi * (start - np.arange(steps) / steps))
        light = light_of(response, wave[:, None] * carrier)
        amplitude += np.hypot(light @ carrier_weights[:, 1], light @ carrier_weights[:, 2])
    return np.interp(np.arange(GRID) / GRID, np.arange(len(wave) + 1) / len(wave), np.append(amplitude, amplitude[0]))


def fitted_curve(wave: np.ndarray, weights: np.ndarray, shifts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a fit of sinusoids makes of a wave at GRID even phases: C + iS, and A.
    `wave`: [GRID] light over one turn. `weights`: [frames, 3] of the fit's A, C and S. `shifts`: [frames] turns."""
    at = (np.arange(GRID)[:, None] / GRID - shifts) % 1.0
    light = np.interp(at, np.arange(GRID + 1) / GRID, np.append(wave, wave[0]))
    return light @ (weights[:, 1] + 1j * weights[:, 2]), light @ weights[:, 0]


def phase_table(wave: np.ndarray, weights: np.ndarray, shifts: np.ndarray, period_px: float) -> np.ndarray:
    """Return how a fitted phase is put right, from a wave that spans 0 to 1 and what `fitted_curve` takes; the period is for the message.

    Returns:
        [BINS + 1, 4]: at even fitted phases from 0 to 2π what is added to the phase (radians), the slope of the true over the fitted phase,
        the factor of the amplitude, and what is added to the offset over the amplitude put right, so that it is the reading at half of the
        light.

    Raises:
        ArrayError: the fitted phase does not rise with the true one.
    """
    curve, mean = fitted_curve(wave, weights, shifts)
    fitted = np.unwrap(np.angle(curve))
    true = 2 * np.pi * np.arange(GRID) / GRID
    slope = np.gradient(np.concatenate([fitted[-1:] - 2 * np.pi, fitted, fitted[:1] + 2 * np.pi]), 2 * np.pi / GRID)[1:-1]
    if slope.min() < MIN_SLOPE:
        raise ArrayError(f"the projector's response bends the wave of {period_px:g} px so far that {len(shifts)} shifts show two places of "
                         "a period alike: project four shifts or more, or patterns that are linear in light (relit patterns --gamma)")
    wanted = fitted[0] + 2 * np.pi * np.arange(BINS + 1) / BINS
    at = np.interp(wanted, np.append(fitted, fitted[0] + 2 * np.pi), np.append(true, 2 * np.pi))
    place = at / (2 * np.pi) * GRID

    def seen(values: np.ndarray) -> np.ndarray:
        return np.interp(place, np.arange(GRID + 1), np.append(values, values[0]))

    table = np.stack([at - wanted, 1 / seen(slope), 0.5 / np.maximum(seen(np.abs(curve)), 1e-9), -2 * (seen(mean) - 0.5)], axis=1)
    start = int(np.floor(fitted[0] / (2 * np.pi) * BINS + 0.5))  # from the phase of the first row to a table that begins at zero
    grid = np.arange(BINS + 1) - start
    shift = fitted[0] / (2 * np.pi) * BINS - start
    turned = np.stack([np.interp((grid - shift) % BINS, np.arange(BINS + 1), column) for column in table.T], axis=1)
    return turned


def wave_error(response: Sequence[float] | np.ndarray, weights: np.ndarray, shifts: np.ndarray,
               taken: Sequence[float] | None = None) -> float:
    """Return the RMS error, in radians, of a phase that is fitted as if the projector had the response that is taken; None: linear."""
    curve, other = (fitted_curve(bent_wave(each), weights, shifts)[0] for each in (response, taken))
    off = np.angle(curve * other.conj())
    return float(np.sqrt(np.mean(off**2)))


def straighten(rows: Sequence[wp.array], tables: Sequence[np.ndarray | None], errors: Sequence[float], *, device: str) -> None:
    """Put phases right in place; not synchronised on CUDA.
    `rows`: phase, amplitude, offset, sigma and status, [periods, pixels] each, as in WrappedPhase. `tables`: of `phase_table`, one a
    period; None leaves the phases as they are. `errors`: of each period's phase beyond noise, radians, added to its deviation."""
    plain = np.tile([0.0, 1.0, 1.0, 0.0], (BINS + 1, 1))
    given = np.stack([plain if table is None else table for table in tables])
    pack = devices.pack_width(device)
    devices.launch(_straighten_kernel(pack), rows[0].shape[1] // pack,
                   [wp.array(given, dtype=wp.vec4, device=device), wp.array(np.square(errors), dtype=wp.float32, device=device),
                    as_packs(rows[4], device)], [as_packs(row, device) for row in rows[:4]], device=device)


@wp.func
def light_between(table: wp.array(dtype=float), level: float) -> float:
    """Return the light at a level, 0…1, between the steps of a table."""
    at = wp.clamp(level, 0.0, 1.0) * float(LIGHT_STEPS)
    cell = wp.min(int(at), LIGHT_STEPS - 1)
    return table[cell] + (at - float(cell)) * (table[cell + 1] - table[cell])


@wp.func
def light_slope(table: wp.array(dtype=float), level: float) -> float:
    """Return the slope of the light over the level, 0…1, in a table."""
    cell = wp.min(int(wp.clamp(level, 0.0, 1.0) * float(LIGHT_STEPS)), LIGHT_STEPS - 1)
    return (table[cell + 1] - table[cell]) * float(LIGHT_STEPS)


@once
def _straighten_kernel(pack: int) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)

    @wp.kernel(enable_backward=False, module="unique")
    def straighten_kernel(first: int,
                          table: wp.array2d(dtype=wp.vec4),  # [periods, BINS + 1]
                          error: wp.array(dtype=float),  # [periods] radians²
                          status: wp.array2d(dtype=byte_pack),
                          # outputs
                          phase: wp.array2d(dtype=float_pack),
                          amplitude: wp.array2d(dtype=float_pack),
                          offset: wp.array2d(dtype=float_pack),
                          sigma: wp.array2d(dtype=float_pack)):
        p = first + wp.tid()
        for period in range(table.shape[0]):
            flags = status[period, p]
            angle = phase[period, p]
            swing = amplitude[period, p]
            level = offset[period, p]
            spread = sigma[period, p]
            for k in range(pack):
                if int(flags[k]) == OK:
                    at = wp.min(wp.max(angle[k], 0.0) * wp.static(BINS / TURN), wp.static(BINS - 1.0e-3))
                    cell = int(at)
                    row = table[period, cell] + (at - float(cell)) * (table[period, cell + 1] - table[period, cell])
                    turned = angle[k] + row[0]
                    angle[k] = turned - TURN * wp.floor(turned / TURN)
                    swing[k] = swing[k] * row[2]
                    level[k] = level[k] + row[3] * swing[k]
                    spread[k] = wp.sqrt(spread[k] * spread[k] * row[1] * row[1] + error[period])
            phase[period, p] = angle
            amplitude[period, p] = swing
            offset[period, p] = level
            sigma[period, p] = spread

    return straighten_kernel
