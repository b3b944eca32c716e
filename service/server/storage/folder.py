"""Storage in the data folder. Writers rename whole files into place, so that what has a name without a leading dot is complete."""

import os
import shutil
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

from service.reporting.progress import Progress
from stage.errors import storage


class StoredFile(NamedTuple):
    """One file."""

    name: str
    """Below its prefix, / between folders."""
    size: int
    modified_at: float


class Storage(Protocol):
    """What the service asks of a storage. A prefix is one of service.server.storage.layout."""

    def local(self, prefix: str, names: Collection[str] | None = None, progress: Progress | None = None) -> Path:
        """A folder of this machine with files of a prefix, to be read.

        Args:
            prefix: of the files.
            names: those that are needed, as far as they are there; None: all.
            progress: told of every file that is fetched.
        """

    def workspace(self, prefix: str) -> Path:
        """A folder of this machine to write files of a prefix into; what is there already, `local` brings into it."""

    def publish(self, prefix: str, progress: Progress | None = None) -> None:
        """Make what was written into the workspace part of the storage; `progress` is told of every file that is sent."""

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Move a finished file into the storage."""

    def delete(self, prefix: str, name: str) -> None:
        """Delete one file; nothing happens where there is none."""

    def files(self, prefix: str) -> list[StoredFile]:
        """The files of a prefix, by name."""

    def open(self, prefix: str, name: str) -> Path | None:
        """A file of this machine with the content of one; None: there is none."""

    def remove(self, prefix: str) -> None:
        """Delete all files of a prefix."""

    def tidy(self) -> None:
        """Finish removals that were interrupted."""

    def check(self) -> None:
        """Raises: StorageError: nothing can be written."""


class FolderStorage:
    """The files of a prefix lie in the folder of that name."""

    def __init__(self, root: Path) -> None:
        """Args: root: the data folder."""
        self._root = root

    def local(self, prefix: str, names: Collection[str] | None = None, progress: Progress | None = None) -> Path:
        """The folder itself: nothing has to be fetched."""
        return self._root / prefix

    def workspace(self, prefix: str) -> Path:
        """The folder itself."""
        folder = self._root / prefix
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def publish(self, prefix: str, progress: Progress | None = None) -> None:
        """Files are there already; what a killed writer left half-written goes."""
        folder = self._root / prefix
        if folder.is_dir():
            sweep(folder)
            with storage("write", folder):
                _sync(folder)

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Rename into place.

        Raises:
            StorageError: the folder cannot be written.
        """
        target = self._root / prefix / name
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
            _sync(target.parent)

    def delete(self, prefix: str, name: str) -> None:
        """Unlink it, and the folders that are empty then."""
        target = self._root / prefix / name
        with storage("remove", target):
            target.unlink(missing_ok=True)
        for folder in list(target.parents)[: name.count("/") + 1]:
            try:
                folder.rmdir()
            except OSError:  # there is more in it
                return

    def files(self, prefix: str) -> list[StoredFile]:
        """Every complete file."""
        return sorted(stored_below(self._root / prefix))

    def open(self, prefix: str, name: str) -> Path | None:
        """The file itself."""
        folder = self._root / prefix
        path = folder / name
        return path if is_shown(name) and path.is_file() and path.resolve() == folder.resolve() / name else None  # by no link

    def remove(self, prefix: str) -> None:
        """Delete the folder; hidden first, so that a half-deleted one is not seen."""
        folder = self._root / prefix
        with storage("remove", folder):
            drop_folder(folder)

    def tidy(self) -> None:
        """Delete what is hidden for it."""
        drop_hidden(self._root)

    def check(self) -> None:
        """Write and remove a file."""
        probe = self._root / f".probe-{os.getpid()}"
        with storage("write in", self._root):
            probe.write_bytes(b"relit")
            probe.unlink()


def _sync(folder: Path) -> None:
    """So that a name which was just given outlives a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_shown(name: str) -> bool:
    """Whether a name is one of a complete file: no part of it is empty, begins with a dot, or leads elsewhere."""
    return "\0" not in name and all(part and not part.startswith(".") for part in name.split("/"))


def drop_folder(folder: Path) -> None:
    """Delete a folder, where there is one; hidden first, so that nobody finds half of it."""
    doomed = folder.with_name(f".{folder.name}.removed")
    shutil.rmtree(doomed, ignore_errors=True)  # of a process that was killed here
    try:
        folder.rename(doomed)
    except FileNotFoundError:
        return
    shutil.rmtree(doomed, ignore_errors=True)


def drop_hidden(root: Path) -> None:
    """Delete what killed processes had hidden, of prefixes below a folder."""
    for folder in root.glob("projects/*/*/.*.removed"):
        shutil.rmtree(folder, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Remove the temporary files that a killed writer left."""
    for path in folder.rglob(".*"):
        if path.is_file():
            path.unlink(missing_ok=True)


def stored_below(folder: Path, before: str = "") -> Iterator[StoredFile]:
    """Complete files below a folder; none where there is no folder."""
    if not folder.is_dir():
        return
    for entry in os.scandir(folder):
        if entry.name.startswith(".") or entry.is_symlink():
            continue
        if entry.is_dir():
            yield from stored_below(Path(entry.path), f"{before}{entry.name}/")
        else:
            status = entry.stat()
            yield StoredFile(before + entry.name, status.st_size, status.st_mtime)
