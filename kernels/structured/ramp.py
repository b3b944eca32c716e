"""Intensity ratio: the coordinate from how bright a ramp is, reflectance and ambient light cancelled by a second frame.

With ambient light b subtracted, q = up / (up + down), or up / white, or 1 - the part of a falling ramp; the projector's response g
(light at a level) makes q a rising function of x = u / extent, which is inverted by bisection in a table of it.

Source: Carrihill and Hummel, "Experiments with the intensity ratio depth sensor", CVGIP 1985.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type
from kernels.status import OK, Status
from kernels.structured.decoded import Decoded, unwritten_decoded
from kernels.structured.pattern_frames import NoiseModel, check_noise, cut_in, require_frames, saturation_masks
from kernels.structured.response import light_of

SHADOW_SIGMAS = 5.0
"""Least light of the projector in its standard deviations; a pixel with less is SHADOWED."""
LARGEST = 1.0e15
"""Light above which a reading counts as infinite."""
BORDER_SIGMAS = 4.0
"""Standard deviations by which a place may lie outside the projector."""
HALVINGS = 12
"""Number of halvings that search the table of 4096 steps; between two of them a response as bent as level^2.2 is straight to 1e-7 of full
scale."""
TABLE = 2**HALVINGS
"""Number of steps in the table."""
MIN_STEP = 1.0e-12
"""Least rise of the ratio between two places of the table, so that its slope can be divided by."""

_SATURATED, _SHADOWED, _OUT_OF_RANGE = int(Status.SATURATED), int(Status.SHADOWED), int(Status.OUT_OF_RANGE)


def decode_ramp(frames: Band, *, up: int | None = None, down: int | None = None, white: int | None = None,
                black: int | None = None, extent: float, response: np.ndarray | None = None, noise: NoiseModel) -> Decoded:
    """Decode the coordinate from two of a rising ramp, a falling ramp and white; not synchronised on CUDA.

    The amplitude is half of the light. SATURATED: a frame that is used is. SHADOWED: the light is not above noise. OUT_OF_RANGE: outside
    the projector by more than the noise explains.

    Args:
        frames: linear images of one channel.
        up, down, white: frames; both ramps, or one and white. With both ramps white is not used.
        black: frame of the ambient light; None: the images hold none.
        extent: projector pixels along the axis.
        response: [n] the projector's light at n even levels from 0 to 1, rising; None: linear.

    Raises:
        ArrayError: too few frames, a frame that does not exist or is given twice, a response that does not rise.
    """
    check_noise(noise)
    if not extent > 0:
        raise ArrayError(f"the projector has {extent:g} px: give more than 0")
    pair = up is not None and down is not None
    ramp, other = (up, down) if pair else (up if up is not None else down, white)
    if ramp is None or other is None:
        raise ArrayError("the ratio needs a rising and a falling ramp, or one of them and white: a frame is missing")
    require_frames(frames, ramp, other, black)
    table = ratio_table(response, pair=pair)
    result = unwritten_decoded(frames.pixel_count, frames.device)
    devices.launch(_ramp_kernel(devices.pack_width(frames.device), pair, black is not None), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, [ramp, other, black]), ramp, other, black or 0,
                    wp.array(table, dtype=wp.float32, device=frames.device), 0 if pair or up is not None else 1,
                    noise.read**2, noise.gain, float(extent)],
                   [as_packs(array, frames.device) for array in result], device=frames.device)
    return result


def ratio_table(response: np.ndarray | None, *, pair: bool) -> np.ndarray:
    """Return the ratio at TABLE + 1 even places of a rising ramp, from 0 to 1."""
    light = light_of(response, np.linspace(0, 1, TABLE + 1))
    return light / (light + light[::-1]) if pair else light


@once
def _ramp_kernel(pack: int, pair: bool = True, ambient: bool = True) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of = cut_in(pack)

    @wp.kernel(enable_backward=False, module="unique")
    def ramp_kernel(first: int,
                    values: wp.array2d(dtype=float_pack),  # [F, P]
                    saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                    masks: wp.array(dtype=int),  # [F / 8]
                    ramp: int,
                    other: int,
                    black: int,
                    table: wp.array(dtype=float),  # [TABLE + 1] ratio at a place
                    falling: int,
                    read_variance: float,
                    gain: float,
                    extent: float,
                    # outputs
                    coordinate: wp.array(dtype=float_pack),
                    sigma: wp.array(dtype=float_pack),
                    amplitude: wp.array(dtype=float_pack),
                    status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut = cut_of(saturated, masks, p)
        dark, dark_variance = float_pack(), float_pack()
        if wp.static(ambient):
            dark = values[black, p]
            for k in range(pack):
                dark_variance[k] = read_variance + gain * wp.max(dark[k], 0.0)
        one = values[ramp, p]
        two = values[other, p]
        u, error, signal, result = float_pack(), float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            lit = one[k] - dark[k]
            one_variance = read_variance + gain * wp.max(one[k], 0.0)
            two_variance = read_variance + gain * wp.max(two[k], 0.0)
            if wp.static(pair):
                whole = lit + two[k] - dark[k]
                whole_variance = one_variance + two_variance + 4.0 * dark_variance[k]
                q = lit / whole
                rest = 1.0 - q
                variance = rest * rest * one_variance + q * q * two_variance + (q - rest) * (q - rest) * dark_variance[k]
            else:
                whole = two[k] - dark[k]
                whole_variance = two_variance + dark_variance[k]
                q = lit / whole
                variance = one_variance + q * q * two_variance + (1.0 - q) * (1.0 - q) * dark_variance[k]
            if cut[k] != 0:
                result[k] = wp.uint8(_SATURATED)
            elif not (whole > wp.static(SHADOW_SIGMAS) * wp.sqrt(whole_variance) and whole < LARGEST and q > -1.0 and q < 2.0):  # NaN too
                result[k] = wp.uint8(_SHADOWED)
            else:
                cell = int(0)  # noqa: RUF046 - declares a variable that a Warp loop may change
                for halving in range(HALVINGS):
                    middle = cell + (wp.static(TABLE) >> (halving + 1))
                    cell = wp.where(table[middle] <= q, middle, cell)
                slope = wp.max(table[cell + 1] - table[cell], MIN_STEP) * wp.static(float(TABLE))  # of the ratio over the width
                x = float(cell) * wp.static(1.0 / TABLE) + (q - table[cell]) / slope
                place = extent * (x + float(falling) * (1.0 - 2.0 * x))
                deviation = extent * wp.sqrt(variance) / (whole * slope)
                if wp.abs(place - 0.5 * extent) > 0.5 * extent + wp.static(BORDER_SIGMAS) * deviation:
                    result[k] = wp.uint8(_OUT_OF_RANGE)
                else:
                    result[k] = wp.uint8(OK)
                    u[k] = place
                    error[k] = deviation
                    signal[k] = 0.5 * whole
        coordinate[p] = u
        sigma[p] = error
        amplitude[p] = signal
        status[p] = result

    return ramp_kernel
