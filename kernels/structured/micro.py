"""Micro phase shifting: three shifts of one short period, one frame of each of several periods close to it.

The reference period gives offset A, amplitude B and a phase. All other frames share A and B: the periods are so short that interreflection
averages every pattern out, and so similar that defocus dims all of them alike. Every wrap of the reference predicts their readings, and the
one whose misfit χ² is least is refined by Gauss-Newton steps on A, B and u over all frames, weighted by their variance. Where χ² stays
larger than noise makes it, as where a pixel sees two surfaces, the deviation grows with its root (Birge 1932).

Source: Gupta and Nayar, "Micro Phase Shifting", CVPR 2012, equations 5 to 10.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.elementary import TURN, cosine_of_turns, sine_of_turns
from kernels.errors import ArrayError
from kernels.normal_equations import add_reading
from kernels.packs import Band, as_packs, pack_type
from kernels.status import OK, Status
from kernels.structured.decoded import Decoded, unwritten_decoded
from kernels.structured.pattern_frames import NoiseModel, cut_in, require_frames, saturation_masks
from kernels.structured.phase import decode_phase
from kernels.structured.response import light_between, light_slope, light_table
from kernels.structured.unwrap import EMPTY_CHI2, judge, keep_better, keeps_place

LEVEL_ERROR = 0.02
"""Error of a reading beyond noise, as a part of the amplitude: the camera's and projector's responses and unequal amplitudes cause it."""
MIN_SEPARATION = 0.05
"""Least distance between the readings at two places, as a part of the amplitude and over all frames together, so that the periods tell the
places apart."""
BORDER_PX = 0.5
"""Distance in projector pixels by which a decoded place may lie outside the projector."""
SELDOM = 1.3
"""Standard deviations of the sum of squares above its mean that a tenth of all pixels exceed by noise."""
STEPS = 3
"""Number of Gauss-Newton steps: the start has the noise of three readings, and each step squares the error."""

_SATURATED, _MULTIPATH, _OUT_OF_RANGE = int(Status.SATURATED), int(Status.MULTIPATH), int(Status.OUT_OF_RANGE)


def decode_micro(frames: Band, numbers: Sequence[int], periods_px: Sequence[float], shifts: Sequence[float], *,
                 black: int | None = None, extent: float, response: Sequence[float] | None = None,
                 wave_error_px: float = 0.0, noise: NoiseModel) -> Decoded:
    """Decode the coordinate from frames of several close periods that share offset and amplitude; not synchronised on CUDA.

    UNDECIDED: another wrap fits about as well. MULTIPATH: none fits; both keep what fits best. Else as decode_phase.

    Args:
        frames: linear images of one channel.
        numbers: the phase frames, in any order.
        periods_px: of each of them; one has three or more frames of different shifts.
        shifts: of each of them in turns (step / steps).
        black: frame of the ambient light, or None.
        extent: projector pixels along the axis.
        response: the projector's light at even levels from 0 to 1, rising; None: linear.
        wave_error_px: error of the place beyond noise, added to its deviation.

    Raises:
        ArrayError: no period has three shifts, or none has fewer frames than that; two places of the projector look alike.
    """
    periods = np.array(periods_px, dtype=np.float64)
    if not len(numbers) == len(periods) == len(shifts) or not extent > 0:
        raise ArrayError(f"there are {len(numbers)} frames, {len(periods)} periods, {len(shifts)} shifts and {extent:g} px: give one "
                         "of each for every frame, and a width above 0")
    full = [period for period in dict.fromkeys(periods) if len({s % 1.0 for s, p in zip(shifts, periods, strict=True) if p == period}) >= 3]
    if not full:
        raise ArrayError("no period has three shifts: micro phase shifting needs one that has, to know offset and amplitude")
    reference = full[0]
    member = periods == reference
    if member.all():
        raise ArrayError(f"all frames have the period {reference:g} px: give frames of other periods near it")
    start = decode_phase(frames, [n for n, m in zip(numbers, member, strict=True) if m], periods[member],
                         np.array(shifts)[member].tolist(), black=black, response=response, noise=noise)
    require_frames(frames, *numbers, black)
    others, device, pack = np.flatnonzero(~member), frames.device, devices.pack_width(frames.device)
    ratio = reference / periods[others]
    wraps = np.arange(-1, int(np.ceil(extent / reference)) + 1)
    _require_unlike(periods, reference, others, extent)
    turns = 2 * np.pi * np.outer(wraps, ratio)
    order = np.concatenate([others, np.flatnonzero(member)])
    table = np.stack([1 / periods[order], np.array(shifts)[order]], axis=1)
    free = len(order) - 3
    usual = free + SELDOM * np.sqrt(2 * free)
    result = unwritten_decoded(frames.pixel_count, frames.device)
    scratch = wp.empty((2 * len(others), frames.packs * pack), dtype=wp.float32, device=device)
    inputs = [as_packs(array, device) for array in (start.phase, start.amplitude, start.offset, start.status)]
    devices.launch(_micro_kernel(pack, response is not None), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, list(numbers)), *inputs,
                    wp.array(np.array(numbers)[order], dtype=wp.int32, device=device), wp.array(table, dtype=wp.vec2, device=device),
                    wp.array(light_table(response), dtype=wp.float32, device=device),
                    wp.array(np.stack([np.cos(turns), np.sin(turns)], axis=-1), dtype=wp.vec2, device=device),
                    float(reference), float(member.sum()), float(extent), float(free), usual, wave_error_px**2, noise.read**2, noise.gain],
                   [as_packs(array, device) for array in (scratch, *result)], device=device)
    return result


def _require_unlike(periods: np.ndarray, reference: float, others: np.ndarray, extent: float) -> None:
    """Refuse periods whose single readings are the same at two places that show one reference phase."""
    offsets = np.arange(1, int(np.ceil(extent / reference))) * reference
    at = np.linspace(0, extent, 256, endpoint=False)[:, None, None]
    here, there = (np.cos(2 * np.pi * (at + offset) / periods[others]) for offset in (0.0, offsets[:, None]))
    apart = np.where(at[..., 0] + offsets < extent, np.linalg.norm(here - there, axis=-1), np.inf)
    if offsets.size and apart.min() < MIN_SEPARATION:
        covered = offsets[int(np.argmin(apart.min(axis=0)))]
        listed = ", ".join(f"{period:g}" for period in dict.fromkeys(periods))
        raise ArrayError(f"frames of {listed} px show two places {covered:g} px apart alike, the projector has {extent:g}: "
                         "add a period, or choose other ones")


@wp.func
def cosine_at(light: wp.array(dtype=float), x: float) -> float:
    """Return what a linear projector makes of the cosine x."""
    return x


@wp.func
def cosine_slope(light: wp.array(dtype=float), x: float) -> float:
    """Return its slope."""
    return 1.0


@wp.func
def bent_at(light: wp.array(dtype=float), x: float) -> float:
    """Return what a response makes of the cosine x, -1…1."""
    return 2.0 * light_between(light, 0.5 + 0.5 * x) - 1.0


@wp.func
def bent_slope(light: wp.array(dtype=float), x: float) -> float:
    """Return its slope."""
    return light_slope(light, 0.5 + 0.5 * x)


@once
def _micro_kernel(pack: int, bent: bool = False) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of = cut_in(pack)
    wave_at, wave_slope = (bent_at, bent_slope) if bent else (cosine_at, cosine_slope)

    @wp.kernel(enable_backward=False, module="unique")
    def micro_kernel(first: int,
                     values: wp.array2d(dtype=float_pack),  # [F, P]
                     saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                     masks: wp.array(dtype=int),  # [F / 8]
                     phase: wp.array2d(dtype=float_pack),  # [1, P] of the reference, radians
                     amplitude: wp.array2d(dtype=float_pack),  # [1, P]
                     offset: wp.array2d(dtype=float_pack),  # [1, P]
                     state: wp.array2d(dtype=byte_pack),  # [1, P]
                     order: wp.array(dtype=int),  # [N] frames, those of the reference last
                     table: wp.array(dtype=wp.vec2),  # [N] 1 / period, shift in turns
                     light: wp.array(dtype=float),  # [LIGHT_STEPS + 1] at even levels
                     step: wp.array2d(dtype=wp.vec2),  # [wraps, others] cos, sin of what a wrap adds to the angle
                     period: float,
                     shifts: float,  # frames of the reference
                     extent: float,
                     free: float,  # readings more than unknowns
                     usual: float,  # sum of squares, in its variance, that noise seldom exceeds
                     wave_variance: float,
                     read_variance: float,
                     gain: float,
                     # outputs
                     turned: wp.array2d(dtype=float_pack),  # [2 · others, P] scratch: cos, sin at wrap 0
                     coordinate: wp.array(dtype=float_pack),
                     sigma: wp.array(dtype=float_pack),
                     signal: wp.array(dtype=float_pack),
                     status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut = cut_of(saturated, masks, p)
        angle = phase[0, p]
        swing = amplitude[0, p]
        mean = offset[0, p]
        given = state[0, p]
        others = step.shape[1]
        for f in range(others):
            cosine, sine = float_pack(), float_pack()
            for k in range(pack):
                t = angle[k] * wp.static(1.0 / TURN) * period * table[f][0] - table[f][1]
                cosine[k] = cosine_of_turns(t)
                sine[k] = sine_of_turns(t)
            turned[2 * f, p] = cosine
            turned[2 * f + 1, p] = sine

        # every wrap of the reference, and how well the other frames fit there
        best, second, place, trust, known = float_pack(EMPTY_CHI2), float_pack(EMPTY_CHI2), float_pack(), float_pack(), float_pack()
        for k in range(pack):
            trust[k] = 1.0 / (2.0 * (read_variance + gain * wp.max(mean[k], 0.0)) + wp.static(LEVEL_ERROR**2) * swing[k] * swing[k])
            slope_reference = swing[k] * TURN / period
            known[k] = 0.5 * shifts * slope_reference * slope_reference + 1.0e-20
        for wrap in range(step.shape[0]):
            squares, slopes, stiffness = float_pack(), float_pack(), float_pack()
            for f in range(others):
                cosine = turned[2 * f, p]
                sine = turned[2 * f + 1, p]
                reading = values[order[f], p]
                c, s = step[wrap, f][0], step[wrap, f][1]
                w = TURN * table[f][0]
                for k in range(pack):
                    x = cosine[k] * c - sine[k] * s
                    miss = reading[k] - mean[k] - swing[k] * wave_at(light, x)
                    slope = -w * swing[k] * (sine[k] * c + cosine[k] * s) * wave_slope(light, x)
                    squares[k] = squares[k] + miss * miss
                    slopes[k] = slopes[k] + miss * slope
                    stiffness[k] = stiffness[k] + slope * slope
            for k in range(pack):
                shift = slopes[k] / (stiffness[k] + known[k])
                u = (angle[k] * wp.static(1.0 / TURN) + float(wrap - 1)) * period + shift
                outside = wp.where(wp.abs(u - 0.5 * extent) > 0.5 * extent + BORDER_PX, EMPTY_CHI2, 0.0)
                cost = wp.max(squares[k] - slopes[k] * shift, 0.0) * trust[k] + outside
                keep_better(cost, u, best[k], second[k], place[k])

        # A, B and u from all frames, each by its variance
        information, unexplained = float_pack(), float_pack()
        for _step in range(STEPS):
            aa, ab, au, bb, bu, uu = float_pack(), float_pack(), float_pack(), float_pack(), float_pack(), float_pack()
            ra, rb, ru, squares_left = float_pack(), float_pack(), float_pack(), float_pack()
            for f in range(order.shape[0]):
                reading = values[order[f], p]
                frequency, delta = table[f][0], table[f][1]
                for k in range(pack):
                    t = place[k] * frequency - delta
                    x = cosine_of_turns(t)
                    c = wave_at(light, x)
                    slope = -swing[k] * TURN * frequency * sine_of_turns(t) * wave_slope(light, x)
                    w = 1.0 / (read_variance + gain * wp.max(reading[k], 0.0))
                    miss = reading[k] - mean[k] - swing[k] * c
                    add_reading(miss, w, 1.0, c, slope, aa[k], ab[k], au[k], bb[k], bu[k], uu[k], ra[k], rb[k], ru[k], squares_left[k])
            for k in range(pack):
                # eliminate A, then B
                bb1 = bb[k] - ab[k] * ab[k] / aa[k]
                bu1 = bu[k] - ab[k] * au[k] / aa[k]
                uu1 = uu[k] - au[k] * au[k] / aa[k]
                rb1 = rb[k] - ab[k] * ra[k] / aa[k]
                ru1 = ru[k] - au[k] * ra[k] / aa[k]
                left = uu1 - bu1 * bu1 / bb1
                du = (ru1 - bu1 * rb1 / bb1) / left
                db = (rb1 - bu1 * du) / bb1
                place[k] = place[k] + du
                swing[k] = swing[k] + db
                mean[k] = mean[k] + (ra[k] - ab[k] * db - au[k] * du) / aa[k]
                information[k] = left
                unexplained[k] = squares_left[k]
        u_out, error, height, result = float_pack(), float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            code = int(given[k])
            if cut[k] != 0:
                code = _SATURATED
            elif code == OK:
                code = judge(best[k], second[k])
                if code != _OUT_OF_RANGE and not information[k] > 0.0:  # NaN too
                    code = _MULTIPATH
            if keeps_place(code) and information[k] > 0.0 and place[k] >= -BORDER_PX and place[k] <= extent + BORDER_PX:
                u_out[k] = place[k]
                error[k] = wp.sqrt(wp.where(unexplained[k] > usual, unexplained[k] / free, 1.0) / information[k] + wave_variance)
                height[k] = swing[k]
            result[k] = wp.uint8(code)
        coordinate[p] = u_out
        sigma[p] = error
        signal[p] = height
        status[p] = result

    return micro_kernel
