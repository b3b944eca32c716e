"""The images of a capture, decoded into the stack of a solve while others are taken."""

import queue
import threading
from collections.abc import Sequence
from pathlib import Path

from service.acquisition.plans.shots import Shot
from stage.capture.capture import Capture, source_places
from stage.capture.manifest import FILE_NAME, read_manifest
from stage.errors import StageError
from stage.stack.early import EarlyStack
from stage.stack.ingest import CACHE_FOLDER, Ingest


class EarlyIngest:
    """Takes note of pictures as they come, and decodes them in a thread of its own, once one has been taken in this run."""

    def __init__(self, folder: Path, shots: Sequence[Shot]) -> None:
        """Find which shots of the capture itself are light frames; nothing is decoded yet."""
        own = [shot for shot in shots if not shot.folder]
        self._folder = folder
        self._lights = {own[index].name: light for light, index in enumerate(source_places([shot.light for shot in own]))}
        self._early = EarlyStack(folder / CACHE_FOLDER, len(self._lights))
        self._waiting: queue.Queue[str | None] = queue.Queue()
        self._stopped = False
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Do nothing: the first new picture begins."""

    def send(self, name: str, *, new: bool) -> None:
        """Decode a picture of the capture when those before it are decoded; returns at once."""
        self._waiting.put(name)
        if new and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="relit-early-ingest", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End, as the capture has ended before its last picture; done once more, it does nothing."""
        self._stopped = True
        self._end()
        self._early.close()

    def finish(self) -> None:
        """Complete the stack, which the preview and a solve then find.
        Raises StageError if an image cannot be read, or the stack not be written."""
        self._end()
        try:
            if self._lights:
                self._early.remember()
                Ingest.of(Capture.open(self._folder)).stack(early=self._early)
        finally:
            self._early.close()

    def _end(self) -> None:
        self._waiting.put(None)
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while (name := self._waiting.get()) is not None:
            light = self._lights.get(Path(name).stem)
            if light is None or self._stopped:
                continue
            try:
                capture = Capture(self._folder, read_manifest(self._folder / FILE_NAME))  # all files are checked in the end
                for frame in capture.manifest.frames:
                    if frame.image == name:
                        self._early.add(capture, frame, light)
            except (StageError, MemoryError):  # no more is decoded before all are there; `finish` says what is wrong if it still is
                self._stopped = True
