"""The storage that the settings name, and storage in an object store.

Workers read and write copies of objects on their own disks; objects appear complete or not at all.
"""

import hashlib
import json
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from service.reporting.progress import Progress
from service.server.base import file_lock
from service.server.base.settings import Settings
from service.server.storage.bucket import Bucket, Object
from service.server.storage.folder import (
    REMOVED,
    FolderStorage,
    OpenFile,
    StoredFile,
    drop_folder,
    drop_hidden,
    is_shown,
    stored_below,
    sweep,
)
from stage.errors import storage
from stage.files import replacing, write_text

T = TypeVar("T")
SCRATCH, PROBE = "scratch", "probe"
"""Folder of the copies of objects in the data folder, and the object that a check writes."""
FILES, RECORD, LOCK = "files", "objects.json", "lock"
TRANSFERS = 8
"""Files that are transferred at one time."""
LOOK_S, WAIT_S = 0.5, 0.2
"""Seconds between two reports of progress, and between two looks for a lock."""
CHECK_S = 30.0
"""Seconds for which the result of a check counts: each check costs two requests."""
IN_USE_S = 6 * 3600.0
"""Seconds for which a used prefix stays, whatever the limit: a step may read or write it."""
SAVE_S = 2.0
"""Seconds between two records while files are fetched; a worker that is killed loses the files since the last one."""


class Entry:
    """The copies of one prefix on this machine, while its lock is held, so that two workers of a machine fetch once.

    data/scratch/PREFIX/files/…        the files
    data/scratch/PREFIX/objects.json   for each file: version of the object, size, and when the file was written
    data/scratch/PREFIX/lock           held while files are fetched or sent
    """

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


