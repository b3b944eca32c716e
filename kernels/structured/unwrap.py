"""Wrapped phases → the projector's coordinate: jointly over several periods, or numbered by the stripes of another code.

Jointly: a place u shows the phases 2π u / P_i, so every wrap of the shortest period over the projector's width is a candidate,
refined by weighted least squares and judged by the χ² of what remains. That is the maximum of the likelihood, whatever the
periods are: coprime (number-theoretic), close to each other (heterodyne) or a long one with a short one (hierarchical).

Sources: Gushov and Solodkin, Optics and Lasers in Engineering 1991 (number-theoretic); Cheng and Wyant, Applied Optics 1985
(two wavelengths); Huntley and Saldner, Applied Optics 1993 (hierarchical); Sansoni, Carocci and Rodella, Applied Optics 1999
(Gray code and phase).
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import TURN
from kernels.errors import ArrayError
from kernels.packs import as_packs, pack_type
from kernels.status import OK, Status
from kernels.structured.decoded import Decoded, unwritten_decoded
from kernels.structured.phase import WrappedPhase

MODEL_PHASE_ERROR = 0.02
"""Error of a phase beyond noise, radians: imperfect responses and blur cause it, and with noise alone a wrap would seem too certain."""
UNDECIDED_CHI2 = 9.0
"""The second-best candidate leaves a pixel UNDECIDED when its χ² is at most this (three standard deviations) …"""
UNDECIDED_RATIO = 2.0
"""… plus this many times the χ² of the best candidate, which is large where something unmodelled disturbs the phases."""
MULTIPATH_CHI2 = 225.0
"""Largest χ² of the best candidate whose phases agree: beyond 15 standard deviations, 0.3 radians where noise is low, they contradict each
other."""
MIN_SEPARATION = 0.02
"""Least distance between the phases of two places, radians, so that the periods tell the places apart."""
MIN_COVER = 0.75
"""Least part of the projector over which the periods are unambiguous. Where they repeat just within it, only the places at its two ends
look alike and are UNDECIDED; with less than this part, most places would be."""
BORDER_SIGMAS = 4.0
"""Standard deviations by which a place may lie outside the projector."""
WRAP_MARGIN = 0.375
"""Largest distance between a place and the centre of its stripe, as a part of the period: at one half, the next wrap would fit as well."""
EMPTY_CHI2 = 1.0e30
"""Sentinel χ² of a slot that holds no candidate."""

_OUT_OF_RANGE, _UNDECIDED, _MULTIPATH = int(Status.OUT_OF_RANGE), int(Status.UNDECIDED), int(Status.MULTIPATH)


def unwrap_range(periods_px: tuple[float, ...], extent: float) -> float:
    """Return how far apart, in projector pixels, places are at which the periods show the same phases; infinity beyond the extent."""
    shortest, others = min(periods_px), np.array(periods_px)
    offsets = np.arange(1, int(np.ceil(extent / shortest))) * shortest
    turns = offsets[:, None] / others
    rest = turns - np.round(turns)
    slope = 1 / others
    shift = (rest @ slope) / (slope @ slope)
    separation = 2 * np.pi * np.linalg.norm(rest - shift[:, None] * slope, axis=1)
    alike = np.flatnonzero((separation < MIN_SEPARATION) & (offsets - shift < extent * (1 - 1e-9)))
    return float(offsets[alike[0]] - shift[alike[0]]) if alike.size else float("inf")


def unwrap_jointly(wrapped: WrappedPhase, *, extent: float) -> Decoded:
    """Return the coordinate that fits the phases of all periods best; not synchronised on CUDA.

    The amplitude is the mean over the periods. UNDECIDED: another wrap within the projector fits about as well. MULTIPATH: none fits. Both
    keep the coordinate that fits best, and its deviation in that wrap. OUT_OF_RANGE: what fits lies outside. Else the first period that has
    no phase says why. Where the periods disagree by more than their deviations, sigma grows by the root of χ² over its degrees of freedom:
    motion between frames and bent waves shift each period by another amount.
    `extent`: projector pixels along the axis. Raises ArrayError: the periods repeat within less than MIN_COVER of the projector."""
    if not extent > 0:
        raise ArrayError(f"the projector has {extent:g} px: give more than 0")
    covered = unwrap_range(wrapped.periods_px, extent)
    if covered < MIN_COVER * extent:
        listed = ", ".join(f"{period:g}" for period in wrapped.periods_px)
        raise ArrayError(f"phases of {listed} px repeat after {covered:.4g} px, the projector has {extent:g}: "
                         "add a period, or Gray frames that number the periods")
    result, shape = unwritten_decoded(wrapped.pixel_count, wrapped.device), wrapped.phase.shape
    weight = wp.empty(shape, dtype=wp.float32, device=wrapped.device)
    reference = int(np.argmin(wrapped.periods_px))
    devices.launch(_joint_kernel(devices.pack_width(wrapped.device)), shape[1] // devices.pack_width(wrapped.device),
                   [*_inputs(wrapped), reference, int(np.ceil(extent / wrapped.periods_px[reference])), float(extent)],
                   [as_packs(array, wrapped.device) for array in (weight, *result)], device=wrapped.device)
    return result


def unwrap_by_code(wrapped: WrappedPhase, coarse: Decoded, *, stripe_px: float, extent: float) -> Decoded:
    """Return each phase in the wrap nearest to a stripe of another code; several periods are averaged by their variance.

    Not synchronised on CUDA. UNDECIDED: two wraps are about as near; the nearest is kept. OUT_OF_RANGE: outside. Else the status of the
    code, or of the first period that has no phase.

    Args:
        coarse: the same pixels from a binary, Gray, XOR or k-ary code.
        stripe_px: its finest stripe, at most the shortest period. If it is more than half of it, places farther than WRAP_MARGIN from the
            coordinate that `coarse` gives are UNDECIDED: give edges refined (edges.py), not the stripes' centres.
        extent: projector pixels along the axis.

    Raises:
        ArrayError: stripes too wide to number the periods, or other pixels.
    """
    if stripe_px > min(wrapped.periods_px):
        raise ArrayError(f"stripes of {stripe_px:g} px cannot number periods of {min(wrapped.periods_px):g} px: "
                         "give stripes of a period or less")
    if coarse.coordinate.shape[0] != wrapped.phase.shape[1]:
        raise ArrayError(f"the code has {coarse.coordinate.shape[0]} pixels, the phase {wrapped.phase.shape[1]}: decode the same frames")
    result = unwritten_decoded(wrapped.pixel_count, wrapped.device)
    given = [as_packs(array, wrapped.device) for array in (coarse.coordinate, coarse.status)]
    devices.launch(_numbered_kernel(devices.pack_width(wrapped.device)), given[0].shape[0], [*_inputs(wrapped), *given, float(extent)],
                   [as_packs(array, wrapped.device) for array in result], device=wrapped.device)
    return result


def _inputs(wrapped: WrappedPhase) -> list[Any]:
    rows = [as_packs(array, wrapped.device) for array in (wrapped.phase, wrapped.sigma, wrapped.amplitude, wrapped.status)]
    frequency = 1 / np.array(wrapped.periods_px)
    return [*rows, wp.array(frequency, dtype=wp.float32, device=wrapped.device)]


@wp.func
def add_period(flag: int, amplitude: float, periods: int, code: wp.ref[int], mean: wp.ref[float]):
    """Add a period's amplitude to the mean over the periods; the first status that is not OK stays."""
    code = wp.where(code <= OK, flag, code)
    mean += amplitude / float(periods)


