"""Relighting by linear combination: light is additive, so a new distant illumination is a weighted sum of the captured images.

Source: Debevec et al., "Acquiring the Reflectance Field of a Human Face", SIGGRAPH 2000, section 3.3.

One frame is memory-bound: the stack is read once. On the CPU a thread takes a chunk of packs whose sums stay in the cache, with the
lights outermost and four of them a pass, so that the accumulator is read and written a quarter as often. On CUDA a thread
takes one pack and keeps its sum in registers.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.packs import Band, as_packs, pack_type, zeros

CHUNK = 1024
"""Packs that one CPU thread sums. They are 64 KiB of each light's row, long enough for the hardware prefetcher, and their sums, 128 KiB,
stay in the second-level cache. With 64 packs, whose sums would fit the first level, one core is 1.6 times slower."""
LIGHTS_PER_PASS = 4
"""Number of lights that one pass adds, so that the accumulator is read and written a quarter as often; it divides the light padding of
8."""


def combine(band: Band, weights: np.ndarray) -> wp.array:
    """Relight one frame: a weighted sum of the stored images.

    Args:
        band: the stack on the device.
        weights: [3, lights] float32, what each stored image is multiplied by in each channel; 0 for padding.

    Returns:
        [3, pixels padded] float32 radiance on the device; not synchronised on CUDA.

    Raises:
        ArrayError: weights do not match the band, or are not finite.
    """
    band.require_channels(3)
    check_weights(weights, (3, band.frame_count))
    device = band.device
    pack = devices.pack_width(device)
    frame = zeros(band.pixel_count, wp.float32, device, rows=3)
    on_device = wp.array(weights, dtype=wp.float32, device=device)
    if device == "cpu":
        chunks = -(-band.packs // CHUNK)
        devices.launch(chunk_kernel(pack), 3 * chunks, [band.values, on_device, chunks], [as_packs(frame, device)], device=device)
    else:
        devices.launch(register_kernel(pack), 3 * band.packs, [band.values, on_device], [as_packs(frame, device)], device=device)
    return frame


def check_weights(weights: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuse weights of another shape or with values that are not finite.

    Raises:
        ArrayError: naming what was got and what was expected.
    """
    if weights.shape != shape:
        raise ArrayError(f"weights are {weights.shape}, expected {shape}: one for each channel and padded light")
    if not np.isfinite(weights).all():
        raise ArrayError(f"weights hold {int((~np.isfinite(weights)).sum())} values that are not finite")


@cache
def chunk_kernel(pack: int) -> Any:
    """Return the CPU kernel: one thread for a chunk of packs."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def combine_chunk(first: int,
                      values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance; L a multiple of 4
                      weights: wp.array2d(dtype=float),  # [3, L]
                      chunks: int,  # of one channel
                      # outputs
                      frame: wp.array2d(dtype=float_pack)):  # [3, P]
        thread = first + wp.tid()
        channel = thread / chunks
        begin = (thread % chunks) * CHUNK
        end = wp.min(begin + CHUNK, values.shape[1])
        row = channel * weights.shape[1]
        for p in range(begin, end):
            frame[channel, p] = float_pack()
        for group in range(weights.shape[1] / LIGHTS_PER_PASS):
            light = group * LIGHTS_PER_PASS
            w0 = weights[channel, light]
            w1 = weights[channel, light + 1]
            w2 = weights[channel, light + 2]
            w3 = weights[channel, light + 3]
            for p in range(begin, end):
                v0 = values[row + light, p]
                v1 = values[row + light + 1, p]
                v2 = values[row + light + 2, p]
                v3 = values[row + light + 3, p]
                total = frame[channel, p]
                for k in range(pack):
                    total[k] += float(v0[k]) * w0 + float(v1[k]) * w1 + float(v2[k]) * w2 + float(v3[k]) * w3
                frame[channel, p] = total

    return combine_chunk


@cache
def register_kernel(pack: int) -> Any:
    """Return the CUDA kernel: one thread for a pack, its sum in registers."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def combine_register(first: int,
                         values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                         weights: wp.array2d(dtype=float),  # [3, L]
                         # outputs
                         frame: wp.array2d(dtype=float_pack)):  # [3, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        channel = thread / packs
        p = thread % packs
        total = float_pack()
        for light in range(weights.shape[1]):
            value = values[channel * weights.shape[1] + light, p]
            w = weights[channel, light]
            for k in range(pack):
                total[k] += float(value[k]) * w
        frame[channel, p] = total

    return combine_register
