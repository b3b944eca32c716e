"""Binary, Gray and XOR codes: a threshold per pixel and bit, doubtful bits resolved or refused.

A bit is the sign of d = I - Ī (with inverses) or d = I - (white + black)/2. It is in doubt where |d| is under DOUBT_SIGMAS of its
own noise or DOUBT_PART of the contrast: at edges, and where stripes are finer than camera or projector resolve. Up to two
doubtful bits are tried both ways; where all readings lie within MAX_SPREAD + 1 neighbouring stripes (at an edge of a Gray code
always: there one bit changes) their middle is the result, with the deviation of the whole range; otherwise the pixel is UNDECIDED.
At an edge of a plain binary code a bit and all finer ones change (a carry): where these and no other are faint, that edge is the place.
Where they are among the FINE_BITS finest, they may as well be too fine to be seen, and the deviation is that of all stripes they number.
Up to MAX_OPEN of the finest bits of a Gray code may be in doubt besides: the stripes that they tell apart are then one wide stripe.

Light that reaches the pixel by other ways (fog, bounces, light below the surface) follows wide stripes as direct light does, and narrow
ones hardly. So two neighbouring ones of the FINE_BITS finest bits measure the direct part D of the contrast C (the clearer pair: blur
dims the finest), and a coarser bit is proven where |d| > C - 2 D: other light, C - D at most, could not have turned it. Where more
than two bits are not proven, the pixel is MULTIPATH.

Sources: Posdamer and Altschuler, CGIP 1982 (binary); Inokuchi, Sato and Matsuda, ICPR 1984 (Gray); Gupta, Agrawal,
Veeraraghavan and Narasimhan, CVPR 2011, section 4 (XOR); Xu and Aliaga, "Robust pixel classification for 3D modeling with structured
light", Graphics Interface 2007 (bits that direct light proves).
"""

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type
from kernels.structured.decoded import MAX_SPREAD, Decoded, place_stripe, unwritten_decoded
from kernels.structured.pattern_frames import NoiseModel, check_noise, check_stripes, cut_in, require_frames, saturation_masks

SHADOW_SIGMAS = 5.0
"""Least contrast (white minus black, or the largest difference of a pair), in its standard deviations; a pixel with less is not reached by
the projector."""
DOUBT_SIGMAS = 3.0
"""Least difference, in its standard deviations, of a bit that is certain: at the limit, noise alone makes one pixel in 740 wrong."""
DOUBT_PART = 0.05
"""Least difference of a bit that is certain, as a part of the contrast: a smaller one is a mixture of two stripes, whose sign blur rather
than noise decides."""
MAX_OPEN = 2
"""Number of the finest bits that may be in doubt without the pixel being refused: a camera that resolves stripes a quarter as fine as those
that are shown sees no more."""
FAINT_PART = 0.25
"""Difference below which a bit may change at the place of a pixel, as a part of the contrast: finer bits of a carry are dimmer by blur."""
FAINT_LIMITS = 2.0
"""The same in limits of doubt, where noise is larger."""
CARRY_SIGMAS = DOUBT_SIGMAS * (FAINT_LIMITS + 1)
"""Least difference of a bit that shows all light, in its standard deviations, with which a carry is read: below it noise makes bits faint
that do not change, and all of them together are the carry in the middle of the projector. Without inverses a bit shows half of the light
with three quarters of the variance."""
FINE_BITS = 3
"""Number of the finest bits that tell direct light."""
MUCH_STRAY = 0.5
"""Largest part of the contrast, minus twice the direct light, with which all bits of XOR and binary codes count: a quarter is direct."""
LARGEST = 1.0e15
"""Contrast above which a reading counts as infinite, because contrast is squared in float32."""
MAX_BITS = 24
"""Largest number of bits: stripes are counted in float32 at the end, which is exact up to 2²⁴."""


def decode_binary(frames: Band, bits: Sequence[int], inverses: Sequence[int] | None = None, *, white: int | None = None,
                  black: int | None = None, extent: float, stripe_px: float = 1.0, noise: NoiseModel) -> Decoded:
    """Decode a plain binary code to stripe centres; not synchronised on CUDA.

    SATURATED: a frame that decides a bit is. SHADOWED: the contrast is not above noise. UNDECIDED: doubtful bits leave stripes far apart.
    MULTIPATH: light of other ways may have decided them. OUT_OF_RANGE: a code beyond the projector.

    Args:
        frames: linear images of one channel.
        bits: frame of each bit, bit 0 (the finest) first.
        inverses: frame of each inverse in the same order, or None; then white and black are needed.
        white, black: frames of the projector full on and black.
        extent: projector pixels along the axis.
        stripe_px: width of the finest stripe.

    Raises:
        ArrayError: a frame is missing, does not exist or is given twice; a value that cannot be.
    """
    return _decode(_stripe_kernel, "binary", frames, bits, inverses, white, black, extent, stripe_px, noise, 0)


