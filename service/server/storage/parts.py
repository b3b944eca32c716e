"""The bytes of an upload that is not complete: one file each, <upload>.part, which one request writes at a time."""

import os
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from service.server import file_lock
from service.server.settings import Settings
from stage.errors import storage

SUFFIX = ".part"
READ = 1 << 20


class PartLocked(Exception):
    """Another request, of this process or another one, has the part."""


class Part:
    """An open part, locked until it is closed. Its methods may be called from any thread, one after the other."""

    def __init__(self, path: Path, descriptor: int) -> None:
        """Args: path: of the file. descriptor: open and locked; of `open`."""
        self.path = path
        self._descriptor: int | None = descriptor
        self._lock = threading.Lock()  # so that nothing is written to a descriptor that was closed meanwhile

    @classmethod
    def open(cls, folder: Path, upload: str) -> Self:
        """Take the part of an upload; an empty one where there is none.

        Raises:
            PartLocked: another has it.
            StorageError: the folder cannot be written.
        """
        path = _path(folder, upload)
        with storage("write", path):
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = file_lock.take(path, 0o644)
        if descriptor is None:
            raise PartLocked
        return cls(path, descriptor)

    @staticmethod
    def discard(folder: Path, upload: str) -> None:
        """Remove the part of an upload that is forgotten, whoever has it."""
        path = _path(folder, upload)
        with storage("remove", path):
            path.unlink(missing_ok=True)

    @property
    def size(self) -> int:
        """Bytes that are there, safe or not."""
        with self._lock:
            return os.fstat(self._open()).st_size

    def cut(self, size: int) -> None:
        """Keep the first bytes alone, and go on behind them."""
        with self._lock, storage("write", self.path):
            os.ftruncate(self._open(), size)
            os.lseek(self._open(), size, os.SEEK_SET)

    def append(self, pieces: Sequence[bytes]) -> None:
        """Write behind what is there.

        Raises:
            StorageError: no space left, or a fault of the disk.
        """
        left = sum(map(len, pieces))
        with self._lock, storage("write", self.path):
            while left:
                written = os.writev(self._open(), pieces)
                left -= written
                pieces = _behind(pieces, written) if left else ()

    def sync(self) -> None:
        """Wait until all that was written is on the disk."""
        with self._lock:
            descriptor = os.dup(self._open())  # more is written meanwhile
        try:
            with storage("write", self.path):
                os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def digest_into(self, digest: Any) -> None:
        """Feed all bytes to a hash of hashlib."""
        with self._lock, storage("read", self.path):
            at = 0
            while block := os.pread(self._open(), READ, at):
                digest.update(block)
                at += len(block)

    def drop(self) -> None:
        """Remove the file."""
        with storage("remove", self.path):
            self.path.unlink(missing_ok=True)

    def close(self) -> None:
        """Let go of it; waits for a write that is under way."""
        with self._lock:
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = None

    def __enter__(self) -> Self:
        """Closed at the end."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Let go."""
        self.close()

    def _open(self) -> int:
        if self._descriptor is None:
            raise ValueError(f"{self.path.name} is closed")
        return self._descriptor


def parts_folder(settings: Settings) -> Path:
    """Where the parts of a service lie."""
    return settings.data / "uploads"


def stored_bytes(folder: Path, upload: str) -> int:
    """Size of the part of an upload; 0 where there is none."""
    try:
        return _path(folder, upload).stat().st_size
    except FileNotFoundError:
        return 0


def leftovers(folder: Path, before: float) -> Iterator[str]:
    """Uploads whose part was not written since a time (seconds since 1970)."""
    for path in folder.glob(f"*{SUFFIX}"):
        try:
            if path.stat().st_mtime < before:
                yield path.name.removesuffix(SUFFIX)
        except FileNotFoundError:
            continue


def _behind(pieces: Sequence[bytes], written: int) -> list[bytes]:
    """What is left of pieces of which the disk took only a part."""
    return [b"".join(pieces)[written:]]


def _path(folder: Path, upload: str) -> Path:
    return folder / f"{upload}{SUFFIX}"
