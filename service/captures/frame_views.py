"""What a picture of a capture needs of every frame: a small image, and how bright its readings are."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from service.light.sheet import fit
from stage.capture import Capture
from stage.correction import Correction
from stage.errors import StageError
from stage.manifest import Frame
from stage.tof.frames import read_frame

STOPS = (-16, 8)
"""The range of the histogram, in powers of two of its unit."""
BINS = 4 * (STOPS[1] - STOPS[0])
"""The bins of the histogram, a quarter of a stop each; the first has darker readings and 0 too, the last brighter ones."""
THUMBNAIL = 160
"""The rows of the small images."""


class FrameView(NamedTuple):
    """One frame, or nothing of a frame that cannot be read."""

    frame: Frame
    image: np.ndarray | None  # [rows, cols, 3] float32, scene-linear, the part around the object, THUMBNAIL rows
    counts: np.ndarray  # [2, BINS] int: unsaturated and saturated readings of the object


class CaptureView(NamedTuple):
    """All frames of a capture."""

    frames: list[FrameView]
    mask: np.ndarray  # [rows, cols] bool
    mean: np.ndarray  # [rows, cols, 3] float32, mean of the frames, of time of flight without their signs
    saturated: np.ndarray  # [rows, cols] int, in how many frames each pixel is saturated
    signed: bool
    """Whether the frames are time of flight, and so no radiance."""
    unit: float
    """The unit of the histograms: 1, the largest integer of images of integers, or a power of two of that order for larger readings."""


def view_capture(capture: Capture, peak: float, done: Callable[[int], None]) -> CaptureView:
    """Read every frame of a capture.

    Args:
        capture: an opened capture.
        peak: the largest reading.
        done: called with the count of frames that have been read.

    Raises:
        StageError: the mask, or a dark, flat or ambient frame cannot be read.
    """
    mask, correction = capture.mask(), Correction.of(capture, full_scale=True)
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    around = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
    unit = 1.0 if peak <= 2.0 ** STOPS[1] else 2.0 ** (np.ceil(np.log2(peak)) - STOPS[1])
    total = np.zeros((*mask.shape, 3), np.float32)
    saturated = np.zeros(mask.shape, np.int32)

    def read(frame: Frame) -> tuple[FrameView, np.ndarray | None, np.ndarray | None]:
        try:
            if frame.tof is not None:
                values = read_frame(capture, frame)
                grey = values if values.shape == mask.shape else values.sum(axis=1).reshape(mask.shape)
                pixels, over = np.repeat(np.nan_to_num(grey)[..., None], 3, axis=-1).astype(np.float32), None
            else:
                pixels, over = correction.apply(frame)
        except StageError:
            return FrameView(frame, None, np.zeros((2, BINS), int)), None, None
        over = np.zeros(mask.shape, bool) if over is None else over
        level = np.abs(pixels[mask]).max(axis=-1) * ((frame.exposure_s or 1.0) / unit)
        bins = np.clip((np.log2(np.maximum(level, 2.0 ** STOPS[0])) - STOPS[0]) * 4, 0, BINS - 1).astype(int)
        counts = np.stack([np.bincount(bins[over[mask] == which], minlength=BINS) for which in (False, True)])
        return FrameView(frame, fit(pixels[around], THUMBNAIL, kernel="triangle"), counts), pixels, over

    views = []
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="relit-picture") as pool:
        for view, pixels, over in pool.map(read, capture.manifest.frames):
            views.append(view)
            if pixels is not None and over is not None:
                total += np.abs(pixels)
                saturated += over
            done(len(views))
    return CaptureView(views, mask, total / max(sum(view.image is not None for view in views), 1), saturated,
                       any(frame.tof is not None for frame in capture.manifest.frames), unit)