def decode_gray(frames: Band, bits: Sequence[int], inverses: Sequence[int] | None = None, *, white: int | None = None,
                black: int | None = None, extent: float, stripe_px: float = 1.0, noise: NoiseModel) -> Decoded:
    """Decode a Gray code: as decode_binary; at an edge one bit changes, so edges are decoded too."""
    return _decode(_stripe_kernel, "gray", frames, bits, inverses, white, black, extent, stripe_px, noise, 0)


def decode_xor(frames: Band, bits: Sequence[int], inverses: Sequence[int] | None = None, *, base_bit: int = 0,
               white: int | None = None, black: int | None = None, extent: float, stripe_px: float = 1.0,
               noise: NoiseModel) -> Decoded:
    """Decode an XOR code: as decode_gray, after the bits above base_bit are freed of it.

    Bits are decided before they are combined, so light that other surfaces add to a frame and to its inverse alike, as it does
    where all stripes are narrow, decides none.
    """
    if not 0 <= base_bit < len(bits):
        raise ArrayError(f"base bit {base_bit} does not exist in {len(bits)} bits (0 to {len(bits) - 1})")
    return _decode(_stripe_kernel, "xor", frames, bits, inverses, white, black, extent, stripe_px, noise, base_bit)


def _decode(make: Any, code: str, frames: Band, bits: Sequence[int], inverses: Sequence[int] | None, white: int | None,
            black: int | None, extent: float, stripe_px: float, noise: NoiseModel, base_bit: int) -> Decoded:
    check_noise(noise)
    check_stripes(extent, stripe_px)
    require_frames(frames, *bits, *(inverses or ()), white, black)
    if not 1 <= len(bits) <= MAX_BITS:
        raise ArrayError(f"the code has {len(bits)} bits: give 1 to {MAX_BITS}")
    if 2.0 ** len(bits) * stripe_px < extent:
        raise ArrayError(f"{len(bits)} bits of {stripe_px:g} px stripes number {2 ** len(bits) * stripe_px:g} px, the projector has "
                         f"{extent:g}: a bit is missing")
    if inverses is not None and len(inverses) != len(bits):
        raise ArrayError(f"there are {len(bits)} bits and {len(inverses)} inverses: give one for each, or none")
    references = white is not None and black is not None
    if inverses is None and not references:
        raise ArrayError("there are neither inverses nor white and black: a bit needs one of the two as its threshold")
    result = unwritten_decoded(frames.pixel_count, frames.device)
    rows = np.stack([bits, bits if inverses is None else inverses], axis=1).astype(np.int32)
    used = [*bits, *inverses] if inverses is not None else [*bits, white, black]
    kernel = make(devices.pack_width(frames.device), code, inverses is not None, references)
    devices.launch(kernel, frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, used), wp.array(rows, dtype=wp.int32, device=frames.device),
                    white if references else 0, black if references else 0, noise.read**2, noise.gain, float(stripe_px), float(extent),
                    int(base_bit), (1 << len(bits)) - (2 << base_bit),
                    min(MAX_OPEN, {"binary": 0, "gray": len(bits) - 1, "xor": base_bit}[code])],
                   [as_packs(array, frames.device) for array in result], device=frames.device)
    return result


@wp.func
def gray_to_binary(gray: int) -> int:
    """Return the number whose reflected binary (Gray) code is given; up to 32 bits."""
    code = gray ^ (gray >> 1)
    code = code ^ (code >> 2)
    code = code ^ (code >> 4)
    code = code ^ (code >> 8)
    return code ^ (code >> 16)


@wp.func
def number_binary(shown: int, base_bit: int, above: int) -> int:
    """Return the stripe whose plain binary code is given."""
    return shown


@wp.func
def number_gray(shown: int, base_bit: int, above: int) -> int:
    """Return the stripe whose Gray code is given."""
    return gray_to_binary(shown)


@wp.func
def number_xor(shown: int, base_bit: int, above: int) -> int:
    """Return the stripe whose XOR code is given: a Gray code whose bits in `above` are combined with bit `base_bit`."""
    return gray_to_binary(shown ^ (above & (-((shown >> base_bit) & 1))))


@wp.func
def proven_gray(d: float, stray: float, finest: float, contrast: float, limit: float) -> bool:
    """Return whether other light, `stray` at most, cannot have turned a bit whose difference is d."""
    return d >= stray


