"""Copies of objects on this machine: a folder for each prefix, with a record of the object version that each file is a copy of.

data/scratch/PREFIX/files/…        the files
data/scratch/PREFIX/objects.json   for each file: version of the object, size, and when the file was written
data/scratch/PREFIX/lock           held while files are fetched or sent, so that two workers of a machine fetch once
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from service.server.base import file_lock
from service.server.storage.folder import drop_folder, drop_hidden
from stage.errors import storage
from stage.files import write_text

FILES, RECORD, LOCK = "files", "objects.json", "lock"
WAIT_S = 0.2
IN_USE_S = 6 * 3600.0
"""Seconds for which a used prefix stays, whatever the limit: a step may read or write it."""
SAVE_S = 2.0
"""Seconds between two records while files are fetched; a worker that is killed loses the files since the last one."""


class Entry:
    """The copies of one prefix, while its lock is held."""

    def __init__(self, folder: Path) -> None:
        self.files = folder / FILES
        self._path = folder / RECORD
        self._saved_at = time.monotonic()
        try:
            self._record: dict[str, list[object]] = json.loads(self._path.read_text(encoding="utf-8"))
        except (FileNotFoundError, ValueError, RecursionError):
            self._record = {}

    def version(self, name: str) -> str | None:
        """Return the version that a file is a copy of; None: there is no file, or it was written since."""
        noted = self._record.get(name)
        return None if noted is None or noted[1:] != _state(self.files / name) else str(noted[0])

    def note(self, name: str, version: str) -> None:
        """Record that a file is a copy of a version."""
        self._record[name] = [version, *_state(self.files / name)]
        if time.monotonic() - self._saved_at > SAVE_S:
            self.save()

    def forget_others(self, names: set[str]) -> None:
        """Delete copies of objects that no longer exist."""
        for name in [name for name in self._record if name not in names]:
            if self.version(name) is not None:
                (self.files / name).unlink(missing_ok=True)
            del self._record[name]

    def save(self) -> None:
        """Write the record to its file."""
        write_text(self._path, json.dumps(self._record))
        self._saved_at = time.monotonic()


class Scratch:
    """The copies of objects on this machine."""

    def __init__(self, root: Path, limit_bytes: int) -> None:
        self._root, self._limit_bytes = root, limit_bytes

    def files(self, prefix: str) -> Path:
        """Return the folder with the files of a prefix, which is made if there is none."""
        folder = self._root / prefix / FILES
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    @contextmanager
    def entry(self, prefix: str, waiting: Callable[[], None]) -> Iterator[Entry]:
        """Lock the copies of a prefix; `waiting` is called again and again while another process has the lock."""
        with self._lock(prefix, waiting):
            entry = Entry(self._root / prefix)
            try:
                yield entry
            finally:
                entry.save()

    def remove(self, prefix: str) -> None:
        """Delete the copies of a prefix."""
        drop_folder(self._root / prefix)

    def tidy(self) -> None:
        """Delete what an interrupted deletion has left."""
        drop_hidden(self._root)

    def make_room(self, wanted_bytes: int) -> None:
        """Delete the prefixes that were unused longest until `wanted_bytes` more fit into the limit; prefixes in use stay."""
        found = sorted((_used_at(lock.parent), _size(lock.parent / FILES), lock.parent)
                       for lock in self._root.glob(f"projects/*/*/*/{LOCK}"))
        total = wanted_bytes + sum(size for _, size, _ in found)
        for used_at, size, folder in found:
            if total <= self._limit_bytes or used_at > time.time() - IN_USE_S:
                return
            drop_folder(folder)
            total -= size

    @contextmanager
    def _lock(self, prefix: str, waiting: Callable[[], None]) -> Iterator[None]:
        path = self._root / prefix / LOCK
        while True:
            self.files(prefix)  # the folder may be deleted meanwhile
            with storage("make", path):
                descriptor = file_lock.take(path, 0o644)
            if descriptor is not None:
                break
            waiting()
            time.sleep(WAIT_S)
        try:
            os.utime(descriptor)
            yield
        finally:
            os.close(descriptor)


def _state(path: Path) -> list[object]:
    """Return size and time of a file; an empty list if there is none."""
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [status.st_size, status.st_mtime_ns]


def _used_at(folder: Path) -> float:
    return max((path.stat().st_mtime for path in (folder / LOCK, folder / FILES) if path.exists()), default=0.0)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
