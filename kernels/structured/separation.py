"""Direct and global light, from frames under a pattern that is finer than what bounces and scatters.

Half of the projector on in fine detail: a pixel's own light comes and goes, all other light stays at half of its full value. So
L+ = direct + global / 2 where it is lit, L- = global / 2 where not; with a projector whose black still gives the part `leak` of
white, L+ = D + (1 + leak) G / 2 and L- = leak · D + (1 + leak) G / 2.

Source: Nayar, Krishnan, Grossberg and Raskar, "Fast separation of direct and global components of a scene using high frequency
illumination", TOG 2006, equations 2 to 5; sinusoids: section 4.3.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, unwritten, zeros
from kernels.status import OK, Status
from kernels.structured.frames import cut_in, require_frames, saturation_masks
from kernels.structured.phase import WrappedPhase

_SATURATED = int(Status.SATURATED)


class Separation(NamedTuple):
    """Both parts of the light under the projector full on; pixels are padded to whole packs."""

    direct: wp.array  # [pixels] float32, in the unit of the images
    indirect: wp.array  # [pixels] float32, the global part; noise may take it below 0
    status: wp.array  # [pixels] uint8: OK, SATURATED, or that of the phase


def separate_extremes(frames: Band, numbers: Sequence[int], *, black: int | None = None, leak: float = 0.0) -> Separation:
    """From the brightest and the darkest reading under a shifted fine pattern (a checkerboard, stripes, sinusoids).

    Noise widens the range: with n frames of even noise σ, direct is too large by about σ √(8 ln n).

    Args:
        frames: linear images of one channel.
        numbers: the frames of the pattern; every pixel must be lit in one and unlit in another.
        black: frame of the ambient light; None: the images hold none.
        leak: light of the projector's black over that of its white, 0 to below 1.

    Returns:
        The parts on the device; not synchronised on CUDA.

    Raises:
        ArrayError: fewer than two frames, one that does not exist or is given twice, or a leak that cannot be.
    """
    require_frames(frames, *numbers, black)
    if len(numbers) < 2:
        raise ArrayError(f"there are {len(numbers)} frames: a pixel must be lit in one and unlit in another, give two or more")
    _check(leak)
    result = _outputs(frames.pixel_count, frames.device)
    devices.launch(_extremes_kernel(devices.pack_width(frames.device), black is not None), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, [*numbers, black]),
                    wp.array(np.array(numbers, dtype=np.int32), dtype=wp.int32, device=frames.device), black or 0, float(leak)],
                   [as_packs(array, frames.device) for array in result], device=frames.device)
    return result


def separate_phase(wrapped: WrappedPhase, *, period: int, ambient: wp.array | None = None, leak: float = 0.0) -> Separation:
    """From the amplitude and offset of a sinusoid: L+ = A + B and L- = A - B, without the bias of extremes.

    Args:
        wrapped: decoded phases.
        period: which of its periods (row): one short enough that bounced light does not follow it.
        ambient: [pixels] float32 reading under the projector's black, padded to whole packs; None: the images hold none.
        leak: light of the projector's black over that of its white, 0 to below 1.

    Returns:
        The parts on the device; not synchronised on CUDA.

    Raises:
        ArrayError: no such period, a leak that cannot be, or ambient of other pixels.
    """
    if not 0 <= period < len(wrapped.periods_px):
        raise ArrayError(f"period {period} does not exist: there are {len(wrapped.periods_px)}")
    _check(leak)
    result = _outputs(wrapped.pixel_count, wrapped.device)
    if ambient is None:
        ambient = zeros(wrapped.pixel_count, wp.float32, wrapped.device)
    if ambient.shape[0] != wrapped.phase.shape[1]:
        raise ArrayError(f"ambient has {ambient.shape[0]} pixels, the phase {wrapped.phase.shape[1]}: give one for each, padded")
    given = [as_packs(array, wrapped.device) for array in (wrapped.amplitude, wrapped.offset, wrapped.status, ambient)]
    devices.launch(_swing_kernel(devices.pack_width(wrapped.device)), given[3].shape[0], [*given, period, float(leak)],
                   [as_packs(array, wrapped.device) for array in result], device=wrapped.device)
    return result


def _check(leak: float) -> None:
    if not 0 <= leak < 1:
        raise ArrayError(f"the leak is {leak:g}: give the light of black over that of white, 0 to below 1")


def _outputs(pixels: int, device: str) -> Separation:
    return Separation(*(unwritten(pixels, dtype, device) for dtype in (wp.float32, wp.float32, wp.uint8)))


@cache
def _extremes_kernel(pack: int, ambient: bool = False) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of = cut_in(pack)

    @wp.kernel(enable_backward=False, module="unique")
    def extremes_kernel(first: int,
                        values: wp.array2d(dtype=float_pack),  # [F, P]
                        saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                        masks: wp.array(dtype=int),  # [F / 8]
                        order: wp.array(dtype=int),  # [N] frames
                        black: int,
                        leak: float,
                        # outputs
                        direct: wp.array(dtype=float_pack),
                        indirect: wp.array(dtype=float_pack),
                        status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut, dark = cut_of(saturated, masks, p), float_pack()
        if wp.static(ambient):
            dark = values[black, p]
        low = values[order[0], p]
        high = values[order[0], p]
        for n in range(1, order.shape[0]):
            reading = values[order[n], p]
            for k in range(pack):
                low[k] = wp.min(low[k], reading[k])
                high[k] = wp.max(high[k], reading[k])
        near, far, result = float_pack(), float_pack(), byte_pack()
        for k in range(pack):
            whole = wp.where(cut[k] == 0, 1, 0)
            near[k] = float(whole) * (high[k] - low[k]) / (1.0 - leak)
            far[k] = float(whole) * 2.0 * (low[k] - dark[k] - leak * (high[k] - dark[k])) / (1.0 - leak * leak)
            result[k] = wp.uint8(whole * OK + (1 - whole) * _SATURATED)
        direct[p] = near
        indirect[p] = far
        status[p] = result

    return extremes_kernel


@cache
def _swing_kernel(pack: int) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)

    @wp.kernel(enable_backward=False, module="unique")
    def swing_kernel(first: int,
                     amplitude: wp.array2d(dtype=float_pack),  # [periods, P]
                     offset: wp.array2d(dtype=float_pack),  # [periods, P]
                     state: wp.array2d(dtype=byte_pack),  # [periods, P]
                     ambient: wp.array(dtype=float_pack),  # [P]
                     period: int,
                     leak: float,
                     # outputs
                     direct: wp.array(dtype=float_pack),
                     indirect: wp.array(dtype=float_pack),
                     status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        swing = amplitude[period, p]
        middle = offset[period, p]
        dark = ambient[p]
        given = state[period, p]
        near, far = float_pack(), float_pack()
        for k in range(pack):
            solved = wp.where(int(given[k]) == OK, 1.0, 0.0)
            low = middle[k] - dark[k] - swing[k]
            high = middle[k] - dark[k] + swing[k]
            near[k] = solved * (high - low) / (1.0 - leak)
            far[k] = solved * 2.0 * (low - leak * high) / (1.0 - leak * leak)
        direct[p] = near
        indirect[p] = far
        status[p] = given

    return swing_kernel
