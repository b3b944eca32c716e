"""Linear frames → half EXR files: exposure, output space, clipping, layers, metadata; on threads, beside the next chunk's product."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from kernels import device as devices
from service.requests.picture import FrameCompression, Layer
from stage import exr

HALF_MAX = 65504.0
COMPRESSIONS = {FrameCompression.ZIP: exr.Compression.ZIP, FrameCompression.PIZ: exr.Compression.PIZ,
                FrameCompression.DWAA: exr.Compression.DWAA}


class FrameFormat(NamedTuple):
    """What the frames of a capture have in common."""

    resolution: tuple[int, int]
    space: str
    """Scene-linear, that they are written in."""
    matrix: np.ndarray | None  # [3, 3] float32 to it from the space that they are computed in; None: it is the same
    compression: FrameCompression
    layers: Mapping[str, np.ndarray]  # further channels of every frame, [rows, cols] float16
    parts: tuple[Layer, ...] = ()
    """Layers that add up to the frame, diffuse and specular, where they are wanted."""


class FrameFile(NamedTuple):
    """Where a frame goes and what is done to it on the way."""

    path: Path
    gain: float
    """Of its exposure."""
    metadata: dict[str, str]


class Written(NamedTuple):
    """What a writer has done."""

    frames: int
    clipped: int
    """Pixels beyond the largest half value, stored as that value."""
    half_s: float
    """Seconds of threads, from float to half."""
    file_s: float
    """Seconds of threads, packing and writing files."""


class FrameWriter:
    """Writes chunks of frames; while one is being written, the next may be computed. A frame is there whole or not at all."""

    def __init__(self, done: Callable[[int], None]) -> None:
        """Args: done: called after each frame with the count so far, by one thread at a time."""
        self._done = done
        self._pool = ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-write")
        self._pending: list[Future[None]] = []
        self._lock = threading.Lock()
        self.written = Written(0, 0, 0.0, 0.0)

    def __enter__(self) -> Self:
        """Begin."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Finish what is handed over; after an error only the frames that are being written."""
        try:
            if error is None:
                self.wait()
        finally:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def put(self, files: Sequence[FrameFile], frames: np.ndarray, form: FrameFormat, specular: np.ndarray | None = None) -> None:
        """Hand a chunk over; waits until the chunk before is written.

        Args:
            files: of each frame.
            frames: [frames, 3, pixels] float32 radiance; the writer may change it.
            form: of these frames.
            specular: [frames, 3, pixels] float32 part of each, where such layers are wanted.

        Raises:
            StorageError: a frame cannot be written; those already there are whole.
        """
        self.wait()
        shines = [None] * len(files) if specular is None else list(specular)
        self._pending = [self._pool.submit(self._write, file, frame, shine, form)
                         for file, frame, shine in zip(files, frames, shines, strict=True)]

    def wait(self) -> None:
        """Wait until everything that was handed over is written."""
        pending, self._pending = self._pending, []
        for job in pending:
            job.result()

    def _write(self, file: FrameFile, frame: np.ndarray, shine: np.ndarray | None, form: FrameFormat) -> None:
        began = time.perf_counter()
        frame = _finished(frame, file, form)
        clipped = int(((frame > HALF_MAX) | (frame < -HALF_MAX)).any(axis=0).sum())
        channels = _half(frame, form, "")
        if shine is not None:
            shine = _finished(shine, file, form)
            parts = {Layer.DIFFUSE: frame - shine, Layer.SPECULAR: shine}
            for layer in form.parts:
                channels |= _half(parts[layer], form, f"{layer}.")
        halved = time.perf_counter()
        exr.write(file.path, {**channels, **form.layers}, color_space=form.space, metadata=file.metadata,
                  compression=COMPRESSIONS[form.compression])
        ended = time.perf_counter()
        with self._lock:
            before = self.written
            self.written = Written(before.frames + 1, before.clipped + clipped, before.half_s + halved - began,
                                   before.file_s + ended - halved)
            self._done(self.written.frames)


def _finished(frame: np.ndarray, file: FrameFile, form: FrameFormat) -> np.ndarray:
    """In the output's space and exposure; [3, pixels] float32, the same memory where nothing is to be done."""
    if form.matrix is not None:
        frame = form.matrix @ frame
    return frame * np.float32(file.gain) if file.gain != 1.0 else frame


def _half(frame: np.ndarray, form: FrameFormat, prefix: str) -> dict[str, np.ndarray]:
    """Channels as half, clipped."""
    planes = np.clip(frame, -HALF_MAX, HALF_MAX).astype(np.float16).reshape(3, form.resolution[1], form.resolution[0])
    return {prefix + name: plane for name, plane in zip("RGB", planes, strict=True)}
