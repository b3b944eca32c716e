"""The frames of a capture under projected texture, as rectified images of the reference camera and of one other."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.depth.stereo.rectification import Rectification
from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.stack.planes import scratch_arrays


class RectifiedFrames(NamedTuple):
    """Images of two cameras whose rows agree; both are smoothed by the binomial filter 1 2 1, because texture finer than the pixels is
    aliased and misleads the comparison of two cameras."""

    left: np.ndarray  # [frames, rows, cols] float32, linear, of the reference camera
    right: np.ndarray  # [frames, rows, right cols] float32, of the other camera
    left_seen: np.ndarray  # [rows, cols] bool, False where the camera saw nothing
    right_seen: np.ndarray  # [rows, right cols] bool


@contextmanager
def rectified_frames(capture: Capture, frames: Sequence[Frame], other: int, rectification: Rectification, *, cache: Path | None = None,
                     progress: Callable[[int], None] | None = None) -> Iterator[RectifiedFrames]:
    """Read and rectify the frames of the reference camera and of one other, and yield images that exist until the block ends.

    Args:
        other: index of the other camera.
        cache: the folder for the scratch file; None stands for `.relit` in the folder of the capture. No file is left in it.
        progress: called after every frame with the count of frames that have been read.

    Raises:
        ImageError: a frame is unreadable or holds impossible values; the message names the file.
        StorageError: the scratch file cannot be written.
    """
    grids = rectification.left, rectification.right
    size = 4 * len(frames) * sum(grid.width * grid.height for grid in grids)
    with scratch_arrays(size, capture, cache) as allocate:
        images = [allocate((len(frames), grid.height, grid.width), np.float32) for grid in grids]
        seen = [np.ones((grid.height, grid.width), bool) for grid in grids]
        for index, frame in enumerate(frames):
            assert frame.stereo is not None  # the caller chose stereo frames
            recorded = capture.recorded(frame.image), capture.recorded_whole(frame.stereo.images[other])
            for side, pixels in enumerate(recorded):
                linear = linearise(pixels, capture.manifest.color_space) @ np.array(GREY_WEIGHTS, np.float32)
                values, held = rectification.rows_of(smoothed(linear / np.float32(frame.exposure_s or 1.0)), other=side == 1)
                images[side][index] = values
                seen[side] &= held
            if progress is not None:
                progress(index + 1)
        yield RectifiedFrames(images[0], images[1], seen[0], seen[1])


def smoothed(image: np.ndarray) -> np.ndarray:
    """Return an image [rows, cols] float32, smoothed by the binomial filter 1 2 1 along rows and columns; borders are continued."""
    for axis in (0, 1):
        along = np.moveaxis(np.pad(image, [(int(axis == 0),) * 2, (int(axis == 1),) * 2], mode="edge"), axis, 0)
        image = np.moveaxis((along[:-2] + along[2:]) * np.float32(0.25) + along[1:-1] * np.float32(0.5), 0, axis)
    return image
