"""Relighting by linear combination: light is additive, so a new distant illumination is a weighted sum of the captured images.

One frame is memory-bound: the stack is read once. On the CPU a thread takes a chunk of packs whose sums stay in the cache, with the
lights outermost and four of them a pass, so that the accumulator is read and written a quarter as often. On CUDA a thread takes one pack,
keeps its sum in registers, and loads four lights before it adds them.

Many frames are a matrix product of frame weights and the stack. A thread keeps eight frames of one pack in registers. On the CPU it takes a
chunk of packs, which eight frames after eight read again from the cache, so that the stack is read from memory once and never widened to
float32 there; on CUDA it takes one pack. The sum of a frame in registers adds its lights one after another, and is the same to the last
bit whichever other frames are made.

Source: Debevec et al., "Acquiring the Reflectance Field of a Human Face", SIGGRAPH 2000, section 3.3.
"""

from typing import Any

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once, to_numpy
from kernels.errors import ArrayError
from kernels.pack_access import pack_load, pack_store
from kernels.packs import Band, as_packs, new_array, pack_type, unwritten

FRAME_CHUNK = 1024
"""Packs of one frame that one CPU thread sums. They are 64 KiB of each light's row, long enough for the hardware prefetcher, and their
sums, 128 KiB, stay in the second-level cache. With 64 packs, whose sums would fit the first level, one core is 1.6 times slower."""
LIGHTS_PER_PASS = 4
"""Number of lights that one pass adds: on the CPU the accumulator is read and written a quarter as often, on CUDA four loads are under way
at one time. It divides the light padding of 8."""
BATCH_CHUNK = 8
"""Packs of many frames that one CPU thread takes: 256 pixels of 64 lights are 32 KiB, which the first-level cache holds."""
GROUP = 32
"""Number of frames in every BLAS call of combine_rows; missing ones are padded with zero frames. BLAS may sum in another order when the
number changes, and a frame at the same position must be identical to the last bit whichever other frames are made."""
REGISTER_FRAMES = 8
"""Number of frames that one thread computes: their sums, 8 frames of 32 pixels on the CPU and of 4 on CUDA, fit into registers."""


