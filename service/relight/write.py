"""Linear frames become half EXR files with exposure, output space, matte, clipping, layers and metadata; threads write them while the next
frames are computed."""

import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent import futures
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from kernels import device as devices
from kernels.packs import to_half
from service.relight.attributes import camera_attributes
from service.relight.layers import StillLayer, in_parts
from service.requests.light.picture_options import FrameCompression, Layer, PictureOptions
from stage.capture.camera import Camera
from stage.colour.colour import rgb_matrix
from stage.formats import exr, exr_rows
from stage.results.matte import Matte

COMPRESSIONS = {FrameCompression.ZIP: exr.Compression.ZIP, FrameCompression.PIZ: exr.Compression.PIZ,
                FrameCompression.DWAA: exr.Compression.DWAA}

BEAUTY_PART = "rgba"
"""The name of the part that holds the picture, as Nuke calls it."""
ALPHA = "A"
PutRows = Callable[[int, int, np.ndarray, Mapping[str, np.ndarray]], None]
"""A function that takes a block of rows of frames, as `FrameWriter.in_rows` says."""


class FrameFormat(NamedTuple):
    """Size, colour space, compression and layers, which all frames of a capture share."""

    resolution: tuple[int, int]
    space: str
    """Scene-linear colour space of the written frames."""
    matrix: np.ndarray | None  # [3, 3] float32 from the space that they are computed in to `space`; None: they are the same
    compression: FrameCompression
    layers: tuple[StillLayer, ...]
    """Further layers of every frame."""
    parts: tuple[Layer, ...]
    """The wanted ones of the two layers diffuse and specular, which add up to the frame."""
    in_parts: bool
    """True if each layer lies in a part of the file."""
    alpha: np.ndarray | None  # [rows, cols] float16; None: no alpha is wanted
    factor: np.ndarray | None  # [pixels] float32 that makes frames premultiplied; None: they are
    attributes: dict[str, Any]
    """Attributes of the camera."""

    @classmethod
    def of(cls, options: PictureOptions, camera: Camera, space: str, written: str, layers: tuple[StillLayer, ...],
           matte: Matte | None) -> "FrameFormat":
        """Return the format of frames.

        Args:
            space: the scene-linear space that the frames are computed in.
            written: the one that they are written in.
            layers: that all of them share.
            matte: of the object, or None where no alpha is wanted.
        """
        factor = None if matte is None or (matte.factor == 1).all() else matte.factor.reshape(-1)
        return cls(camera.resolution, written, None if written == space else rgb_matrix(space, written), options.compression, layers,
                   tuple(layer for layer in (Layer.DIFFUSE, Layer.SPECULAR) if layer in options.aov), in_parts(options),
                   None if matte is None else matte.coverage.astype(np.float16), factor, camera_attributes(camera))

    def as_computed(self, files: Sequence["FrameFile"]) -> bool:
        """Return whether files hold frames as they are computed, but for the range of half."""
        return self.matrix is None and self.factor is None and not self.parts and all(file.gain == 1.0 for file in files)

    def rows(self, first: int, last: int) -> "FrameFormat":
        """Return the format of the rows of frames from `first` until before `last`."""
        width, _ = self.resolution
        return self._replace(resolution=(width, last - first), layers=tuple(layer.rows(first, last) for layer in self.layers),
                             alpha=None if self.alpha is None else self.alpha[first:last],
                             factor=None if self.factor is None else self.factor[first * width : last * width])


class FrameFile(NamedTuple):
    """The path, exposure and metadata of one frame."""

    path: Path
    gain: float
    """Factor of the frame's exposure."""
    metadata: Mapping[str, Any]


class Written(NamedTuple):
    """Counts of what a writer has done."""

    frames: int
    clipped: int
    """Pixels beyond the largest half value, stored as that value."""
    peak: float
    """The largest value of all frames; -inf: there is none."""
    half_s: float
    """Seconds that threads spent on converting float to half."""
    file_s: float
    """Seconds that threads spent on compressing and writing files."""


