"""Linear frames as weighted sums of the captured images; all frames of a chunk are computed in one pass over the images."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.images import ImagesOnDevice
from kernels.relight.frames.combine import combine, combine_batch
from kernels.relight.frames.halves import to_halves
from service.requests.relight import CHUNK_FRAMES
from stage.formats.exr_rows import BLOCK_ROWS
from stage.stack.stack import PIXEL_PAD, Stack

CHUNK_BYTES = 256 << 20
"""Most bytes of linear frames, in float32, in a chunk. Two chunks are in memory at one time: one is computed while the previous one is
written."""
CUDA_CHUNK_BYTES = 2 << 30
"""The same for frames that a model guides on CUDA, on a device with much memory more: the model's responses, and images that the device's
memory does not hold, are brought once for each chunk. The host has them as half, mostly."""
BLOCK_BYTES = 1280 << 20
"""Most bytes of a block of rows: the readings of its pixels, and its linear frames. Two blocks are in memory at one time. At 50 megapixels
and 64 lights, a block of 64 frames has 128 rows; every block of every frame costs some milliseconds beyond its pixels."""


class RowBlock(NamedTuple):
    """Rows of an image."""

    first: int
    last: int
    """Behind the last row."""
    pixels: slice
    """The pixels of the rows in the stack; those of the last rows include its padding."""


def chunk_frames(stack: Stack, most: int = CHUNK_FRAMES, *, guided_on: str = "cpu") -> int:
    """Return how many whole frames a chunk holds, `most` at most, where a model guides them on a device."""
    channels, _, pixels = stack.shape
    memory = CHUNK_BYTES if guided_on == "cpu" else devices.batch_bytes(guided_on, CUDA_CHUNK_BYTES)
    return max(1, min(most, memory // (4 * channels * pixels)))


def row_blocks(stack: Stack, width: int, pictures: int) -> Iterator[RowBlock]:
    """Yield blocks of rows whose readings, and the pictures of three channels that are made of them, fit in memory, from the top down."""
    channels, lights, _ = stack.shape
    multiple = math.lcm(BLOCK_ROWS, PIXEL_PAD)  # whole chunks of EXR files and whole packs of pixels
    step = max(multiple, BLOCK_BYTES // (channels * (2 * lights + 4 * pictures) * width) // multiple * multiple)
    height = stack.pixel_count // width
    for first in range(0, height, step):
        last = min(first + step, height)
        yield RowBlock(first, last, slice(first * width, stack.shape[2] if last == height else last * width))


def linear_frames(images: ImagesOnDevice[Stack], weights: np.ndarray, places: Sequence[int] | None, *,
                  pixels: slice | None = None, halves: bool = False) -> np.ndarray:
    """Return [frames, 3, pixels] float32 radiance of one chunk in the stack's scene-linear space, unclipped.

    Args:
        weights: [frames, 3, lights padded] float32.
        places: the row of each frame in the full chunk, also when only some of its frames are made: cuBLAS sums may differ by row, and
            frames that are made later must be identical to the last bit. None: a single frame that is the whole job, for which a
            faster product is used.
        pixels: of a block of rows; None: all.
        halves: whether frames from CUDA are half, as `to_halves` makes them.
    """
    channels, _, count = images.stack.shape
    begin, end, _ = (pixels or slice(None)).indices(count)
    placed = weights if places is None or images.device == "cpu" else _placed(weights, places)
    bands = images.spans(4 * channels * CHUNK_FRAMES) if pixels is None else [(begin, end)]
    kept = slice(None) if places is None or len(placed) == len(weights) else list(places)
    halved = halves and images.device != "cpu"
    frames = None if len(bands) == 1 else np.empty((len(weights), channels, count), dtype=np.float16 if halved else np.float32)
    for start, stop in bands:
        band = images.band(start, stop, saturated=False)
        summed = combine(band, weights[0]).reshape((1, channels, -1)) if places is None else combine_batch(band, placed)
        found = to_numpy(to_halves(summed) if halved else summed)[kept]
        if frames is None:
            frames = found
        else:
            frames[:, :, start:stop] = found
    assert frames is not None
    return frames[:, :, : min(end, images.stack.pixel_count) - begin]


def frames_on_device(images: ImagesOnDevice[Stack], weights: np.ndarray, places: Sequence[int]) -> wp.array:
    """Return the linear frames of a chunk on a CUDA device, [places, 3, pixels padded] float32, each at its place.

    Arguments are those of `linear_frames`.
    """
    channels, _, count = images.stack.shape
    placed = _placed(weights, places)
    frames = wp.empty((len(placed), channels, count), dtype=wp.float32, device=images.device)
    for start, stop in images.spans(0):
        wp.copy(frames[:, :, start:stop], combine_batch(images.band(start, stop, saturated=False), placed))
    return frames


def _placed(weights: np.ndarray, places: Sequence[int]) -> np.ndarray:
    """Return weights in which each frame stands at its place, with zeros between."""
    placed = np.zeros((max(places) + 1, *weights.shape[1:]), dtype=np.float32)
    placed[list(places)] = weights
    return placed
