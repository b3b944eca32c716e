"""Phase shifting: readings I = A + B cos(φ - δ) under three or more shifts δ of each period → φ, B, A by least squares.

Written as A + C cos δ + S sin δ the fit is linear, so each of the three is a fixed weighted sum of the readings whatever the
shifts; φ = atan2(S, C), B = √(C² + S²). With the variance v of each reading the same sums give
var φ = (C² V_SS + S² V_CC - 2 C S V_CS) / B⁴ to first order, V_XY = Σ x y v.

Sources: Bruning et al., Applied Optics 1974 (synchronous detection); Greivenkamp, Optical Engineering 1984 (least squares, any
shifts); Surrel, Applied Optics 1997 (noise).
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import angle_of
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, as_packs, pack_type, unwritten
from kernels.status import OK, Status
from kernels.structured.pattern_frames import NoiseModel, check_noise, cut_in, require_frames, saturation_masks
from kernels.structured.response import bent_wave, phase_table, straighten

SIGNAL_SIGMAS = 5.0
"""Least light of the projector in its standard deviations, below which a pixel is SHADOWED, and least amplitude in its standard deviations,
below which it has LOW_MODULATION: the phase would be uncertain by more than 0.2 radians."""
MIN_MODULATION = 0.02
"""Least ratio of the amplitude to the offset without ambient light: below it, the pattern is blurred or outshone by interreflection, and
harmonics decide the phase."""
MIN_SPREAD = 1.0e-3
"""Least singular value of the fit, divided by the root of the number of frames: even shifts have 0.7, two shifts 0."""

_SATURATED, _SHADOWED, _LOW_MODULATION = int(Status.SATURATED), int(Status.SHADOWED), int(Status.LOW_MODULATION)


class WrappedPhase(NamedTuple):
    """Phases of a band, one row a period; pixels are padded to whole packs. Only entries with status OK have values."""

    phase: wp.array  # [periods, pixels] float32 radians, 0 to 2π: 2π u / period
    amplitude: wp.array  # [periods, pixels] float32, B
    offset: wp.array  # [periods, pixels] float32, A, ambient included
    sigma: wp.array  # [periods, pixels] float32 radians, standard deviation of the phase
    status: wp.array  # [periods, pixels] uint8
    periods_px: tuple[float, ...]
    pixel_count: int
    device: str


def decode_phase(frames: Band, numbers: Sequence[int], periods_px: Sequence[float], shifts: Sequence[float], *,
                 black: int | None = None, response: Sequence[float] | None = None, wave_errors: Sequence[float] | None = None,
                 noise: NoiseModel) -> WrappedPhase:
    """Decode the wrapped phase of every period, in order of first appearance; not synchronised on CUDA.

    SATURATED: a frame of the period is. SHADOWED: the mean is not above ambient. LOW_MODULATION: the pattern is not seen in the light that
    there is.

    Args:
        frames: linear images of one channel.
        numbers: the phase frames, in any order.
        periods_px: of each of them.
        shifts: δ of each of them in turns (step / steps), any three or more different ones a period.
        black: frame of the ambient light, or None: then it counts as light of the projector in telling SHADOWED pixels.
        response: the projector's light at even levels from 0 to 1, rising, which bends the waves; None: linear.
        wave_errors: of each period's phase beyond noise, radians, in order of first appearance; None: none.

    Raises:
        ArrayError: lists of different lengths, a frame that does not exist or is given twice, a period with fewer than three different
            shifts, a response under which the phase cannot be told.
    """
    check_noise(noise)
    require_frames(frames, *numbers, black)
    if not numbers or not len(numbers) == len(periods_px) == len(shifts):
        raise ArrayError(f"there are {len(numbers)} frames, {len(periods_px)} periods, {len(shifts)} shifts: give one of each for "
                         "every frame, and at least three")
    periods = tuple(dict.fromkeys(float(period) for period in periods_px))
    table, bends, order, starts = [], [], [], [0]
    wave = None if response is None else bent_wave(response)
    for period in periods:
        if not period > 0:
            raise ArrayError(f"a period is {period:g} px: give more than 0")
        members = [index for index, other in enumerate(periods_px) if float(other) == period]
        own = np.array([shifts[index] for index in members])
        table.append(weights(own, period))
        bends.append(None if wave is None else phase_table(wave, table[-1], own, period))
        order += [numbers[index] for index in members]
        starts.append(len(order))
    device, pack = frames.device, devices.pack_width(frames.device)
    masks = saturation_masks(frames, *(order[a:b] for a, b in pairwise(starts))).reshape((len(periods), -1))
    rows = [unwritten(frames.pixel_count, dtype, device, rows=len(periods)) for dtype in (*[wp.float32] * 4, wp.uint8)]
    devices.launch(_phase_kernel(pack, black is not None), frames.packs,
                   [frames.values, frames.saturated, masks,
                    wp.array(order, dtype=wp.int32, device=device), wp.array(starts, dtype=wp.int32, device=device),
                    wp.array(np.concatenate(table), dtype=wp.vec3, device=device), black or 0, noise.read**2, noise.gain],
                   [as_packs(row, device) for row in rows], device=device)
    if wave is not None or wave_errors is not None:
        straighten(rows, bends, wave_errors or [0.0] * len(periods), device=device)
    return WrappedPhase(*rows, periods, frames.pixel_count, device)


def join_periods(parts: Sequence[WrappedPhase]) -> WrappedPhase:
    """Return all periods of several phases of the same pixels, in the order given."""
    if not parts:
        raise ArrayError("no phase is given: give one or more")
    first = parts[0]
    other = next((part.pixel_count for part in parts if part.pixel_count != first.pixel_count), None)
    if other is not None:
        raise ArrayError(f"one phase has {first.pixel_count} pixels, another {other}: decode the same frames")
    periods = tuple(period for part in parts for period in part.periods_px)
    joined = []
    for field in ("phase", "amplitude", "offset", "sigma", "status"):
        rows = [getattr(part, field)[row] for part in parts for row in range(len(part.periods_px))]
        plane = unwritten(first.pixel_count, rows[0].dtype, first.device, rows=len(periods))
        for row, values in enumerate(rows):
            wp.copy(plane[row], values)
        joined.append(plane)
    return WrappedPhase(*joined, periods, first.pixel_count, first.device)


def weights(shifts: np.ndarray, period_px: float) -> np.ndarray:
    """Return the weights [frames, 3] of each reading in A, C and S, rows of the pseudo-inverse, from shifts in turns.

    Raises:
        ArrayError: the shifts do not determine three unknowns.
    """
    design = np.stack([np.ones_like(shifts), np.cos(2 * np.pi * shifts), np.sin(2 * np.pi * shifts)], axis=1)
    if len(shifts) < 3 or np.linalg.svd(design, compute_uv=False)[-1] < MIN_SPREAD * np.sqrt(len(shifts)):
        given = ", ".join(f"{shift:.3g}" for shift in shifts)
        raise ArrayError(f"the period of {period_px:g} px has shifts of {given} turns: give three or more different ones")
    return np.linalg.pinv(design).T


@wp.struct
class PixelPhase:
    """One period at one pixel, as in WrappedPhase."""

    phase: float
    amplitude: float
    offset: float
    sigma: float
    status: int


@wp.func
def add_frame(y: float, v: float, a: float, c: float, s: float, mean: wp.ref[float], along: wp.ref[float], across: wp.ref[float],
              vaa: wp.ref[float], vcc: wp.ref[float], vss: wp.ref[float], vcs: wp.ref[float]):
    """Add a reading y of variance v, whose row of the pseudo-inverse is given, to A, C, S and to what noise leaves of them."""
    mean += a * y
    along += c * y
    across += s * y
    vaa += a * a * v
    vcc += c * c * v
    vss += s * s * v
    vcs += c * s * v


@wp.func
def phase_of(cut: int, mean: float, along: float, across: float, vaa: float, vcc: float, vss: float, vcs: float,
             dark: float, dark_variance: float) -> PixelPhase:
    """Return the phase of one pixel from A, C, S and their variances; `cut` is not 0 where a frame saturates, dark the ambient light.

    There is no branch in it, so that a loop over a pack becomes SIMD instructions.
    """
    c2, s2 = along * along, across * across
    twice = 2.0 * along * across * vcs
    square = c2 + s2
    over = 1.0 / (square + 1.0e-30)
    light = mean - dark
    swing_variance = (c2 * vcc + s2 * vss + twice) * over
    lit = wp.where(light > wp.static(SIGNAL_SIGMAS) * wp.sqrt(vaa + dark_variance), 1, 0)  # 0 also for NaN
    clear = wp.where(square > wp.static(SIGNAL_SIGMAS**2) * swing_variance, 1, 0)
    strong = wp.where(square > wp.static(MIN_MODULATION**2) * light * light, 1, 0)
    whole = wp.where(cut == 0, 1, 0)
    seen = lit * clear * strong
    code = OK * seen + (1 - seen) * (lit * _LOW_MODULATION + (1 - lit) * _SHADOWED)
    found = PixelPhase()
    found.status = whole * code + (1 - whole) * _SATURATED
    known = found.status == OK  # keeps NaN out of the results
    found.phase = wp.where(known, angle_of(along, across), 0.0)
    found.amplitude = wp.where(known, wp.sqrt(square), 0.0)
    found.offset = wp.where(known, mean, 0.0)
    found.sigma = wp.where(known, wp.sqrt(wp.max(c2 * vss + s2 * vcc - twice, 0.0)) * over, 0.0)
    return found


@once
def write_phases_in(pack: int) -> Any:
    """Return the Warp function that writes the phase of every pixel of a pack, one row of a WrappedPhase, from its sums."""
    float_pack, int_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32), pack_type(pack, wp.uint8)

    @wp.func
    def write_phases(row: int, p: int, cut: int_pack, mean: float_pack, along: float_pack, across: float_pack, vaa: float_pack,
                     vcc: float_pack, vss: float_pack, vcs: float_pack, dark: float_pack, dark_variance: float_pack,
                     phase: wp.array2d(dtype=float_pack), amplitude: wp.array2d(dtype=float_pack), offset: wp.array2d(dtype=float_pack),
                     sigma: wp.array2d(dtype=float_pack), status: wp.array2d(dtype=byte_pack)):
        angle, swing, level, error, result = float_pack(), float_pack(), float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            found = phase_of(cut[k], mean[k], along[k], across[k], vaa[k], vcc[k], vss[k], vcs[k], dark[k], dark_variance[k])
            angle[k] = found.phase
            swing[k] = found.amplitude
            level[k] = found.offset
            error[k] = found.sigma
            result[k] = wp.uint8(found.status)
        phase[row, p] = angle
        amplitude[row, p] = swing
        offset[row, p] = level
        sigma[row, p] = error
        status[row, p] = result

    return write_phases


@once
def _phase_kernel(pack: int, ambient: bool = False) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of, write_phases, load = cut_in(pack), write_phases_in(pack), pack_load(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def phase_kernel(first: int,
                     values: wp.array2d(dtype=float_pack),  # [F, P]
                     saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                     masks: wp.array2d(dtype=int),  # [periods, F / 8]
                     order: wp.array(dtype=int),  # [N] frames, those of a period together
                     starts: wp.array(dtype=int),  # [periods + 1] places in order
                     table: wp.array(dtype=wp.vec3),  # [N] weights for A, C, S
                     black: int,
                     read_variance: float,
                     gain: float,
                     # outputs
                     phase: wp.array2d(dtype=float_pack),
                     amplitude: wp.array2d(dtype=float_pack),
                     offset: wp.array2d(dtype=float_pack),
                     sigma: wp.array2d(dtype=float_pack),
                     status: wp.array2d(dtype=byte_pack)):
        p = first + wp.tid()
        dark, dark_variance = float_pack(), float_pack()
        if wp.static(ambient):
            dark = load(values, black, p)
            for k in range(pack):
                dark_variance[k] = read_variance + gain * wp.max(dark[k], 0.0)
        for period in range(masks.shape[0]):
            cut = cut_of(saturated, masks[period], p)
            mean, along, across = float_pack(), float_pack(), float_pack()
            vaa, vcc, vss, vcs = float_pack(), float_pack(), float_pack(), float_pack()
            for n in range(starts[period], starts[period + 1]):
                reading = load(values, order[n], p)
                a, c, s = table[n][0], table[n][1], table[n][2]
                for k in range(pack):
                    add_frame(reading[k], read_variance + gain * wp.max(reading[k], 0.0), a, c, s,
                              mean[k], along[k], across[k], vaa[k], vcc[k], vss[k], vcs[k])
            write_phases(period, p, cut, mean, along, across, vaa, vcc, vss, vcs, dark, dark_variance,
                         phase, amplitude, offset, sigma, status)

    return phase_kernel
