"""Weights → linear frames: the product of the frames' weights and the stack, every frame of a chunk in one pass over the images."""

from collections.abc import Sequence

import numpy as np

from kernels import packs
from kernels.relight.batch import combine_batch
from kernels.relight.combine import combine
from stage.stack import Stack

CHUNK_BYTES = 256 << 20
"""Of linear frames in float32. Two chunks are held at one time: while one is computed, the one before is being written."""
CHUNK_FRAMES = 32
"""At most: from here on the product costs no less a frame, and writing could begin later only."""


def chunk_frames(stack: Stack) -> int:
    """How many frames a chunk holds."""
    channels, _, pixels = stack.shape
    return max(1, min(CHUNK_FRAMES, CHUNK_BYTES // (4 * channels * pixels)))


def linear_frames(stack: Stack, weights: np.ndarray, places: Sequence[int] | None, *, device: str) -> np.ndarray:
    """The frames of one chunk.

    Args:
        stack: the images.
        weights: [frames, 3, lights padded] float32.
        places: of the frames in their chunk of chunk_frames, the same whichever of them are made: BLAS may sum in another order in
            another row, and a range that was interrupted shall end as if it had not been, to the last bit. None: a single frame that
            is the whole job, which is quicker by itself.
        device: where.

    Returns:
        [frames, 3, pixels] float32 radiance in the stack's scene-linear space, unclipped.
    """
    channels, _, pixels = stack.shape
    placed = weights
    if places is not None:
        placed = np.zeros((max(places) + 1, *weights.shape[1:]), dtype=np.float32)
        placed[list(places)] = weights
    frames = np.empty((len(weights), channels, pixels), dtype=np.float32)
    for start, stop in stack.bands(4 * channels * CHUNK_FRAMES):
        band = packs.upload(stack.band(start, stop), device=device)
        if places is None:
            frames[0, :, start:stop] = combine(band, weights[0]).numpy()
        else:
            frames[:, :, start:stop] = combine_batch(band, placed).numpy()[list(places)]
    return frames[:, :, : stack.pixel_count]
