"""Storage in the data folder. Writers rename complete files into place: a file whose name has no leading dot is complete."""

import os
import secrets
import shutil
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from service.reporting.progress import Progress
from stage.errors import storage

REMOVED = "removed"
"""Folder in the data folder for the marks of removed prefixes: an empty file for each prefix that was removed lately."""
MARKS = "projects/*/*/*"
REMEMBERED_S = 3 * 86_400.0
"""Seconds for which a removed prefix is remembered: longer than a writer that was under way goes on."""


class StoredFile(NamedTuple):
    """A file of the storage."""

    name: str
    """Name below its prefix, with / between folders."""
    size: int
    modified_at: float


class OpenFile(NamedTuple):
    """An open file of the storage, which whoever gets it closes. Its bytes are those of its version, whatever replaces it."""

    name: str
    descriptor: int
    size: int
    modified_at: float
    version: str
    """The same from every machine as long as the content is the same: letters, digits and hyphens."""

    @classmethod
    def of(cls, name: str, descriptor: int) -> "OpenFile":
        """Describe an open file of this machine; its version is that of its inode, which is never written to again."""
        status = os.fstat(descriptor)
        version = f"{status.st_ino:x}-{status.st_mtime_ns:x}-{status.st_size:x}"
        return cls(name, descriptor, status.st_size, status.st_mtime, version)


class FolderStorage:
    """A storage whose prefixes are folders of the data folder."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def local(self, prefix: str, names: Collection[str] | None = None, progress: Progress | None = None) -> Path:
        """Return a folder of this machine with files of a prefix, or those `names` of them that exist, for reading; none are fetched."""
        return self._root / prefix

    def workspace(self, prefix: str) -> Path:
        """Return a folder of this machine into which files of a prefix are written; `local` puts existing files there."""
        folder = self._root / prefix
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def publish(self, prefix: str, progress: Progress | None = None, *, alone: bool = True) -> None:
        """Make the files in the workspace part of the storage: here the folder is flushed; `alone`: temporary files are garbage."""
        folder = self._root / prefix
        if folder.is_dir():
            if alone:
                sweep(folder)
            with storage("write", folder):
                _sync(folder)

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Rename the file into place."""
        target = self._root / prefix / name
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, target)
            _sync(target.parent)

    def delete(self, prefix: str, name: str) -> None:
        """Delete the file, and the folders that are empty then."""
        target = self._root / prefix / name
        with storage("remove", target):
            target.unlink(missing_ok=True)
        for folder in list(target.parents)[: name.count("/") + 1]:
            try:
                folder.rmdir()
            except OSError:  # there is more in it
                return

    def files(self, prefix: str) -> list[StoredFile]:
        """Return all complete files of a prefix, by name."""
        return sorted(stored_below(self._root / prefix))

    def open(self, prefix: str, name: str) -> OpenFile | None:
        """Open a file; None: there is none, or a link leads to it."""
        folder = self._root / prefix
        path = folder / name
        if not is_shown(name) or not path.is_file() or path.resolve() != folder.resolve() / name:
            return None
        try:
            return OpenFile.of(name, os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW))
        except FileNotFoundError:  # deleted meanwhile
            return None

    def remove(self, prefix: str) -> None:
        """Delete the folder, if there is one; it is hidden first, so that a part of it is not shown. A mark stays for REMEMBERED_S."""
        folder, mark = self._root / prefix, self._root / REMOVED / prefix
        if folder.is_dir():
            with storage("remove", folder):
                mark.parent.mkdir(parents=True, exist_ok=True)
                mark.touch()
                drop_folder(folder)

    def leftovers(self) -> list[str]:
        """Return the prefixes that are marked as removed and are folders again."""
        marks = self._root / REMOVED
        return [str(prefix) for mark in marks.glob(MARKS) if (self._root / (prefix := mark.relative_to(marks))).is_dir()]

    def tidy(self) -> None:
        """Delete the folders whose deletion was interrupted, and old marks of removed prefixes."""
        drop_hidden(self._root)
        for mark in (self._root / REMOVED).glob(MARKS):
            if mark.stat().st_mtime < time.time() - REMEMBERED_S:
                mark.unlink(missing_ok=True)

    def check(self) -> None:
        """Write and delete a file."""
        probe = self._root / f".probe-{os.getpid()}"
        with storage("write in", self._root):
            probe.write_bytes(b"relit")
            probe.unlink()


def _sync(folder: Path) -> None:
    """Flush a folder, so that a new name in it survives a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def is_shown(name: str) -> bool:
    """Return whether a name is that of a complete file: no part of it is empty or begins with a dot."""
    return "\0" not in name and all(part and not part.startswith(".") for part in name.split("/"))


def drop_folder(folder: Path) -> None:
    """Delete a folder if it exists; it is renamed to a hidden name first, so that nobody finds it half deleted."""
    removed = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.removed")  # two processes may delete the same folder
    try:
        folder.rename(removed)
    except FileNotFoundError:
        return
    shutil.rmtree(removed, ignore_errors=True)


def drop_hidden(root: Path) -> None:
    """Delete the folders below `root` that killed processes had hidden."""
    for folder in root.glob("projects/*/*/.*.removed"):
        shutil.rmtree(folder, ignore_errors=True)


def sweep(folder: Path) -> None:
    """Delete the temporary files and folders that a killed writer left; no writer that lives may have any there."""
    for path in list(folder.rglob(".*")):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def stored_below(folder: Path, before: str = "") -> Iterator[StoredFile]:
    """Yield the complete files below a folder; none if there is no folder."""
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