@wp.func
def proven_binary(d: float, stray: float, finest: float, contrast: float, limit: float) -> bool:
    """Return the same for plain binary code: at a carry all bits that change are as faint as the finest, whose difference is given, and the
    others hold all light, to the limit of doubt, whose square is given."""
    off = d - finest
    return d + wp.sqrt(limit) >= stray or stray < MUCH_STRAY * contrast or off * off < 4.0 * wp.max(limit, 0.01 * contrast * contrast)


@wp.func
def proven_xor(d: float, stray: float, finest: float, contrast: float, limit: float) -> bool:
    """Return the same for XOR code: other light hardly follows its stripes, which are all narrow, unless nearly all is other light."""
    return stray < MUCH_STRAY * contrast


@wp.func
def carry_of(doubt: int, open: int, faint: int) -> int:
    """Return the faint bits of a plain binary code if they are those that change at a carry, one and all finer ones; else 0."""
    carries = faint >= 3 and (faint & (faint + 1)) == 0 and doubt != 0 and ((doubt | open) & ~faint) == 0
    return wp.where(carries, faint, 0)


_NUMBERS = {"binary": (number_binary, proven_binary), "gray": (number_gray, proven_gray), "xor": (number_xor, proven_xor)}


@once
def _stripe_kernel(pack: int, code: Literal["binary", "gray", "xor"] = "gray", inverses: bool = True, references: bool = True) -> Any:
    float_pack, int_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.int32), pack_type(pack, wp.uint8)
    number_of, proven = _NUMBERS[code]
    narrow, plain = code == "xor", code == "binary"
    first_open = 0 if narrow else FINE_BITS - 1  # finer bits show direct light
    cut_of = cut_in(pack)

    @wp.kernel(enable_backward=False, module="unique")
    def stripe_kernel(first: int,
                      values: wp.array2d(dtype=float_pack),  # [F, P]
                      saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                      masks: wp.array(dtype=int),  # [F / 8] of the frames that decide bits
                      rows: wp.array2d(dtype=int),  # [bits, 2] frame, inverse
                      white: int,
                      black: int,
                      read_variance: float,
                      gain: float,
                      stripe: float,
                      extent: float,
                      base_bit: int,
                      above: int,  # mask of the bits that it lies over
                      free: int,  # number of the finest bits that may stay open
                      # outputs
                      coordinate: wp.array(dtype=float_pack),
                      sigma: wp.array(dtype=float_pack),
                      amplitude: wp.array(dtype=float_pack),
                      status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut = cut_of(saturated, masks, p)
        contrast, spread, middle = float_pack(), float_pack(), float_pack()
        if wp.static(references):
            on = values[white, p]
            off = values[black, p]
            for k in range(pack):
                contrast[k] = on[k] - off[k]
                middle[k] = 0.5 * (on[k] + off[k])
                spread[k] = 2.0 * read_variance + gain * (wp.max(on[k], 0.0) + wp.max(off[k], 0.0))
        else:
            for bit in range(rows.shape[0]):
                one = values[rows[bit, 0], p]
                other = values[rows[bit, 1], p]
                for k in range(pack):
                    contrast[k] = wp.max(contrast[k], wp.abs(one[k] - other[k]))
                    spread[k] = 2.0 * read_variance + gain * wp.max(one[k] + other[k], 0.0)
        # the light that may have come by other ways: all but twice the direct light, which the finest bits show
        stray, finest, before = float_pack(), float_pack(), float_pack()
        for bit in range(wp.where(wp.static(narrow), rows.shape[0], wp.min(rows.shape[0], FINE_BITS))):
            one = values[rows[bit, 0], p]
            other = values[rows[bit, 1], p]
            for k in range(pack):
                d = wp.abs(one[k] - other[k])
                if wp.static(not inverses):
                    d = 2.0 * wp.abs(one[k] - middle[k])
                finest[k] = wp.where(bit == 0, d, finest[k])
                pair = wp.where(bit == 0, wp.where(rows.shape[0] == 1, d, 0.0), 0.5 * (before[k] + d))
                stray[k] = wp.max(stray[k], wp.where(wp.static(narrow), d, pair))
                before[k] = d
        for k in range(pack):
            stray[k] = wp.max(contrast[k] - 2.0 * stray[k], 0.0)
        noise_part = wp.static(2.0 * DOUBT_SIGMAS**2) * read_variance
        gain_part = wp.static(DOUBT_SIGMAS**2) * gain
        shown, doubt, open, faint = int_pack(), int_pack(), int_pack(), int_pack()
        for bit in range(rows.shape[0]):
            flag = 1 << bit
            one = values[rows[bit, 0], p]
            if wp.static(inverses):
                other = values[rows[bit, 1], p]
                for k in range(pack):
                    d = one[k] - other[k]
                    part = wp.static(DOUBT_PART) * contrast[k]
                    limit = wp.max(noise_part + gain_part * wp.max(one[k] + other[k], 0.0), part * part)
                    shown[k] = shown[k] + wp.where(d > 0.0, flag, 0)
                    doubt[k] = doubt[k] + wp.where(d * d >= limit, 0, flag)
                    sure = bit < wp.static(first_open) or proven(wp.abs(d), stray[k], finest[k], contrast[k], limit)
                    open[k] = open[k] + wp.where(sure, 0, flag)
                    if wp.static(plain):
                        part = wp.static(FAINT_PART) * contrast[k]
                        faint[k] = faint[k] + wp.where(d * d >= wp.max(wp.static(FAINT_LIMITS**2) * limit, part * part), 0, flag)
            else:
                for k in range(pack):
                    d = one[k] - middle[k]
                    variance = read_variance + gain * wp.max(one[k], 0.0) + 0.25 * spread[k]
                    part = wp.static(0.5 * DOUBT_PART) * contrast[k]
                    limit = wp.max(wp.static(DOUBT_SIGMAS**2) * variance, part * part)
                    shown[k] = shown[k] + wp.where(d > 0.0, flag, 0)
                    doubt[k] = doubt[k] + wp.where(d * d >= limit, 0, flag)
                    sure = bit < wp.static(first_open) or proven(2.0 * wp.abs(d), stray[k], finest[k], contrast[k], 4.0 * limit)
                    open[k] = open[k] + wp.where(sure, 0, flag)
                    if wp.static(plain):
                        part = wp.static(0.5 * FAINT_PART) * contrast[k]
                        faint[k] = faint[k] + wp.where(d * d >= wp.max(wp.static(FAINT_LIMITS**2) * limit, part * part), 0, flag)
        u, error, signal, result = float_pack(), float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            carry = int(0)  # noqa: RUF046 - declares a variable that a branch may change
            if wp.static(plain):
                clear = contrast[k] * contrast[k] >= wp.static(CARRY_SIGMAS**2 * (1.0 if inverses else 3.0)) * spread[k]
                carry = wp.where(clear, carry_of(doubt[k], open[k], faint[k]), 0)
            edge = shown[k] - (shown[k] & carry) + ((carry + 1) >> 1)  # the stripe after it
            doubtful = (doubt[k] | open[k]) & ~carry
            left = int(0)  # noqa: RUF046 - declares a variable that a Warp loop may change
            for bit in range(free):
                left = left + wp.where(left == bit, (doubtful >> bit) & 1, 0)
            if carry < wp.static(1 << FINE_BITS):
                for bit in range(wp.static(FINE_BITS)):
                    left = left + ((carry >> bit) & 1)
            above_left = (doubtful >> left) << left
            low = above_left & (-above_left)
            rest = above_left & (above_left - 1)
            second = rest & (-rest)
            more = (open[k] >> left) << left
            more = more & (more - 1)
            read = number_of(shown[k], base_bit, above)
            least, most = int(read), int(read)
            for bit in range(rows.shape[0]):
                turned = number_of(shown[k] ^ (doubtful & (1 << bit)), base_bit, above)
                least = wp.min(least, turned)
                most = wp.max(most, turned)
            lit = contrast[k] > 0.0 and contrast[k] < LARGEST and (  # False for NaN too
                contrast[k] * contrast[k] >= wp.static(SHADOW_SIGMAS**2) * spread[k])
            loose = wp.min(wp.max(wp.static(DOUBT_SIGMAS) * wp.sqrt(spread[k]), stray[k]) / wp.max(contrast[k], 1.0e-20), 1.0)
            code, place, deviation = place_stripe(
                cut[k], lit, (rest & (rest - 1)) == 0, (more & (more - 1)) != 0, wp.where(carry > 0, edge - 1, read) >> left,
                wp.where(carry > 0, edge, number_of(shown[k] ^ low, base_bit, above)) >> left,
                wp.where(carry > 0, edge, number_of(shown[k] ^ second, base_bit, above)) >> left,
                wp.where(carry > 0, edge, number_of(shown[k] ^ low ^ second, base_bit, above)) >> left, 1 << left, MAX_SPREAD, loose,
                most - least + 1, stripe, extent)
            u[k] = place
            error[k] = deviation
            signal[k] = wp.where(deviation > 0.0, 0.5 * contrast[k], 0.0)
            result[k] = wp.uint8(code)
        coordinate[p] = u
        sigma[p] = error
        amplitude[p] = signal
        status[p] = result

    return stripe_kernel
