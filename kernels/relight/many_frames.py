"""Relighting many frames at once: a matrix product of frame weights and the stack, read once for all frames.

On the CPU the product is NumPy's BLAS on blocks of the stack that a kernel has widened to float32; on CUDA a thread keeps eight
frames of one pack in registers.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.packs import Band, as_packs, pack_type
from kernels.relight.one_frame import check_weights

BLOCK_BYTES = 16 << 20
"""Bytes of float32 that one BLAS call reads: they bound the scratch memory, and are so many that the start of the BLAS threads costs
nothing."""
GROUP = 32
"""Number of frames in every BLAS call; missing ones are padded with zero frames. BLAS may sum in another order when the number changes, and
a frame at the same position must be identical to the last bit whichever other frames are made."""
REGISTER_FRAMES = 8
"""Number of frames that one CUDA thread computes: 8 frames of 4 pixels are 32 sums, which fit into registers."""


def combine_batch(band: Band, weights: np.ndarray) -> wp.array:
    """Relight many frames: a weighted sum of the stored images for each.

    Args:
        band: the stack on the device.
        weights: [frames, 3, lights] float32; 0 for padded lights.

    Returns:
        [frames, 3, pixels padded] float32 radiance on the device; not synchronised on CUDA.

    Raises:
        ArrayError: weights do not match the band, or are not finite.
    """
    band.require_channels(3)
    check_weights(weights, (len(weights), 3, band.frame_count))
    device = band.device
    pack = devices.pack_width(device)
    weights = np.ascontiguousarray(weights, dtype=np.float32)
    if device == "cpu":
        frames = wp.empty((len(weights), 3, band.packs * pack), dtype=wp.float32, device=device)
        _product(band, weights, frames.numpy(), pack)
        return frames
    groups = -(-len(weights) // REGISTER_FRAMES)
    padded = np.zeros((groups * REGISTER_FRAMES, 3, band.frame_count), dtype=np.float32)
    padded[: len(weights)] = weights
    frames = wp.empty((groups * REGISTER_FRAMES, 3, band.packs * pack), dtype=wp.float32, device=device)
    devices.launch(register_kernel(pack), groups * 3 * band.packs,
                   [band.values, wp.array(padded, dtype=wp.float32, device=device)], [as_packs(frames, device)], device=device)
    return frames[: len(weights)]


def _product(band: Band, weights: np.ndarray, frames: np.ndarray, pack: int) -> None:
    """Compute frames[f, c] = weights[f, c] @ stack[c], block by block and GROUP frames at a time."""
    groups = -(-len(weights) // GROUP)
    padded = np.zeros((groups * GROUP, *weights.shape[1:]), dtype=np.float32)
    padded[: len(weights)] = weights
    step = max(1, BLOCK_BYTES // (4 * pack * band.frame_count))
    block = wp.empty((band.frame_count, step), dtype=pack_type(pack, wp.float32), device="cpu")
    widened = block.numpy().reshape(band.frame_count, step * pack)
    group = np.empty((GROUP, step * pack), dtype=np.float32)
    for channel in range(3):
        per_frame = np.ascontiguousarray(padded[:, channel])
        for begin in range(0, band.packs, step):
            count = min(step, band.packs - begin)
            devices.launch(_widen_kernel(pack), band.frame_count, [band.values, channel * band.frame_count, begin, count],
                           [block], device="cpu")
            pixels = slice(begin * pack, (begin + count) * pack)
            for first in range(0, len(weights), GROUP):
                last = min(first + GROUP, len(weights))
                np.matmul(per_frame[first : first + GROUP], widened[:, : count * pack], out=group[:, : count * pack])
                frames[first:last, channel, pixels] = group[: last - first, : count * pack]


@cache
def _widen_kernel(pack: int) -> Any:
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def widen_kernel(first: int,
                     values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                     row: int,  # of the channel's first light
                     begin: int,
                     count: int,
                     # outputs
                     block: wp.array2d(dtype=float_pack)):  # [L, count or more]
        light = first + wp.tid()
        for p in range(count):
            half = values[row + light, begin + p]
            wide = float_pack()
            for k in range(pack):
                wide[k] = float(half[k])
            block[light, p] = wide

    return widen_kernel


@cache
def register_kernel(pack: int) -> Any:
    """Return the CUDA kernel: one thread for a pack and eight frames, their sums in registers."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)
    sums = wp.types.matrix(shape=(REGISTER_FRAMES, pack), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def batch_register(first: int,
                       values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                       weights: wp.array3d(dtype=float),  # [F, 3, L]; F a multiple of 8
                       # outputs
                       frames: wp.array3d(dtype=float_pack)):  # [F, 3, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        p = thread % packs
        channel = (thread / packs) % 3
        f = thread / packs / 3 * REGISTER_FRAMES
        total = sums()
        for light in range(weights.shape[2]):
            value = values[channel * weights.shape[2] + light, p]
            for g in range(REGISTER_FRAMES):
                w = weights[f + g, channel, light]
                for k in range(pack):
                    total[g, k] += float(value[k]) * w
        for g in range(REGISTER_FRAMES):
            out = float_pack()
            for k in range(pack):
                out[k] = total[g, k]
            frames[f + g, channel, p] = out

    return batch_register
