"""Frames of a capture as planes that are read in bands of rows: corrected, grey or colour, in memory or in a scratch file.

Where light captures keep a stack for many solves, depth is decoded once: the planes are made anew and are gone afterwards.
They are float32, because a ramp's ratio is the projector's column: half would round it by a pixel.
"""

import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stage.capture import Capture
from stage.colour import GREY_WEIGHTS
from stage.correction import Correction
from stage.errors import storage
from stage.ingest import CACHE_FOLDER
from stage.manifest import Frame

MEMORY_BYTES = 256 << 20
"""Planes that take no more stay in memory."""
BAND_BYTES = 64 << 20
"""Of the planes that one band holds; decoders take a few times that beside it."""
DECODE_BYTES, BYTES_PER_PIXEL = 1 << 30, 56
"""What the images being decoded at one time may take together, and each of their pixels."""

Progress = Callable[[int], None]
"""Called with how many frames are read."""


@dataclass(frozen=True)
class Planes:
    """Corrected frames, in the order that was asked for."""

    values: np.ndarray  # [frames, rows, channels, cols] float32, linear radiance; channels 1 (grey) or 3
    saturated: np.ndarray | None  # [frames, rows, cols] bool; None when the capture says no saturation

    def bands(self, bytes_per_pixel: int = 0) -> Iterator[slice]:
        """Ranges of rows that cover the image, each small enough for the memory of a band.

        Args:
            bytes_per_pixel: what the caller needs beside the planes for each pixel.
        """
        frames, rows, channels, cols = self.values.shape
        step = max(1, BAND_BYTES // max(cols * (4 * frames * channels + bytes_per_pixel), 1))
        for top in range(0, rows, step):
            yield slice(top, min(top + step, rows))

    def band(self, rows: slice, frames: Sequence[int] | None = None) -> np.ndarray:
        """Some frames of a range of rows.

        Returns:
            [frames, channels, pixels] float32, a copy.
        """
        part = self.values[list(frames) if frames is not None else slice(None), rows]
        count, height, channels, cols = part.shape
        return np.ascontiguousarray(np.moveaxis(part, 2, 1)).reshape(count, channels, height * cols)


@contextmanager
def frame_planes(capture: Capture, frames: Sequence[Frame], *, colour: bool, cache: Path | None = None,
                 progress: Progress | None = None) -> Iterator[Planes]:
    """Decode and correct frames on a thread pool; the planes are valid inside the block.

    Args:
        capture: an opened capture.
        frames: of it.
        colour: three channels, else one: the luma of GREY_WEIGHTS.
        cache: folder for the scratch file; None: `.relit` in the capture's folder. Nothing is left in it.
        progress: told after every frame.

    Raises:
        ImageError: a frame is unreadable or holds impossible values; names the file.
        StorageError: the scratch file cannot be written.
    """
    correction = Correction.of(capture)
    width, height = capture.camera.resolution
    shape = (len(frames), height, 3 if colour else 1, width)
    with _room(4 * int(np.prod(shape)), capture, cache) as room:
        values = room(shape, np.float32)
        saturated = room((len(frames), height, width), np.bool_) if capture.manifest.saturation is not None else None

        def read(index: int) -> None:
            radiance = correction.apply(frames[index])
            pixels = radiance.pixels if colour else radiance.pixels @ np.array(GREY_WEIGHTS, np.float32)[:, None]
            values[index] = np.moveaxis(pixels, 2, 1)
            if saturated is not None:
                saturated[index] = radiance.saturated

        at_once = max(1, min(os.cpu_count() or 1, DECODE_BYTES // (BYTES_PER_PIXEL * width * height)))
        with ThreadPoolExecutor(at_once, thread_name_prefix="relit-planes") as pool:
            for done, _ in enumerate(pool.map(read, range(len(frames))), start=1):
                if progress is not None:
                    progress(done)
        yield Planes(values, saturated)


@contextmanager
def _room(size: int, capture: Capture, cache: Path | None) -> Iterator[Callable[[tuple[int, ...], type[np.generic]], np.ndarray]]:
    """A maker of arrays: in memory while they are small, else in files that have no name any more when they are used."""
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