class FrameWriter:
    """Writes chunks of frames while the next are computed. A file exists only when its frame is whole."""

    def __init__(self, done: Callable[[int], None]) -> None:
        """Call `done` after each frame with the count so far, in one thread at a time."""
        self._done = done
        self._pool = ThreadPoolExecutor(devices.worker_count(), thread_name_prefix="relit-write")
        self._pending: list[Future[None]] = []
        self._lock = threading.Lock()
        self._told = 0
        self.written = Written(0, 0, -np.inf, 0.0, 0.0)

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

    def put(self, files: Sequence[FrameFile], frames: np.ndarray, form: FrameFormat, colours: Mapping[str, np.ndarray]) -> None:
        """Wait until the chunk before is written, then begin to write this one.

        Args:
            frames: [frames, 3, pixels] float32 radiance; the writer may change it. Or half, where the format writes frames as computed, and
                infinite where they are beyond the range of half.
            colours: further layers of radiance by name, each [frames, 3, pixels] float32, which the writer may change; where `form` has
                parts, `specular` is among them.

        Raises:
            StorageError: a frame cannot be written; those already there are whole.
        """
        self.wait()
        self._pending = [self._pool.submit(self._write, file, frame, {name: layer[index] for name, layer in colours.items()}, form)
                         for index, (file, frame) in enumerate(zip(files, frames, strict=True))]

    @contextmanager
    def in_rows(self, files: Sequence[FrameFile], form: FrameFormat) -> Iterator[PutRows]:
        """Yield a function that takes a block of rows of all frames of a chunk; when the block ends, the frames become files.

        The function gets the first row and the one behind the last, the frames [frames, 3, pixels] and further layers as `put` does. It
        waits until the block before is written, then begins to write this one.
        Raises StorageError: a frame cannot be written; none of this chunk is left behind."""
        self.wait()
        height, begun = form.resolution[1], self.written.frames
        growing = [exr_rows.growing(file.path, rows=height, metadata={**form.attributes, **file.metadata}, checksum=True) for file in files]
        opened: list[tuple[Any, exr_rows.RowFile]] = []

        def put(first: int, last: int, frames: np.ndarray, colours: Mapping[str, np.ndarray]) -> None:
            self.wait()
            with self._lock:
                self._tell(begun + len(files) * first // height)
            part = form.rows(first, last)
            self._pending = [self._pool.submit(self._write, file, frame, {name: layer[index] for name, layer in colours.items()}, part, to)
                             for index, ((_, to), file, frame) in enumerate(zip(opened, files, frames, strict=True))]

        try:
            for each in growing:
                opened.append((each, each.__enter__()))
            yield put
            self.wait()
        except BaseException:
            for job in self._pending:
                job.cancel()
            futures.wait(self._pending)
            self._pending.clear()
            for each, _ in opened:
                with suppress(BaseException):  # which it raises again
                    each.__exit__(*sys.exc_info())
            raise
        self._pending = [self._pool.submit(self._end, each) for each, _ in opened]

    def wait(self) -> None:
        """Wait until everything that was handed over is written."""
        pending, self._pending = self._pending, []
        for job in pending:
            job.result()

    def _write(self, file: FrameFile, frame: np.ndarray, colours: Mapping[str, np.ndarray], form: FrameFormat,
               rows: exr_rows.RowFile | None = None) -> None:
        """Write a frame as a file of its own, or some of its rows to one that grows."""
        began = time.perf_counter()
        parts, clipped, peak = _parts(file, frame, colours, form)
        halved = time.perf_counter()
        if rows is None:
            exr.write_parts(file.path, parts, metadata={**form.attributes, **file.metadata}, checksum=True)
        else:
            rows.append(parts)
        self._count(1 if rows is None else 0, clipped, peak, began, halved)

    def _end(self, growing: AbstractContextManager[exr_rows.RowFile]) -> None:
        began = time.perf_counter()
        growing.__exit__(None, None, None)
        self._count(1, 0, -np.inf, began, began)

    def _count(self, frames: int, clipped: int, peak: float, began: float, halved: float) -> None:
        """Add frames that are files, clipped pixels, their largest value, and the seconds until and since `halved`."""
        ended = time.perf_counter()
        with self._lock:
            before = self.written
            self.written = Written(before.frames + frames, before.clipped + clipped, max(before.peak, peak),
                                   before.half_s + halved - began, before.file_s + ended - halved)
            if frames:
                self._tell(self.written.frames)

    def _tell(self, frames: int) -> None:
        """Tell the count of frames, which rows that are written have raised already; the lock is held."""
        self._told = max(self._told, frames)
        self._done(self._told)


def _parts(file: FrameFile, frame: np.ndarray, colours: Mapping[str, np.ndarray], form: FrameFormat) -> tuple[list[exr.Part], int, float]:
    """Return what the file of a frame holds, of the whole frame or of rows, the number of clipped pixels, and the largest value."""
    if frame.dtype != np.float16:
        frame = _finished(frame, file, form)
    bounded, peak = _bounded(frame)
    clipped = 0 if bounded is frame else int((bounded != frame).any(axis=0).sum())
    picture = _half(bounded, form, "")
    if form.alpha is not None:
        picture[ALPHA] = form.alpha
    parts = [exr.Part(BEAUTY_PART, picture, form.space, COMPRESSIONS[form.compression])]
    layers = {name: _finished(layer, file, form) for name, layer in colours.items()}
    if Layer.DIFFUSE in form.parts:
        layers[Layer.DIFFUSE] = frame - layers[Layer.SPECULAR]
    for name, layer in layers.items():
        if name != Layer.SPECULAR or name in form.parts:
            parts.append(exr.Part(name, _half(_bounded(layer)[0], form, f"{name}."), form.space, COMPRESSIONS[form.compression]))
    parts += [exr.Part(layer.name, layer.channels, form.space if layer.is_colour else exr.DATA) for layer in form.layers]
    if not form.in_parts:
        parts = [parts[0]._replace(channels={name: plane for part in parts for name, plane in part.channels.items()})]
    return parts, clipped, peak


def _finished(frame: np.ndarray, file: FrameFile, form: FrameFormat) -> np.ndarray:
    """Return [3, pixels] float32 in the output's space and exposure, premultiplied; the same memory where none of these changes it."""
    if form.matrix is not None:
        frame = form.matrix @ frame
    if form.factor is not None:
        frame *= form.factor
    return frame * np.float32(file.gain) if file.gain != 1.0 else frame


def _half(frame: np.ndarray, form: FrameFormat, prefix: str) -> dict[str, np.ndarray]:
    """Return the channels as half."""
    planes = (frame if frame.dtype == np.float16 else to_half(frame)).reshape(3, form.resolution[1], form.resolution[0])
    return {prefix + name: plane for name, plane in zip("RGB", planes, strict=True)}


def _bounded(frame: np.ndarray) -> tuple[np.ndarray, float]:
    """Return a frame within the range of half, the same array where no value is beyond it, which takes less than to clip it, and its
    largest value."""
    peak = float(frame.max())
    beyond = bool(peak > exr.HALF_MAX or frame.min() < -exr.HALF_MAX)
    return np.clip(frame, -exr.HALF_MAX, exr.HALF_MAX) if beyond else frame, peak
