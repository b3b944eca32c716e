"""k-ary codes: each digit the nearest of k grey levels or colours, after black and white of the same pixel.

A reading under the pattern colour c is black + e(c) · (white - black), channel by channel, with e(c) = (X c) / (X 1) for a projector
and camera whose channels mix by the matrix X: the object's reflectance cancels. Digits are the candidates of least χ². A digit is
in doubt where the second-best is nearly as near (a mixture at an edge, or noise); up to two doubtful digits are tried both ways,
and where that changes the stripe by one at most, as it does at every edge of a reflected code, the middle is the result. Readings that lie
between levels make all digits of the pixel doubtful sooner: the mean misfit of its nearest levels is the scale of its errors. At a carry of
a plain code several digits are mixed at once: where a carry explains the readings better than the nearest levels do, its edge
is the result; where about as well, and it lies elsewhere, the pixel is UNDECIDED.

Sources: Er (reflected k-ary), The Computer Journal 1984; Horn and Kiryati, "Toward optimal structured light patterns", Image and
Vision Computing 1999 (grey levels); Caspi, Kiryati and Shamir, "Range imaging with adaptive color structured light", TPAMI 1998
(crosstalk, equations 1 to 5).
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import Band, as_packs, pack_type, unwritten
from kernels.structured.carries import EMPTY_CHI2, LEVEL_ERROR, NO_EDGE, Code, carry_kernel, weight_of_reading
from kernels.structured.decoded import MAX_SPREAD, Decoded, place_stripe, unwritten_decoded
from kernels.structured.pattern_frames import NoiseModel, check_noise, check_stripes, cut_in, require_frames, saturation_masks

SHADOW_SIGMAS = 5.0
"""Least white minus black, in its standard deviations over all channels; a pixel with less is not reached by the projector."""
DOUBT_CHI2 = 9.0
"""Largest χ² between the best and the second-best level that noise alone explains (three standard deviations)."""
NEAR_CHI2 = 2.0
"""The same for a carry whose edge lies within the reach of the finest digit: a choice that is wrong there is wrong by few stripes."""
DOUBT_RATIO = 0.44
"""Largest ratio of the best level's χ² to the second-best's: above it, the reading lies more than two fifths of the way to the next
level."""
MAX_STRIPES = 1 << 24
"""Largest number of stripes: they are counted in float32 at the end, which is exact up to here."""
MIN_LEVEL_STEP = 1.0e-3
"""Least difference of two levels, as a part of white minus black; closer levels count as equal."""
LARGEST = 1.0e15
"""Signal above which a reading counts as infinite, because the signal is squared in float32."""


def decode_kary(frames: Band, digits: Sequence[int], *, white: int, black: int, levels: np.ndarray, reflected: bool,
                extent: float, stripe_px: float = 1.0, noise: NoiseModel) -> Decoded:
    """Decode a base-k code in grey levels or colours to stripe centres; not synchronised on CUDA.

    SATURATED: a frame of the code is. SHADOWED: white is not above black. UNDECIDED: doubtful digits leave stripes apart. OUT_OF_RANGE: a
    code beyond the projector.

    Args:
        frames: linear images: one channel for levels, three for colours.
        digits: frame of each digit, digit 0 (the finest) first.
        white, black: frames of the projector full on and black.
        levels: [k] grey levels or [k, 3] colours of the digit values as the camera sees them, 0…1, linear light.
        reflected: whether the code is the reflected one.
        extent: projector pixels along the axis.
        stripe_px: width of the finest stripe.

    Raises:
        ArrayError: a frame is missing, does not exist or is given twice; levels that are the same; a value that cannot be.
    """
    check_noise(noise)
    check_stripes(extent, stripe_px)
    expected = expected_levels(levels)
    base, channels = expected.shape
    require_frames(frames, *digits, white, black, channels=channels)
    if not digits or base ** len(digits) * stripe_px < extent:
        raise ArrayError(f"{len(digits)} digits in base {base} number {base ** len(digits) * stripe_px:g} px of stripes of "
                         f"{stripe_px:g} px, the projector has {extent:g}: a digit is missing")
    if base ** len(digits) > MAX_STRIPES:
        raise ArrayError(f"{len(digits)} digits in base {base} number more than {MAX_STRIPES} stripes: give fewer digits")
    device, pack, pixels = frames.device, devices.pack_width(frames.device), frames.pixel_count
    result = unwritten_decoded(pixels, device)
    fitted = [unwritten(pixels, dtype, device) for dtype in (wp.float32, wp.float32, wp.int32)]
    fits = [as_packs(array, device) for array in fitted]
    code = Code()
    code.order, code.expected = wp.array(digits, dtype=wp.int32, device=device), wp.array(expected, dtype=wp.float32, device=device)
    code.white, code.black, code.reflected = white, black, 1 if reflected else 0
    code.read_variance, code.gain = noise.read**2, noise.gain
    devices.launch(carry_kernel(pack, channels), frames.packs, [frames.values, code], fits, device=device)
    devices.launch(_kary_kernel(pack, channels), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, [*digits, white, black]), code, *fits, float(stripe_px),
                    float(extent)], [as_packs(array, device) for array in result], device=device)
    return result


def expected_levels(levels: np.ndarray, crosstalk: np.ndarray | None = None) -> np.ndarray:
    """Return the reading of each digit value, as a part of white minus black, [k, channels] float64.
    `crosstalk`: [3, 3] camera channels from projector channels, for colours; None: each channel sees its own.
    Raises ArrayError: shapes that cannot be, or levels that look the same."""
    given = np.asarray(levels, dtype=np.float64)
    if given.ndim == 1:
        given = given[:, None]
    if given.ndim != 2 or len(given) < 2 or given.shape[1] not in (1, 3) or not np.isfinite(given).all():
        raise ArrayError(f"levels are {np.shape(levels)}: give [k] grey levels or [k, 3] colours, two or more, finite")
    if crosstalk is not None:
        if given.shape[1] != 3 or np.shape(crosstalk) != (3, 3):
            raise ArrayError(f"crosstalk is {np.shape(crosstalk)} for levels {np.shape(levels)}: give [3, 3], and colours")
        mixed = np.asarray(crosstalk, dtype=np.float64)
        if not (mixed.sum(axis=1) > 0).all():
            raise ArrayError("crosstalk has a camera channel that sees no light of the projector: every row must add up to more than 0")
        given = given @ mixed.T / mixed.sum(axis=1)
    for i in range(len(given)):
        for j in range(i):
            if np.abs(given[i] - given[j]).max() < MIN_LEVEL_STEP:
                raise ArrayError(f"digit values {j} and {i} look the same to the camera: give levels that differ")
    return given


@wp.func
def append_digit(digit: int, base: int, reflected: int, number: wp.ref[int], digits: wp.ref[int]):
    """Append the next lower digit to a number; in a reflected code it runs backwards where the sum of the digits before it is odd."""
    number = number * base + digit + reflected * (digits & 1) * (base - 1 - 2 * digit)
    digits += digit


@once
def _kary_kernel(pack: int, channels: Literal[1, 3] = 1) -> Any:
    float_pack, int_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32), pack_type(pack, wp.uint8)
    cut_of, load = cut_in(pack), pack_load(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def kary_kernel(first: int,
                    values: wp.array2d(dtype=float_pack),  # [F · channels, P]
                    saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                    masks: wp.array(dtype=int),  # [F / 8]
                    code: Code,
                    misfit: wp.array(dtype=float_pack),  # [P] of carry_kernel
                    carry_misfit: wp.array(dtype=float_pack),  # [P]
                    edge: wp.array(dtype=int_pack),  # [P]
                    stripe: float,
                    extent: float,
                    # outputs
                    coordinate: wp.array(dtype=float_pack),
                    sigma: wp.array(dtype=float_pack),
                    amplitude: wp.array(dtype=float_pack),
                    status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut = cut_of(saturated, masks, p)
        lit, signal = float_pack(), float_pack()
        for channel in range(channels):
            on = load(values, code.white * channels + channel, p)
            off = load(values, code.black * channels + channel, p)
            for k in range(pack):
                contrast = wp.max(on[k] - off[k], 0.0)
                lit[k] = lit[k] + contrast * contrast / (2.0 * code.read_variance + code.gain * (wp.max(on[k], 0.0) + wp.max(off[k], 0.0)))
                signal[k] = signal[k] + wp.static(0.5 / channels) * contrast

        # the number under every choice of up to two doubtful digits, most significant digit first
        base = code.expected.shape[0]
        doubts = int_pack()
        poor = misfit[p]
        carried = carry_misfit[p]
        carry = edge[p]
        scale = float_pack()
        for k in range(pack):
            scale[k] = wp.max(wp.min(poor[k], carried[k]) / float(code.order.shape[0] * channels), 1.0)
        code0, code1, code2, code3 = int_pack(), int_pack(), int_pack(), int_pack()
        sum0, sum1, sum2, sum3 = int_pack(), int_pack(), int_pack(), int_pack()
        for back in range(code.order.shape[0]):
            frame = code.order[code.order.shape[0] - 1 - back]
            best, second, nearest, next_nearest = float_pack(EMPTY_CHI2), float_pack(EMPTY_CHI2), int_pack(), int_pack()
            for digit in range(base):
                cost = float_pack()
                for channel in range(channels):
                    on = load(values, code.white * channels + channel, p)
                    off = load(values, code.black * channels + channel, p)
                    reading = load(values, frame * channels + channel, p)
                    level = code.expected[digit, channel]
                    for k in range(pack):
                        miss = reading[k] - off[k] - level * wp.max(on[k] - off[k], 0.0)
                        cost[k] = cost[k] + miss * miss * weight_of_reading(on[k], off[k], reading[k], LEVEL_ERROR, code)
                for k in range(pack):
                    first_is = wp.where(cost[k] < best[k], 1, 0)
                    second_is = (1 - first_is) * wp.where(cost[k] < second[k], 1, 0)
                    next_nearest[k] = first_is * nearest[k] + second_is * digit + (1 - first_is - second_is) * next_nearest[k]
                    nearest[k] = nearest[k] + first_is * (digit - nearest[k])
                    second[k] = wp.min(second[k], wp.max(cost[k], best[k]))
                    best[k] = wp.min(cost[k], best[k])
            for k in range(pack):
                sure = wp.where(second[k] - best[k] > DOUBT_CHI2 * scale[k], 1, 0) * wp.where(best[k] < DOUBT_RATIO * second[k], 1, 0)
                other = next_nearest[k] - nearest[k]
                one = (1 - sure) * wp.where(doubts[k] == 0, 1, 0)
                two = (1 - sure) * wp.where(doubts[k] == 1, 1, 0)
                doubts[k] = doubts[k] + 1 - sure
                d0 = nearest[k]
                d1 = nearest[k] + one * other
                d2 = nearest[k] + two * other
                d3 = nearest[k] + (one + two) * other
                append_digit(d0, base, code.reflected, code0[k], sum0[k])
                append_digit(d1, base, code.reflected, code1[k], sum1[k])
                append_digit(d2, base, code.reflected, code2[k], sum2[k])
                append_digit(d3, base, code.reflected, code3[k], sum3[k])
        u, error, result = float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            reached = lit[k] >= wp.static(SHADOW_SIGMAS**2) and signal[k] < LARGEST  # False for NaN too
            least = wp.min(wp.min(code0[k], code1[k]), wp.min(code2[k], code3[k]))
            most = wp.max(wp.max(code0[k], code1[k]), wp.max(code2[k], code3[k]))
            settled = doubts[k] <= 2
            reach = wp.where(code.reflected == 1, MAX_SPREAD, base)  # a plain code's next digit is at most so far
            if carry[k] != NO_EDGE:
                away = wp.max(wp.abs(carry[k] - code0[k]), wp.abs(carry[k] - 1 - code0[k]))
                margin = wp.where(away > reach, DOUBT_CHI2, NEAR_CHI2) * scale[k]
                if carried[k] + margin < poor[k]:
                    settled = True
                    least = carry[k] - 1
                    most = carry[k]
                elif carried[k] < poor[k] + margin:
                    least = wp.min(least, carry[k] - 1)
                    most = wp.max(most, carry[k])
            loose = wp.min(wp.static(DOUBT_CHI2) / wp.sqrt(wp.max(lit[k], 1.0)), 1.0)
            outcome, place, deviation = place_stripe(cut[k], reached, settled, False, wp.clamp(code0[k], least, most), least, most, most, 1,
                                                  reach, loose, most - least + 1, stripe, extent)
            u[k] = place
            error[k] = deviation
            signal[k] = wp.where(deviation > 0.0, signal[k], 0.0)
            result[k] = wp.uint8(outcome)
        coordinate[p] = u
        sigma[p] = error
        amplitude[p] = signal
        status[p] = result

    return kary_kernel