def combine(band: Band, weights: np.ndarray) -> wp.array:
    """Relight one frame: return a weighted sum of the stored images, [3, pixels padded] float32 radiance; not synchronised on CUDA.

    `weights` is [3, lights] float32, what each stored image is multiplied by in each channel; 0 for padding.
    """
    band.require_channels(3)
    _check_weights(weights, (3, band.frame_count))
    device = band.device
    pack = devices.pack_width(device)
    frame = unwritten(band.pixel_count, wp.float32, device, rows=3)
    on_device = wp.array(weights, dtype=wp.float32, device=device)
    if device == "cpu":
        chunks = -(-band.packs // FRAME_CHUNK)
        devices.launch(frame_chunk_kernel(pack), 3 * chunks, [band.values, on_device, chunks], [as_packs(frame, device)], device=device)
    else:
        devices.launch(frame_register_kernel(pack), 3 * band.packs, [band.values, on_device], [as_packs(frame, device)], device=device)
    return frame


def combine_batch(band: Band, weights: np.ndarray) -> wp.array:
    """Relight many frames: return weighted sums of the stored images, [frames, 3, pixels padded] float32; not synchronised on CUDA.

    Args:
        weights: [frames, 3, lights] float32; 0 for padded lights.
    """
    band.require_channels(3)
    _check_weights(weights, (len(weights), 3, band.frame_count))
    device = band.device
    pack = devices.pack_width(device)
    weights = np.ascontiguousarray(weights, dtype=np.float32)
    if not len(weights):
        return wp.empty((0, 3, band.packs * pack), dtype=wp.float32, device=device)
    if device != "cpu":
        return sum_rows(band.values, upload_weights(weights, device))[: len(weights)]
    padded = _padded(weights, REGISTER_FRAMES)
    groups = np.ascontiguousarray(padded.reshape(-1, REGISTER_FRAMES, 3, band.frame_count).transpose(0, 2, 3, 1))
    frames = new_array((len(padded), 3, band.packs * pack), wp.float32, device, cleared=False)
    chunks = -(-band.packs // BATCH_CHUNK)
    devices.launch(batch_chunk_kernel(pack), 3 * chunks, [band.values, wp.array(groups, dtype=wp.float32, device=device), chunks],
                   [as_packs(frames, device)], device=device)
    return frames[: len(weights)]


def combine_rows(rows: wp.array, weights: np.ndarray) -> wp.array:
    """Return [frames, channels, pixels padded] float32, weighted sums of many float32 rows; not synchronised on CUDA.

    A frame at the same position does not depend on the others, to the last bit. On the CPU the product is NumPy's BLAS, which is faster
    where rows are thousands.

    Args:
        rows: [channels · n, P] float32 packs, contiguous; all rows of the first channel come first.
        weights: [frames, channels, n] float32.
    """
    count, channels, terms = weights.shape
    _check_weights(weights, (count, channels, rows.shape[0] // channels))
    device = rows.device.alias
    pack = devices.pack_width(device)
    if device != "cpu":
        return sum_rows(rows, upload_weights(weights, device))[:count]
    frames = wp.empty((count, channels, rows.shape[1] * pack), dtype=wp.float32, device=device)
    planes, sums = to_numpy(rows).reshape(channels, terms, -1), to_numpy(frames)
    padded = _padded(weights, GROUP)
    for channel in range(channels):
        for first in range(0, count, GROUP):
            last, group = min(first + GROUP, count), padded[first : first + GROUP, channel]
            sums[first:last, channel] = np.matmul(group, planes[channel])[: last - first] if group.any() else 0
    return frames


def _padded(weights: np.ndarray, multiple: int) -> np.ndarray:
    """Return weights with zero frames after them, so that their number is a multiple."""
    return np.pad(weights, ((0, -len(weights) % multiple), (0, 0), (0, 0)))


def upload_weights(weights: np.ndarray, device: str) -> wp.array:
    """Return weights [frames, channels, n] on a CUDA device, as `sum_rows` takes them: zero frames follow until a thread's frames are
    whole."""
    return wp.array(_padded(weights, REGISTER_FRAMES), dtype=wp.float32, device=device)


def sum_rows(rows: wp.array, weights: wp.array) -> wp.array:
    """Return [frames, channels, pixels padded] float32 sums of half or float32 rows [channels · n, P] on CUDA; not synchronised."""
    device = rows.device.alias
    pack = devices.pack_width(device)
    count, channels, _ = weights.shape
    frames = wp.empty((count, channels, rows.shape[1] * pack), dtype=wp.float32, device=device)
    devices.launch(batch_register_kernel(pack, rows.dtype._wp_scalar_type_ == wp.float16),
                   count // REGISTER_FRAMES * channels * rows.shape[1], [rows, weights], [as_packs(frames, device)], device=device)
    return frames


def _check_weights(weights: np.ndarray, shape: tuple[int, ...]) -> None:
    """Refuse weights of another shape or with values that are not finite."""
    if weights.shape != shape:
        raise ArrayError(f"weights are {weights.shape}, expected {shape}: one for each channel and padded light")
    if not np.isfinite(weights).all():
        raise ArrayError(f"weights hold {int((~np.isfinite(weights)).sum())} values that are not finite")


@once
def frame_chunk_kernel(pack: int) -> Any:
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
        begin = (thread % chunks) * FRAME_CHUNK
        end = wp.min(begin + FRAME_CHUNK, values.shape[1])
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


@once
def frame_register_kernel(pack: int) -> Any:
    """Return the CUDA kernel: one thread for a pack, its sum in registers."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)
    load, store = pack_load(pack, wp.float16), pack_store(pack, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def combine_register(first: int,
                         values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance; L a multiple of 4
                         weights: wp.array2d(dtype=float),  # [3, L]
                         # outputs
                         frame: wp.array2d(dtype=float_pack)):  # [3, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        channel = thread / packs
        p = thread % packs
        row = channel * weights.shape[1]
        total = float_pack()
        for group in range(weights.shape[1] / LIGHTS_PER_PASS):
            light = group * LIGHTS_PER_PASS
            v0 = load(values, row + light, p)
            v1 = load(values, row + light + 1, p)
            v2 = load(values, row + light + 2, p)
            v3 = load(values, row + light + 3, p)
            w0 = weights[channel, light]
            w1 = weights[channel, light + 1]
            w2 = weights[channel, light + 2]
            w3 = weights[channel, light + 3]
            for k in range(pack):
                total[k] += float(v0[k]) * w0 + float(v1[k]) * w1 + float(v2[k]) * w2 + float(v3[k]) * w3
        store(frame, channel, p, total)

    return combine_register


@once
def batch_chunk_kernel(pack: int) -> Any:
    """Return the CPU kernel: one thread for a chunk of packs, eight frames of one pack at a time, their sums in registers."""
    half_pack, float_pack = pack_type(pack, wp.float16), pack_type(pack, wp.float32)
    sums = wp.types.matrix(shape=(REGISTER_FRAMES, pack), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
    def batch_chunk(first: int,
                    values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                    weights: wp.array4d(dtype=float),  # [F / 8, 3, L, 8]
                    chunks: int,  # of one channel
                    # outputs
                    frames: wp.array3d(dtype=float_pack)):  # [F, 3, P]
        thread = first + wp.tid()
        channel = thread / chunks
        begin = (thread % chunks) * BATCH_CHUNK
        end = wp.min(begin + BATCH_CHUNK, values.shape[1])
        row = channel * weights.shape[2]
        for group in range(weights.shape[0]):
            for p in range(begin, end):
                total = sums()
                for light in range(weights.shape[2]):
                    value = values[row + light, p]
                    for g in range(REGISTER_FRAMES):
                        w = weights[group, channel, light, g]
                        for k in range(pack):
                            total[g, k] += float(value[k]) * w
                for g in range(REGISTER_FRAMES):
                    out = float_pack()
                    for k in range(pack):
                        out[k] = total[g, k]
                    frames[group * REGISTER_FRAMES + g, channel, p] = out

    return batch_chunk


@once
def batch_register_kernel(pack: int, half: bool = True) -> Any:
    """Return the CUDA kernel for half or float32 rows: one thread for a pack and eight frames, their sums in registers."""
    scalar = wp.float16 if half else wp.float32
    row_pack, float_pack = pack_type(pack, scalar), pack_type(pack, wp.float32)
    load, store = pack_load(pack, scalar), pack_store(pack, wp.float32, 3)
    sums = wp.types.matrix(shape=(REGISTER_FRAMES, pack), dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def batch_register(first: int,
                       values: wp.array2d(dtype=row_pack),  # [C · L, P]
                       weights: wp.array3d(dtype=float),  # [F, C, L]; F a multiple of 8
                       # outputs
                       frames: wp.array3d(dtype=float_pack)):  # [F, C, P]
        thread = first + wp.tid()
        packs = values.shape[1]
        p = thread % packs
        channel = (thread / packs) % weights.shape[1]
        f = thread / packs / weights.shape[1] * REGISTER_FRAMES
        total = sums()
        for light in range(weights.shape[2]):
            value = load(values, channel * weights.shape[2] + light, p)
            for g in range(REGISTER_FRAMES):
                w = weights[f + g, channel, light]
                for k in range(pack):
                    total[g, k] += float(value[k]) * w
        for g in range(REGISTER_FRAMES):
            out = float_pack()
            for k in range(pack):
                out[k] = total[g, k]
            store(frames, f + g, channel, p, out)

    return batch_register
