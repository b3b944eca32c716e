"""Linear frames become half EXR files with exposure, output space, clipping, layers and metadata; threads write them while the next frames
are computed."""

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import numpy as np

from kernels import device as devices
from service.requests.picture import FrameCompression, Layer, PictureOptions
from stage import exr
from stage.colour import rgb_matrix

COMPRESSIONS = {FrameCompression.ZIP: exr.Compression.ZIP, FrameCompression.PIZ: exr.Compression.PIZ,
                FrameCompression.DWAA: exr.Compression.DWAA}


class FrameFormat(NamedTuple):
    """What the frames of a capture have in common."""

    resolution: tuple[int, int]
    space: str
    """Scene-linear colour space of the written frames."""
    matrix: np.ndarray | None  # [3, 3] float32 from the space that they are computed in to `space`; None: they are the same
    compression: FrameCompression
    layers: Mapping[str, np.ndarray]  # further channels of every frame, [rows, cols] float16
    parts: tuple[Layer, ...]
    """The wanted ones of the two layers diffuse and specular, which add up to the frame."""

    @classmethod
    def of(cls, options: PictureOptions, resolution: tuple[int, int], space: str, layers: Mapping[str, np.ndarray]) -> "FrameFormat":
        """Return the format of frames that are computed in a scene-linear space, with layers that all of them share."""
        written = str(options.color_space or space)
        return cls(resolution, written, None if written == space else rgb_matrix(space, written), options.compression, layers,
                   tuple(layer for layer in (Layer.DIFFUSE, Layer.SPECULAR) if layer in options.aov))


class FrameFile(NamedTuple):
    """The path, exposure and metadata of one frame."""

    path: Path
    gain: float
    """Factor of the frame's exposure."""
    metadata: dict[str, str]


class Written(NamedTuple):
    """Counts of what a writer has done."""

    frames: int
    clipped: int
    """Pixels beyond the largest half value, stored as that value."""
    half_s: float
    """Seconds that threads spent on converting float to half."""
    file_s: float
    """Seconds that threads spent on compressing and writing files."""


class FrameWriter:
    """Writes chunks of frames while the next are computed. A file exists only when its frame is whole."""

    def __init__(self, done: Callable[[int], None]) -> None:
        """Args: done: called after each frame with the count so far, by one thread at a time."""
        self._done = done
        self._pool = ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-write")
        self._pending: list[Future[None]] = []
        self._lock = threading.Lock()
        self.written = Written(0, 0, 0.0, 0.0)

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Wait until all frames are written; after an error, only those that are being written."""
        try:
            if error is None:
                self.wait()
        finally:
            self._pool.shutdown(wait=True, cancel_futures=True)

    def put(self, files: Sequence[FrameFile], frames: np.ndarray, form: FrameFormat, specular: np.ndarray | None = None) -> None:
        """Wait until the chunk before is written, then begin to write this one.

        Args:
            files: one for each frame.
            frames: [frames, 3, pixels] float32 radiance; the writer may change it.
            form: the format of these frames.
            specular: [frames, 3, pixels] float32 specular part of each; needed where `form` has parts.

        Raises:
            StorageError: a frame cannot be written; those already there are whole.
        """
        self.wait()
        parts = [None] * len(files) if specular is None else list(specular)
        self._pending = [self._pool.submit(self._write, file, frame, part, form)
                         for file, frame, part in zip(files, frames, parts, strict=True)]

    def wait(self) -> None:
        """Wait until everything that was handed over is written."""
        pending, self._pending = self._pending, []
        for job in pending:
            job.result()

    def _write(self, file: FrameFile, frame: np.ndarray, specular: np.ndarray | None, form: FrameFormat) -> None:
        began = time.perf_counter()
        frame = _finished(frame, file, form)
        clipped = int(((frame > exr.HALF_MAX) | (frame < -exr.HALF_MAX)).any(axis=0).sum())
        channels = _half(frame, form, "")
        if specular is not None:
            specular = _finished(specular, file, form)
            parts = {Layer.DIFFUSE: frame - specular, Layer.SPECULAR: specular}
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
    """Return [3, pixels] float32 in the output's space and exposure; the same memory where neither changes."""
    if form.matrix is not None:
        frame = form.matrix @ frame
    return frame * np.float32(file.gain) if file.gain != 1.0 else frame


def _half(frame: np.ndarray, form: FrameFormat, prefix: str) -> dict[str, np.ndarray]:
    """Return the channels as half, clipped."""
    planes = np.clip(frame, -exr.HALF_MAX, exr.HALF_MAX).astype(np.float16).reshape(3, form.resolution[1], form.resolution[0])
    return {prefix + name: plane for name, plane in zip("RGB", planes, strict=True)}
