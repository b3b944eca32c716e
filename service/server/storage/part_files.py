"""Part files: the bytes of each incomplete upload, in the file <upload>.part, which one request writes at a time."""

import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.server.base import file_lock
from service.server.base.settings import Settings
from stage.errors import storage

SUFFIX = ".part"
READ = 1 << 20


class PartFileLocked(Exception):
    """Another request, of this process or another one, has locked the part file."""


class PartFile:
    """An open part file, locked until it is closed. Its methods may be called from any thread, one at a time."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path = path
        self._descriptor: int | None = descriptor
        self._lock = threading.Lock()  # so that nobody writes to a descriptor that was closed meanwhile

    @classmethod
    def open(cls, folder: Path, upload: str) -> Self:
        """Open and lock the part file of an upload; it is made if there is none. PartFileLocked: another request has locked it."""
        path = _path(folder, upload)
        with storage("write", path):
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = file_lock.take(path, 0o640)
        if descriptor is None:
            raise PartFileLocked
        return cls(path, descriptor)

    @staticmethod
    def discard(folder: Path, upload: str) -> None:
        """Delete the part file of an upload that was deleted, whether or not it is locked."""
        path = _path(folder, upload)
        with storage("remove", path):
            path.unlink(missing_ok=True)

    @property
    def size(self) -> int:
        """Size of the file, bytes; those at its end may not be counted yet."""
        with self._lock:
            return os.fstat(self._open()).st_size

    def cut(self, size: int) -> None:
        """Cut the file to `size` bytes, and append from there."""
        with self._lock, storage("write", self.path):
            os.ftruncate(self._open(), size)
            os.lseek(self._open(), size, os.SEEK_SET)

    def append(self, pieces: Sequence[bytes]) -> None:
        """Append bytes."""
        left = sum(map(len, pieces))
        with self._lock, storage("write", self.path):
            while left:
                written = os.writev(self._open(), pieces)
                left -= written
                pieces = [b"".join(pieces)[written:]] if left else ()

    def sync(self) -> None:
        """Flush the file to the disk."""
        with self._lock:
            descriptor = os.dup(self._open())  # more may be written meanwhile
        try:
            with storage("write", self.path):
                os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def digest_into(self, digest: Any) -> None:
        """Update a hash of hashlib with all bytes."""
        with self._lock, storage("read", self.path):
            at = 0
            while block := os.pread(self._open(), READ, at):
                digest.update(block)
                at += len(block)

    def drop(self) -> None:
        """Delete the file."""
        with storage("remove", self.path):
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Close and unlock the file, after a write that is under way."""
        with self._lock:
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = None

    def __enter__(self) -> Self:
        """Return the part file, which is closed at the end."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Close the part file."""
        self.close()

    def _open(self) -> int:
        if self._descriptor is None:
            raise ValueError(f"{self.path.name} is closed")
        return self._descriptor


def part_files_folder(settings: Settings) -> Path:
    """Return the folder of the part files."""
    return settings.data / "uploads"


def stored_bytes(folder: Path, upload: str) -> int:
    """Return the size of the part file of an upload; 0 if there is none."""
    try:
        return _path(folder, upload).stat().st_size
    except FileNotFoundError:
        return 0


def leftovers(folder: Path, before: float) -> Iterator[str]:
    """Yield the uploads whose part file was not written since a time (seconds since 1970)."""
    for path in folder.glob(f"*{SUFFIX}"):
        try:
            if path.stat().st_mtime < before:
                yield path.name.removesuffix(SUFFIX)
        except FileNotFoundError:
            continue


def _path(folder: Path, upload: str) -> Path:
    return folder / f"{upload}{SUFFIX}"
