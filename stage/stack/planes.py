"""Corrected frames of a depth capture as float32 planes, in memory or in a scratch file, which are read in bands of rows.

A light capture keeps a stack on disk for many solves; depth is decoded once, so the planes are temporary. They are float32,
because the ratio of two ramps is a projector column, which half precision would round by a pixel.
"""

import math
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import storage
from stage.stack.correction import Correction
from stage.stack.ingest import CACHE_FOLDER
from stage.stack.pattern_exposures import JoinedExposures

MEMORY_BYTES = 256 << 20
"""The most bytes of planes that are kept in memory; larger planes lie in a scratch file."""
BAND_BYTES = 64 << 20
"""The bytes of the planes in one band; a decoder needs a few times that beside them."""
WAVES = ("phase", "modulated", "ramp")
"""Codes of which a reading measures light: one that is clipped moves their places, where stripes are bright all the same. Their largest
integer is saturated where no saturation is given."""
DECODE_BYTES, BYTES_PER_PIXEL = 1 << 30, 56
"""The bytes that all images which are corrected at one time may take, and the bytes of each of their pixels."""


@dataclass(frozen=True)
class Planes:
    """The corrected frames that `frame_planes` was called with, in their order."""

    values: np.ndarray  # [frames, rows, channels, cols] float32, linear radiance; channels 1 (grey) or 3
    saturated: np.ndarray | None  # [frames, rows, cols] bool; None where no reading is
    exposure: np.ndarray | None = None
    """[rows, cols] float32, the light that each pixel has gathered, over that of the longest; None: all alike. Bands of the frames are
    multiplied by it, so that one noise model holds for all pixels."""

    def bands(self, bytes_per_pixel: int = 0) -> Iterator[slice]:
        """Yield ranges of rows that cover the image, each small enough for BAND_BYTES.
        `bytes_per_pixel`: the bytes that the caller needs for each pixel beside the planes."""
        frames, rows, channels, cols = self.values.shape
        step = max(1, BAND_BYTES // max(cols * (4 * frames * channels + bytes_per_pixel), 1))
        for top in range(0, rows, step):
            yield slice(top, min(top + step, rows))

    def band(self, rows: slice, frames: Sequence[int] | None = None) -> np.ndarray:
        """Return some frames of a range of rows, each pixel times its exposure.
        `frames`: indices of the frames; None stands for all. Returns [frames, channels, pixels] float32, a copy."""
        part = self.values[list(frames) if frames is not None else slice(None), rows]
        if self.exposure is not None:
            part = part * self.exposure[None, rows, None, :]
        count, height, channels, cols = part.shape
        return np.ascontiguousarray(np.moveaxis(part, 2, 1)).reshape(count, channels, height * cols)


@contextmanager
def frame_planes(capture: Capture, frames: Sequence[Frame], *, colour: bool, cache: Path | None = None,
                 progress: Callable[[int], None] | None = None, joined: JoinedExposures | None = None) -> Iterator[Planes]:
    """Decode and correct frames on a thread pool, and yield planes that exist until the block ends.

    Args:
        colour: True keeps three channels, False weighs them with GREY_WEIGHTS.
        cache: the folder for the scratch file; None stands for `.relit` in the folder of the capture. No file is left in it.
        progress: called after every frame with the count of frames that have been read.
        joined: how each frame is joined of several exposures; None: they are read as they are.
    """
    read_frame = Correction.of(capture, full_scale=True).apply if joined is None else joined.read
    marked = joined is not None or capture.manifest.saturation is not None
    waves = [getattr(frame.pattern, "code", None) in WAVES for frame in frames]
    width, height = capture.camera.resolution
    shape = (len(frames), height, 3 if colour else 1, width)
    with scratch_arrays(4 * int(np.prod(shape)), capture, cache) as allocate:
        values = allocate(shape, np.float32)
        saturated = allocate((len(frames), height, width), np.bool_) if marked or any(waves) else None

        def read(index: int) -> None:
            radiance = read_frame(frames[index])
            pixels = radiance.pixels if colour else radiance.pixels @ np.array(GREY_WEIGHTS, np.float32)[:, None]
            values[index] = np.moveaxis(pixels, 2, 1)
            if saturated is not None:
                saturated[index] = radiance.saturated if (marked or waves[index]) and radiance.saturated is not None else False

        at_once = max(1, min(os.cpu_count() or 1, DECODE_BYTES // (BYTES_PER_PIXEL * math.prod(capture.image_resolution))))
        with ThreadPoolExecutor(at_once, thread_name_prefix="relit-planes") as pool:
            for done, _ in enumerate(pool.map(read, range(len(frames))), start=1):
                if progress is not None:
                    progress(done)
        if not marked and saturated is not None and not saturated.any():
            saturated = None
        yield Planes(values, saturated, None if joined is None else joined.exposure)


@contextmanager
def scratch_arrays(size: int, capture: Capture, cache: Path | None) -> Iterator[Callable[[tuple[int, ...], type[np.generic]], np.ndarray]]:
    """Yield a function that makes arrays: in memory up to MEMORY_BYTES in all, otherwise in unnamed temporary files."""
    if size <= MEMORY_BYTES:
        yield lambda shape, dtype: np.empty(shape, dtype)
        return
    folder = cache if cache is not None else capture.folder / CACHE_FOLDER
    hint = "" if cache is not None else " (--cache names another folder for it)"

    def make(shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
        with storage(f"make the scratch file{hint} in", folder):
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder) as file:
                count = int(np.prod(shape)) * np.dtype(dtype).itemsize
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(file.fileno(), 0, count)  # no space is an error here, later it would be a crash
                return np.memmap(file, dtype=dtype, mode="r+", shape=shape)

    yield make
