"""Direct and global light from shifted sinusoids whose period is shorter than the distance over which light bounces and scatters.

A pixel's own (direct) light follows the sinusoid; light that comes by way of other places (global) averages over its periods and stays at
half of what the projector gives full on. With the ambient light taken off a pixel reads A + B cos(φ - δ) under the shift δ, so it would
read L+ = A + B where the pattern is white and L- = A - B where it is black. A projector whose black still gives the part b of its white
has L+ = D + (1 + b) G / 2 and L- = b D + (1 + b) G / 2, so

    D = (L+ - L-) / (1 - b)          G = 2 (L- - b L+) / (1 - b²)

A frame of the projector's black holds the ambient light and b (D + G); with that taken off, b is 0 and D and G are those of white minus
black.

Source: Nayar, Krishnan, Grossberg and Raskar, "Fast separation of direct and global components of a scene using high frequency
illumination", ACM Transactions on Graphics (SIGGRAPH) 2006, equations 2 to 5; sinusoids: section 4.3.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, unwritten
from kernels.status import OK, Status
from kernels.structured.pattern_frames import cut_in, require_frames, saturation_masks
from kernels.structured.phase import weights

_SATURATED = int(Status.SATURATED)


class Separation(NamedTuple):
    """Both parts of the light under the projector full on; pixels are padded to whole packs."""

    direct: wp.array  # [channels, pixels] float32, in the unit of the images
    indirect: wp.array  # [channels, pixels] float32, the global part; noise may take it below 0
    status: wp.array  # [pixels] uint8: OK or SATURATED


def separate(frames: Band, numbers: Sequence[int], shifts: Sequence[float], *, period_px: float, black: int | None = None,
             leak: float = 0.0) -> Separation:
    """Separate direct from global light by the amplitude and the offset of one sinusoid; not synchronised on CUDA.

    A pixel that no direct light reaches is a result, not a fault: its direct part is that of the noise, 2σ √(π / frames) on average for
    even shifts and readings of standard deviation σ, because an amplitude cannot be below 0; the global part is less by as much. SATURATED,
    with values of 0: one of the frames is.

    Args:
        frames: linear images, of any number of channels.
        numbers: the frames of the sinusoid, in any order.
        shifts: δ of each of them in turns (step / steps), three or more different ones.
        period_px: of the sinusoid, for the message.
        black: frame of the projector's black; None: the ambient light is taken off already, or there is none.
        leak: without such a frame, light of the projector's black over that of its white, 0 to below 1.

    Raises:
        ArrayError: a frame does not exist or is given twice, fewer than three different shifts, or a leak that cannot be.
    """
    channels = frames.values.shape[0] // frames.frame_count
    require_frames(frames, *numbers, black, channels=channels)
    if len(numbers) != len(shifts):
        raise ArrayError(f"there are {len(numbers)} frames and {len(shifts)} shifts: give one of each for every frame")
    if not 0 <= leak < 1:
        raise ArrayError(f"the leak is {leak:g}: give the light of black over that of white, 0 to below 1")
    if leak and black is not None:
        raise ArrayError(f"the leak is {leak:g} beside a black frame, which holds it already: give one of the two")
    device, pack = frames.device, devices.pack_width(frames.device)
    table = weights(np.array(shifts, dtype=np.float64), period_px)
    result = Separation(unwritten(frames.pixel_count, wp.float32, device, rows=channels),
                        unwritten(frames.pixel_count, wp.float32, device, rows=channels),
                        unwritten(frames.pixel_count, wp.uint8, device))
    devices.launch(_separation_kernel(pack, black is not None), frames.packs,
                   [frames.values, frames.saturated, saturation_masks(frames, [*numbers, black]),
                    wp.array(numbers, dtype=wp.int32, device=device), wp.array(table, dtype=wp.vec3, device=device),
                    black or 0, channels, float(leak)],
                   [as_packs(array, device) for array in result], device=device)
    return result


@wp.struct
class PixelLight:
    """Both parts of one pixel's light."""

    direct: float
    indirect: float


@wp.func
def light_of(cut: int, mean: float, along: float, across: float, leak: float) -> PixelLight:
    """Return both parts from A (ambient light taken off), C and S; `cut` is not 0 where a frame saturates."""
    swing = wp.sqrt(along * along + across * across)
    low, high = mean - swing, mean + swing
    found = PixelLight()
    found.direct = wp.where(cut == 0, (high - low) / (1.0 - leak), 0.0)
    found.indirect = wp.where(cut == 0, 2.0 * (low - leak * high) / (1.0 - leak * leak), 0.0)
    return found


@once
def _separation_kernel(pack: int, ambient: bool = False) -> Any:
    float_pack, byte_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    cut_of = cut_in(pack)

    @wp.kernel(enable_backward=False, module="unique")
    def separation_kernel(first: int,
                          values: wp.array2d(dtype=float_pack),  # [F · channels, P]
                          saturated: wp.array2d(dtype=byte_pack),  # [F / 8, P] bits
                          masks: wp.array(dtype=int),  # [F / 8]
                          order: wp.array(dtype=int),  # [N] frames
                          table: wp.array(dtype=wp.vec3),  # [N] weights for A, C, S
                          black: int,
                          channels: int,
                          leak: float,
                          # outputs
                          direct: wp.array2d(dtype=float_pack),
                          indirect: wp.array2d(dtype=float_pack),
                          status: wp.array(dtype=byte_pack)):
        p = first + wp.tid()
        cut, result = cut_of(saturated, masks, p), byte_pack()
        for c in range(channels):
            mean, along, across = float_pack(), float_pack(), float_pack()
            for n in range(order.shape[0]):
                reading = values[order[n] * channels + c, p]
                weight = table[n]
                for k in range(pack):
                    mean[k] = mean[k] + weight[0] * reading[k]
                    along[k] = along[k] + weight[1] * reading[k]
                    across[k] = across[k] + weight[2] * reading[k]
            if wp.static(ambient):
                mean = mean - values[black * channels + c, p]
            near, far = float_pack(), float_pack()
            for k in range(pack):
                found = light_of(cut[k], mean[k], along[k], across[k], leak)
                near[k] = found.direct
                far[k] = found.indirect
            direct[c, p] = near
            indirect[c, p] = far
        for k in range(pack):
            result[k] = wp.uint8(wp.where(cut[k] == 0, OK, _SATURATED))
        status[p] = result

    return separation_kernel