@wp.func
def keep_better(cost: float, candidate: float, best: wp.ref[float], second: wp.ref[float], place: wp.ref[float]):
    """Keep a candidate in `place` where it costs less than the best so far, and the two lowest costs."""
    better = wp.where(cost < best, 1.0, 0.0)
    second = wp.min(second, wp.max(cost, best))
    best = wp.min(cost, best)
    place += better * (candidate - place)


@wp.func
def judge(best: float, second: float) -> int:
    """Return the status of the candidate that costs least from the two lowest costs, in χ²."""
    code = OK
    if best >= EMPTY_CHI2:
        code = _OUT_OF_RANGE
    elif best > MULTIPATH_CHI2:
        code = _MULTIPATH
    elif second < UNDECIDED_CHI2 + UNDECIDED_RATIO * best:
        code = _UNDECIDED
    return code


@wp.func
def keeps_place(code: int) -> bool:
    """Return whether a pixel that has been judged keeps its coordinate."""
    return code == OK or (code - _UNDECIDED) * (code - _MULTIPATH) == 0


@once
def _joint_kernel(pack: int) -> Any:
    float_pack, int_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32), pack_type(pack, wp.uint8)

    @wp.kernel(enable_backward=False, module="unique")
    def joint_kernel(first: int,
                     phase: wp.array2d(dtype=float_pack),  # [periods, P] radians
                     deviation: wp.array2d(dtype=float_pack),  # [periods, P] radians
                     swing: wp.array2d(dtype=float_pack),  # [periods, P]
                     state: wp.array2d(dtype=byte_pack),  # [periods, P]
                     frequency: wp.array(dtype=float),  # [periods] 1 / px
                     reference: int,  # the shortest period
                     wraps: int,
                     extent: float,
                     # outputs
                     weight: wp.array2d(dtype=float_pack),  # [periods, P] scratch: 1 / turns²
                     coordinate: wp.array(dtype=float_pack),
                     sigma: wp.array(dtype=float_pack),
                     amplitude: wp.array(dtype=float_pack),
                     status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        turn = wp.static(1.0 / TURN)
        periods = frequency.shape[0]
        code, mean, stiffness = int_pack(), float_pack(), float_pack()
        for q in range(periods):
            flags = state[q, p]
            height = swing[q, p]
            spread = deviation[q, p]
            trust = float_pack()
            f = frequency[q]
            for k in range(pack):
                add_period(int(flags[k]), height[k], periods, code[k], mean[k])
                trust[k] = 1.0 / (turn * turn * (spread[k] * spread[k] + wp.static(MODEL_PHASE_ERROR**2)))
                stiffness[k] = stiffness[k] + trust[k] * f * f
            weight[q, p] = trust

        # every wrap of the reference, and how well the others fit there
        base = phase[reference, p]
        best, second, place, border, inverse = float_pack(EMPTY_CHI2), float_pack(EMPTY_CHI2), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            inverse[k] = 1.0 / stiffness[k]
            border[k] = wp.static(BORDER_SIGMAS) * wp.sqrt(inverse[k])
        step = 1.0 / frequency[reference]
        for wrap in range(-1, wraps + 1):
            squares, slopes = float_pack(), float_pack()
            for q in range(periods):
                angle = phase[q, p]
                trust = weight[q, p]
                f = frequency[q]
                for k in range(pack):
                    t = (base[k] * turn + float(wrap)) * step * f - angle[k] * turn
                    rest = t - wp.floor(t + 0.5)
                    squares[k] = squares[k] + trust[k] * rest * rest
                    slopes[k] = slopes[k] + trust[k] * rest * f
            for k in range(pack):
                middle = (base[k] * turn + float(wrap)) * step
                u = middle - slopes[k] * inverse[k]
                outside = wp.where(wp.abs(u - 0.5 * extent) > 0.5 * extent + border[k], EMPTY_CHI2, 0.0)
                cost = wp.max(squares[k] - slopes[k] * slopes[k] * inverse[k], 0.0) + outside
                keep_better(cost, middle, best[k], second[k], place[k])

        # in that wrap, every phase by its own variance
        slope_sum, information = float_pack(), float_pack()
        for q in range(periods):
            angle = phase[q, p]
            spread = deviation[q, p]
            f = frequency[q]
            for k in range(pack):
                t = place[k] * f - angle[k] * turn
                rest = t - wp.floor(t + 0.5)
                trust_alone = 1.0 / (turn * turn * spread[k] * spread[k] + 1.0e-20)
                slope_sum[k] = slope_sum[k] + trust_alone * rest * f
                information[k] = information[k] + trust_alone * f * f
        u_out, error, result = float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            if code[k] == OK:
                code[k] = judge(best[k], second[k])
            if keeps_place(code[k]):
                u_out[k] = place[k] - slope_sum[k] / information[k]
                error[k] = wp.sqrt(wp.max(best[k] / float(wp.max(periods - 1, 1)), 1.0) / information[k])
            else:
                mean[k] = 0.0
            result[k] = wp.uint8(code[k])
        coordinate[p] = u_out
        sigma[p] = error
        amplitude[p] = mean
        status[p] = result

    return joint_kernel


@once
def _numbered_kernel(pack: int) -> Any:
    float_pack, int_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32), pack_type(pack, wp.uint8)

    @wp.kernel(enable_backward=False, module="unique")
    def numbered_kernel(first: int,
                        phase: wp.array2d(dtype=float_pack),  # [periods, P] radians
                        deviation: wp.array2d(dtype=float_pack),  # [periods, P] radians
                        swing: wp.array2d(dtype=float_pack),  # [periods, P]
                        state: wp.array2d(dtype=byte_pack),  # [periods, P]
                        frequency: wp.array(dtype=float),  # [periods] 1 / px
                        coarse: wp.array(dtype=float_pack),  # [P] px
                        coarse_state: wp.array(dtype=byte_pack),  # [P]
                        extent: float,
                        # outputs
                        coordinate: wp.array(dtype=float_pack),
                        sigma: wp.array(dtype=float_pack),
                        amplitude: wp.array(dtype=float_pack),
                        status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        turn = wp.static(1.0 / TURN)
        periods = frequency.shape[0]
        near = coarse[p]
        given = coarse_state[p]
        code, whole, mean, away, total, information = int_pack(), int_pack(), float_pack(), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            code[k] = int(given[k])
            whole[k] = wp.where(near[k] > 0.0, 1, 0)
        for q in range(periods):
            angle = phase[q, p]
            spread = deviation[q, p]
            height = swing[q, p]
            flags = state[q, p]
            f = frequency[q]
            for k in range(pack):
                add_period(int(flags[k]), height[k], periods, code[k], mean[k])
                whole[k] = whole[k] * wp.where(int(flags[k]) == OK, 1, 0)
                t = angle[k] * turn - near[k] * f
                rest = t - wp.floor(t + 0.5)
                trust = f * f / (turn * turn * spread[k] * spread[k] + 1.0e-20)
                away[k] = wp.max(away[k], wp.abs(rest))
                total[k] = total[k] + trust * rest / f
                information[k] = information[k] + trust
        u_out, error, result = float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            u = near[k] + total[k] / information[k]
            deviation_u = 1.0 / wp.sqrt(information[k])
            if code[k] == OK:
                if away[k] > WRAP_MARGIN:
                    code[k] = _UNDECIDED
                elif wp.abs(u - 0.5 * extent) > 0.5 * extent + BORDER_SIGMAS * deviation_u:
                    code[k] = _OUT_OF_RANGE
            if whole[k] == 1 and keeps_place(code[k]):
                u_out[k] = wp.clamp(u, 0.0, extent)
                error[k] = deviation_u
            else:
                mean[k] = 0.0
            result[k] = wp.uint8(code[k])
        coordinate[p] = u_out
        sigma[p] = error
        amplitude[p] = mean
        status[p] = result

    return numbered_kernel
