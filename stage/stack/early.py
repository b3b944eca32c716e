"""The stack of a capture that is being taken: each image is decoded when it is there, and the last one completes the stack."""

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.errors import StorageError, storage
from stage.stack.correction import Correction
from stage.stack.fingerprint import Fingerprints
from stage.stack.ingest import FINGERPRINTS, Ingest, stack_key
from stage.stack.peaks import Peaks
from stage.stack.stack_file import StackFile

EARLY = ".early.npy"
"""The file in the folder of the cache; one that a killed program has left is written anew."""


class EarlyStack:
    """Images of a capture, decoded before all of them are there, in a file that `Ingest.stack` takes over."""

    def __init__(self, folder: Path, light_count: int) -> None:
        """Take note of what there will be; the first image makes the file.
        `folder`: of the cache of the capture. `light_count`: of all light frames."""
        self._folder, self._lights, self._path = folder, light_count, folder / EARLY
        self._file: StackFile | None = None
        self._resolution = (0, 0)
        self._fingerprints: Fingerprints | None = None
        self._correction: tuple[str, Correction] | None = None
        self._keys: dict[int, str] = {}
        self._peaks: Peaks | None = None

    def add(self, capture: Capture, frame: Frame, light: int) -> None:
        """Decode an image; where it, or a dark, flat or ambient frame, is another one later, it is decoded anew in the end.
        `light`: the place of the frame among all light frames. Raises StageError if the image cannot be read, or the file not be written,
        or there is no space beside that of the images to come."""
        self._keys.pop(light, None)
        fingerprints = self._fingerprints = self._fingerprints or Fingerprints(capture.folder, self._folder / FINGERPRINTS)
        file = self._file or self._begin(capture, frame)
        common, key = (stack_key(capture, frames, None, fingerprints) for frames in ([], [frame]))
        if self._correction is None or self._correction[0] != common:
            self._peaks = self._peaks or Peaks(capture)
            self._correction = common, replace(Correction.of(capture, full_scale=True), note=self._peaks.note)
        radiance = replace(self._correction[1], capture=capture).coded(frame)
        with storage("write", self._path):
            file.write(light, radiance)
        if stack_key(capture, [frame], None, fingerprints) == key:  # else a file was replaced while it was read
            self._keys[light] = key

    def remember(self) -> None:
        """Keep the hashes of the images that were read, so that they are not read again for the key of the stack."""
        if self._fingerprints is not None:
            self._fingerprints.remember()

    def take(self, ingest: Ingest, path: Path) -> tuple[StackFile, set[int], dict[str, Any]] | None:
        """Move the file to a path; return it, the lights whose planes are those of the frames, and kept peaks; None: it is of no use."""
        if self._file is None or (self._lights, self._resolution) != (len(ingest.frames), ingest.capture.camera.resolution):
            return None
        there = {light for light, frame in enumerate(ingest.frames)
                 if self._keys.get(light) == stack_key(ingest.capture, [frame], None, ingest.fingerprints)}
        os.replace(self._path, path)
        file, self._file = self._file, None
        return file, there, {} if self._peaks is None else self._peaks.kept()

    def close(self) -> None:
        """Remove the file, unless it has become that of a stack."""
        if self._file is not None:
            self._file.close()
            self._path.unlink(missing_ok=True)
            self._file = None

    def _begin(self, capture: Capture, frame: Frame) -> StackFile:
        pixel_count = capture.camera.width * capture.camera.height
        with storage("make the stack cache in", self._folder):
            self._folder.mkdir(parents=True, exist_ok=True)
            images = self._lights * capture.file(frame.image).stat().st_size
            if shutil.disk_usage(self._folder).free < StackFile.size(self._lights, pixel_count) + images:
                raise StorageError(f"{self._folder}: there is no space for the stack beside the images: it is made after the last of them")
            try:
                self._file = StackFile(self._path, self._lights, pixel_count)
            except OSError:
                self._path.unlink(missing_ok=True)
                raise
        self._resolution = capture.camera.resolution
        return self._file