class ObjectStorage:
    """A storage whose files are the objects of a bucket, with copies of at most `scratch_bytes`, besides those in use, on this machine."""

    def __init__(self, bucket: Bucket, scratch: Path, scratch_bytes: int) -> None:
        self._bucket, self._scratch, self._scratch_bytes = bucket, scratch, scratch_bytes
        self._checking = threading.Lock()
        self._checked_at = -CHECK_S

    def local(self, prefix: str, names: Collection[str] | None = None, progress: Progress | None = None) -> Path:
        """Return a folder with copies; a copy of the same version is not fetched again."""
        objects = self._objects(prefix)
        with self._entry(prefix, progress) as entry:
            if names is None:
                entry.forget_others(set(objects))
            missing = {name: found for name, found in objects.items()
                       if (names is None or name in names) and entry.version(name) != found.version}
            self._fetch(entry, missing, progress)
        return self.workspace(prefix)

    def workspace(self, prefix: str) -> Path:
        """Return the folder of the copies, into which results are written; it is made if there is none."""
        folder = self._scratch / prefix / FILES
        with storage("make", folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder

    def publish(self, prefix: str, progress: Progress | None = None, *, alone: bool = True) -> None:
        """Send the files that are new or have changed, each complete or not at all; `alone` is that of Storage."""
        with self._entry(prefix, progress) as entry:
            if alone:
                sweep(entry.files)
            new = [stored for stored in stored_below(entry.files) if entry.version(stored.name) is None]

            def send(stored: StoredFile, moved: Callable[[], None]) -> tuple[str, str]:
                return stored.name, self._bucket.send(entry.files / stored.name, f"{prefix}/{stored.name}", moved).version

            _transfer("upload", new, send, entry, progress)

    def put(self, file: Path, prefix: str, name: str) -> None:
        """Send a file, and delete it on this machine."""
        self._bucket.send(file, f"{prefix}/{name}", lambda: None)
        file.unlink()

    def delete(self, prefix: str, name: str) -> None:
        """Delete the object; its copies go when they are updated."""
        self._bucket.delete([f"{prefix}/{name}"])

    def files(self, prefix: str) -> list[StoredFile]:
        """Return all files of a prefix, by name."""
        return sorted(StoredFile(name, found.size, found.modified_at) for name, found in self._objects(prefix).items())

    def open(self, prefix: str, name: str) -> OpenFile | None:
        """Open a copy of one object, which is fetched if it has changed; its version is that of the object, on every machine."""
        if not is_shown(name) or self._is_removed(prefix):
            return None
        found = self._bucket.find(f"{prefix}/{name}")
        if found is None:
            return None
        with self._entry(prefix, None) as entry:
            if entry.version(name) != found.version:
                self._fetch(entry, {name: found}, None)
            descriptor = os.open(entry.files / name, os.O_RDONLY | os.O_CLOEXEC)
        return OpenFile(name, descriptor, found.size, found.modified_at, hashlib.sha256(found.version.encode()).hexdigest()[:32])

    def remove(self, prefix: str) -> None:
        """Delete the objects; the object removed/PREFIX exists meanwhile, so that a part of the prefix is not shown."""
        self._bucket.mark(f"{REMOVED}/{prefix}")
        drop_folder(self._scratch / prefix)
        self._bucket.delete([found.path for found in self._bucket.below(prefix)])
        self._bucket.delete([f"{REMOVED}/{prefix}"])

    def leftovers(self) -> list[str]:
        """Return nothing: objects are sent at the end of a step, after which the worker looks whether its job was deleted meanwhile."""
        return []

    def tidy(self) -> None:
        """Delete the prefixes and copies whose deletion was interrupted."""
        for found in self._bucket.below(REMOVED):
            self.remove(found.path.removeprefix(f"{REMOVED}/"))
        drop_hidden(self._scratch)

    def check(self) -> None:
        """Write and delete an object, at most once in CHECK_S."""
        with self._checking:
            if time.monotonic() - self._checked_at >= CHECK_S:
                self._bucket.check(PROBE)
                self._checked_at = time.monotonic()

    def _is_removed(self, prefix: str) -> bool:
        return self._bucket.find(f"{REMOVED}/{prefix}") is not None

    def _objects(self, prefix: str) -> dict[str, Object]:
        if self._is_removed(prefix):
            return {}
        named = ((found.path.removeprefix(f"{prefix}/"), found) for found in self._bucket.below(prefix))
        return {name: found for name, found in named if is_shown(name)}

    def _fetch(self, entry: Entry, missing: dict[str, Object], progress: Progress | None) -> None:
        if not missing:
            return
        self._make_room(sum(found.size for found in missing.values()))

        def fetch(item: tuple[str, Object], moved: Callable[[], None]) -> tuple[str, str]:
            name, found = item
            with replacing(entry.files / name) as temporary:
                self._bucket.fetch(found, temporary, moved)
            return name, found.version

        _transfer("download", list(missing.items()), fetch, entry, progress)

    @contextmanager
    def _entry(self, prefix: str, progress: Progress | None) -> Iterator[Entry]:
        """Lock the copies of a prefix; while another process has the lock, the progress is told that this one lives."""
        path = self._scratch / prefix / LOCK
        while True:
            self.workspace(prefix)  # it may be deleted meanwhile
            with storage("make", path):
                descriptor = file_lock.take(path, 0o644)
            if descriptor is not None:
                break
            if progress is not None:
                progress.advance(0)
            time.sleep(WAIT_S)
        try:
            os.utime(descriptor)
            entry = Entry(path.parent)
            try:
                yield entry
            finally:
                entry.save()
        finally:
            os.close(descriptor)

    def _make_room(self, wanted_bytes: int) -> None:
        """Delete the copies of the prefixes that were unused longest until `wanted_bytes` more fit in; those in use stay."""
        found = sorted((_used_at(lock.parent), _size(lock.parent / FILES), lock.parent)
                       for lock in self._scratch.glob(f"projects/*/*/*/{LOCK}"))
        total = wanted_bytes + sum(size for _, size, _ in found)
        for used_at, size, folder in found:
            if total <= self._scratch_bytes or used_at > time.time() - IN_USE_S:
                return
            drop_folder(folder)
            total -= size


Storage = FolderStorage | ObjectStorage
"""The storage of the files of captures and results. A prefix is one of service.server.storage.layout."""


def open_storage(settings: Settings) -> Storage:
    """Open the storage that the settings name; nothing is written into it."""
    if settings.storage_url is None:
        return FolderStorage(settings.data)
    return ObjectStorage(Bucket(settings.storage_url), settings.data / SCRATCH, settings.scratch_bytes)


class _Ended(Exception):
    """Another transfer has failed."""


def _transfer(stage: str, items: Sequence[T], move: Callable[[T, Callable[[], None]], tuple[str, str]], entry: Entry,
              progress: Progress | None) -> None:
    """Transfer files by `move`, several at one time; the first error ends all transfers, as does an exception of `progress`."""
    if not items:
        return
    if progress is not None:
        progress.stage(stage, len(items))
    ended, bytes_moved = threading.Event(), threading.Event()

    def moved() -> None:
        bytes_moved.set()
        if ended.is_set():
            raise _Ended

    with ThreadPoolExecutor(TRANSFERS, thread_name_prefix=f"relit-{stage}") as pool:
        waiting: set[Future[tuple[str, str]]] = {pool.submit(move, item, moved) for item in items}
        try:
            while waiting:
                done, waiting = wait(waiting, LOOK_S, FIRST_COMPLETED)
                for future in done:
                    entry.note(*future.result())
                if progress is not None and (done or bytes_moved.is_set()):
                    bytes_moved.clear()
                    progress.advance(len(items) - len(waiting))
        except BaseException:
            ended.set()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _state(path: Path) -> list[object]:
    try:
        status = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return []
    return [status.st_size, status.st_mtime_ns]


def _used_at(folder: Path) -> float:
    return max((path.stat().st_mtime for path in (folder / LOCK, folder / FILES) if path.exists()), default=0.0)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
