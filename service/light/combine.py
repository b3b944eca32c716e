"""Linear frames as weighted sums of the captured images; all frames of a chunk are computed in one pass over the images."""

from collections.abc import Sequence

import numpy as np

from kernels import packs
from kernels.relight.many_frames import combine_batch
from kernels.relight.one_frame import combine
from service.requests.relight import CHUNK_FRAMES
from stage.stack import Stack

CHUNK_BYTES = 256 << 20
"""Most bytes of linear frames, in float32, in a chunk. Two chunks are in memory at one time: one is computed while the previous one is
written."""


def chunk_frames(stack: Stack) -> int:
    """Return how many frames a chunk holds."""
    channels, _, pixels = stack.shape
    return max(1, min(CHUNK_FRAMES, CHUNK_BYTES // (4 * channels * pixels)))


def linear_frames(stack: Stack, weights: np.ndarray, places: Sequence[int] | None, *, device: str) -> np.ndarray:
    """Return the frames of one chunk.

    Args:
        stack: the images.
        weights: [frames, 3, lights padded] float32.
        places: the row of each frame in the full chunk, also when only some of its frames are made: cuBLAS sums may differ by row, and
            frames that are made later must be identical to the last bit. None: a single frame that is the whole job, for which a
            faster product is used.
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
