"""Storage in the data folder. Writers rename whole files into place, so that what has a name without a leading dot is complete."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

from stage.errors import storage


class Stored(NamedTuple):
    """One file."""

    name: str
    """Below its prefix, / between folders."""
    size: int
    modified_at: float


class Storage(Protocol):
    """What the service asks of a storage. A prefix is one of service.storage.layout."""

    def local(self, prefix: str) -> Path:
        """A folder of this machine with all files of a prefix, to be read."""

    def workspace(self, prefix: str) -> Path:
        """A folder of this machine to write files of a prefix into."""

    def publish(self, prefix: str) -> None:
        """Make what was written into the workspace part of the storage."""

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Move a finished file into the storage."""

    def files(self, prefix: str) -> list[Stored]:
        """The files of a prefix, by name."""

    def open(self, prefix: str, name: str) -> Path | None:
        """A file of this machine with the content of one; None: there is none."""

    def remove(self, prefix: str) -> None:
        """Delete all files of a prefix."""

    def check(self) -> None:
        """Raises: StorageError: nothing can be written."""


class FolderStorage:
    """The files of a prefix lie in the folder of that name."""

    def __init__(self, root: Path) -> None:
        """Args: root: the data folder."""
        self._root = root

    def local(self, prefix: str) -> Path:
        """The folder itself."""
        return self._root / prefix

    def workspace(self, prefix: str) -> Path:
        """The folder itself."""
        folder = self._root / prefix
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def publish(self, prefix: str) -> None:
        """Files are there already; what a killed writer left half-written goes."""
        sweep(self._root / prefix)

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Rename into place.

        Raises:
            StorageError: the folder cannot be written.
        """
        target = self._root / prefix / name
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)

    def files(self, prefix: str) -> list[Stored]:
        """Every complete file."""
        root = self._root / prefix
        return [] if not root.is_dir() else sorted(_files(root, ""))

    def open(self, prefix: str, name: str) -> Path | None:
        """The file itself."""
        path = self._root / prefix / name
        whole = not any(part.startswith(".") for part in name.split("/"))
        return path if whole and path.is_file() and not path.is_symlink() and path.resolve().is_relative_to(self._root) else None

    def remove(self, prefix: str) -> None:
        """Delete the folder; hidden first, so that a half-deleted one is not seen."""
        folder = self._root / prefix
        if not folder.exists():
            return
        doomed = folder.with_name(f".{folder.name}.removed")
        with storage("remove", folder):
            folder.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)

    def check(self) -> None:
        """Write and remove a file."""
        probe = self._root / f".probe-{os.getpid()}"
        with storage("write in", self._root):
            probe.write_bytes(b"relit")
            probe.unlink()


def sweep(folder: Path) -> None:
    """Remove the temporary files that a killed writer left."""
    for path in folder.rglob(".*"):
        if path.is_file():
            path.unlink(missing_ok=True)


def _files(folder: Path, before: str) -> Iterator[Stored]:
    for entry in os.scandir(folder):
        if entry.name.startswith(".") or entry.is_symlink():
            continue
        if entry.is_dir():
            yield from _files(Path(entry.path), f"{before}{entry.name}/")
        else:
            status = entry.stat()
            yield Stored(before + entry.name, status.st_size, status.st_mtime)
