"""Backups of the service: its database, and then the files of captures and results, while jobs run.

The database is copied first, in one snapshot. Files of the storage get their names only when they are complete and never change
afterwards, so what the database tells about at that moment is there when the files are copied; files that are newer do no harm, because a
step that runs again finds its frames and keeps them. `backup.json`, with the size and the SHA-256 of every file, is written last: without
it a backup is not whole.

With `storage_url` the files of captures and results are objects of a store. `backup.json` names those that there were after the database
was copied, with size and ETag, and `restore` looks for them; or they are copied too, and `restore` sends what the store lacks.
"""

import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import unquote, urlsplit

import sqlalchemy as sa

from service import __version__
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.states import ACTIVE
from service.server.base.settings import Settings
from service.server.database import tables
from service.server.database.engine import Database, connect, usable
from service.server.database.schema import require_current
from service.server.storage import layout
from service.server.storage.bucket import Bucket, Object
from service.server.storage.folder import REMOVED, is_shown
from service.server.storage.objects import TRANSFERS
from stage.errors import StorageError, storage
from stage.files import write_text

T = TypeVar("T")
UNTOLD = Timings()
"""The progress that nobody looks at."""
PROJECTS = "projects"
"""Folder of captures and results, in the data folder and in the backup, and prefix of their objects."""
TRIES = 5
"""Times that an object is fetched that is replaced meanwhile."""


def present(bucket: Bucket, *, pieces: bool) -> dict[str, Object]:
    """Return the objects of captures, results and, with `pieces`, incomplete uploads by path, without those that are being deleted."""
    removed = tuple(f"{found.path.removeprefix(f'{REMOVED}/')}/" for found in bucket.below(REMOVED))
    found = [*bucket.below(PROJECTS), *(bucket.below(layout.PIECES) if pieces else ())]
    return {each.path: each for each in found
            if is_shown(each.path) and not each.path.startswith(removed) and not layout.is_shared(each.path)}


def save(bucket: Bucket, folder: Path) -> dict[str, Object]:
    """Copy the objects into a folder, and return those that were copied; one that is deleted meanwhile is left out."""
    def fetch(found: Object) -> Object | None:
        target = folder / found.path
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
        for left in reversed(range(TRIES)):
            try:
                bucket.fetch(found, target, lambda: None)
                break
            except (StorageError, FileNotFoundError):
                again = bucket.find(found.path)
                if again is None:
                    target.unlink(missing_ok=True)
                    return None
                if again.version == found.version or not left:
                    raise
                found = again
        with storage("write", target), open(target, "rb") as written:
            os.fsync(written.fileno())
            target.chmod(0o600)
        return found

    with ThreadPoolExecutor(TRANSFERS, thread_name_prefix="relit-backup") as pool:
        return {found.path: found for found in pool.map(fetch, present(bucket, pieces=True).values()) if found is not None}


SCHEMA = "relit.backup/1"
CONTENTS, SQLITE, DUMP, OBJECTS = "backup.json", "relit.sqlite", "database.dump", "objects"
BLOCK = 1 << 20


class Backup(NamedTuple):
    """A backup that was made or restored."""

    folder: Path
    files: int
    size: int
    """Bytes of all files."""
    objects: int = 0
    """Objects of the store of `storage_url` that belong to it."""
    copied: bool = False
    """True if copies of the objects are among the files."""
    differing: int = 0
    """Objects that were missing or had changed when it was restored: sent again where there are copies, else accepted."""


def backup(settings: Settings, out: Path, *, copy_objects: bool = False, progress: Progress = UNTOLD) -> Backup:
    """Copy a service, which may run meanwhile, to a new folder; objects of `storage_url` are named unless `copy_objects` is set."""
    progress.stage("database", 1)
    if settings.is_sqlite and not settings.sqlite_file.exists():
        raise RequestError(f"data {settings.data}: there is no service in this folder")
    if out.resolve().is_relative_to(settings.data):
        raise RequestError(f"--out {out}: lies in the data folder, which is to be saved: give a folder elsewhere")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RequestError(f"--out {out}: is not empty: give a new folder")
    if copy_objects and settings.storage_url is None:
        raise RequestError("--objects: this service has no storage_url: its captures and results are in the backup without it")
    bucket = None if settings.storage_url is None else Bucket(settings.storage_url)
    with storage("make", out):
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
    with _opened(settings) as database:
        require_current(database)
    at, active = time.time(), set() if bucket is None else _active_jobs(settings)
    if settings.is_sqlite:
        with usable(settings):
            _copy_sqlite(settings.sqlite_file, out / SQLITE)
    else:
        _postgres(settings, "pg_dump", "--format=custom", "--no-owner", "--no-privileges", f"--file={out / DUMP}")
    found = {name: _entry(out / name) for name in (SQLITE, DUMP) if (out / name).exists()}
    folders = {settings.part_files: _copy}  # to which a client may add meanwhile; one that is complete lies in the next folder
    if settings.storage_url is None:
        folders[settings.data / PROJECTS] = _link
    for folder, keep in folders.items():
        for path in _told(progress, folder.name, list(_files(folder))):
            name = path.relative_to(settings.data).as_posix()
            if keep(path, out / name):
                found[name] = _entry(out / name)
    contents: dict[str, Any] = {"schema": SCHEMA, "version": __version__, "at": at, "files": found}
    objects: dict[str, Object] = {}
    if bucket is not None:
        progress.stage("objects", 1)
        objects = save(bucket, out / OBJECTS) if copy_objects else present(bucket, pieces=False)
        active |= _active_jobs(settings)
        contents["storage"] = {"url": bucket.url, "copied": copy_objects, "objects": {
            path: {"size": each.size, "version": each.version} | ({"changes": True} if layout.is_of_job(path, active) else {})
            for path, each in sorted(objects.items())}}
        if copy_objects:
            found |= {f"{OBJECTS}/{path}": _entry(out / OBJECTS / path) for path in sorted(objects)}
    write_text(out / CONTENTS, json.dumps(contents, indent=1) + "\n")
    return Backup(out, len(found), sum(entry["size"] for entry in found.values()), len(objects), copy_objects)


def restore(settings: Settings, folder: Path, *, accept_differences: bool = False, progress: Progress = UNTOLD) -> Backup:
    """Make a service from a backup, in an empty data folder and database; `accept_differences`: the store may hold other objects."""
    files, stored = _contents(folder)
    kind = SQLITE if settings.is_sqlite else DUMP
    if kind not in files:
        raise RequestError(f"{folder}: is of a service with {'PostgreSQL' if settings.is_sqlite else 'SQLite'}: "
                           f"{'give' if settings.is_sqlite else 'leave out'} database_url")
    if (settings.data / PROJECTS).exists() or (settings.is_sqlite and settings.sqlite_file.exists()):
        raise RequestError(f"data {settings.data}: there is a service in this folder already: give a new one")
    if not settings.is_sqlite:
        with _opened(settings) as database:
            has_tables = bool(sa.inspect(database.engine).get_table_names())
        if has_tables:
            raise RequestError("database_url: the database has tables already: give an empty one")
    for name, entry in _told(progress, "check", files.items()):
        if not (folder / name).is_file() or _entry(folder / name) != entry:
            raise RequestError(f"{folder / name}: is missing or differs from its checksum: the backup is damaged")
    progress.stage("objects", 1)
    differing = _restore_objects(settings, folder, files, stored, accept_differences=accept_differences)
    with storage("make", settings.data):
        settings.data.mkdir(parents=True, exist_ok=True)
    for name in _told(progress, "files", files):
        if name not in (SQLITE, DUMP) and not name.startswith(f"{OBJECTS}/"):
            _copy(folder / name, settings.data / name)
    if settings.is_sqlite:
        _copy(folder / SQLITE, settings.sqlite_file)
    else:
        _postgres(settings, "pg_restore", "--no-owner", "--no-privileges", "--exit-on-error", "--single-transaction", "--dbname",
                  str(urlsplit(str(settings.database_url)).path.lstrip("/")), str(folder / DUMP))
    return Backup(folder, len(files), sum(entry["size"] for entry in files.values()), 0 if stored is None else len(stored["objects"]),
                  stored is not None and stored["copied"], differing)


def _told(progress: Progress, stage: str, items: Collection[T]) -> Iterator[T]:
    """Yield items of a stage, and tell how many are done."""
    progress.stage(stage, max(len(items), 1))
    for done, item in enumerate(items, 1):
        yield item
        progress.advance(done)


@contextmanager
def _opened(settings: Settings) -> Iterator[Database]:
    with usable(settings), closing(connect(settings.sqlalchemy_url, connections=1)) as database:
        yield database


def _active_jobs(settings: Settings) -> set[str]:
    """Return the jobs that have not ended, whose objects may still change."""
    with _opened(settings) as database:
        return {row["id"] for row in database.rows(sa.select(tables.jobs.c.id).where(tables.jobs.c.state.in_(ACTIVE)))}


def _restore_objects(settings: Settings, folder: Path, files: dict[str, dict[str, Any]], stored: dict[str, Any] | None, *,
                     accept_differences: bool) -> int:
    """Look for the objects of a backup in the store, and send those of which there are copies; return how many were missing or differed."""
    if stored is None:
        if settings.storage_url is not None and any(name.startswith(f"{PROJECTS}/") for name in files):
            raise RequestError(f"{folder}: is of a service whose captures and results lie in its data folder: leave out storage_url")
        return 0
    if settings.storage_url is None:
        raise RequestError(f"{folder}: is of a service with storage_url {stored['url']}: give this one, or another"
                           f"{'' if stored['copied'] else ' with the same objects'}")
    bucket, wanted = Bucket(settings.storage_url), stored["objects"]
    found = present(bucket, pieces=True)
    missing = [path for path in wanted if path not in found]
    changed = [path for path, entry in wanted.items()
               if path in found and (found[path].size, found[path].version) != (entry["size"], entry["version"])]
    if stored["copied"]:
        with ThreadPoolExecutor(TRANSFERS, thread_name_prefix="relit-restore") as pool:
            list(pool.map(lambda path: bucket.send(folder / OBJECTS / path, path, lambda: None), [*missing, *changed]))
    else:
        changed = [path for path in changed if not wanted[path].get("changes")]  # its job went on after the backup
        if (missing or changed) and not accept_differences:
            first, fault = (missing[0], "is not in the store") if missing else (changed[0], "is not what it was")
            raise RequestError(f"{bucket.url}/{first}: {fault} ({len(missing)} objects of the backup are missing and {len(changed)} have "
                               "changed): bring them back from the versions of the bucket, or give --accept-differences")
    return len(missing) + len(changed)


def _copy_sqlite(source: Path, target: Path) -> None:
    """Copy a database by SQLite's own means, which see one moment of it."""
    with closing(sqlite3.connect(f"file:{source}?mode=ro", uri=True)) as reading, closing(sqlite3.connect(target)) as writing:
        try:
            reading.backup(writing)
        except sqlite3.Error as error:
            raise RequestError(f"data {source.parent}: the database in it cannot be copied ({error})") from None
    target.chmod(0o600)


def _postgres(settings: Settings, program: str, *arguments: str) -> None:
    """Run a program of PostgreSQL on the database; the password is not an argument, which other users of the machine could read."""
    url = urlsplit(str(settings.database_url))
    variables = {"PGHOST": url.hostname, "PGPORT": url.port, "PGUSER": url.username, "PGPASSWORD": url.password,
                 "PGDATABASE": unquote(url.path.lstrip("/"))}
    environment = os.environ | {name: unquote(str(value)) for name, value in variables.items() if value}
    if shutil.which(program) is None:
        raise RequestError(f"{program} is not on the path: install the client programs of PostgreSQL")
    done = subprocess.run([program, *arguments], env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode != 0:
        raise RequestError(f"{program}: {' '.join(done.stderr.split())[:500]}")


def _contents(folder: Path) -> tuple[dict[str, dict[str, Any]], dict[str, Any] | None]:
    """Return the files of a backup, and of the store of a service with storage_url its URL, its objects and whether these are copied."""
    path = folder / CONTENTS
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        files, stored = found["files"], found.get("storage")
        assert found["schema"] == SCHEMA and isinstance(files, dict)
        if stored is not None:
            assert isinstance(stored["url"], str)
            copied = {f"{OBJECTS}/{path}" for path, entry in stored["objects"].items() if isinstance(entry["version"], str)}
            assert not stored["copied"] or copied <= files.keys()
    except OSError:
        raise RequestError(f"{folder}: is no whole backup: there is no {CONTENTS} in it") from None
    except (ValueError, KeyError, TypeError, AssertionError, RecursionError):
        raise RequestError(f"{path}: is not of the schema {SCHEMA}") from None
    for name in files:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise RequestError(f"{path}: {name} leads out of the backup")
    return files, stored


def _files(folder: Path) -> Iterator[Path]:
    """Yield the complete files below a folder; names with a leading dot are files that are being written."""
    for place, folders, names in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        yield from (Path(place) / name for name in sorted(names) if not name.startswith("."))


def _link(source: Path, target: Path) -> bool:
    """Give a complete file a second name, or copy it to another file system; return False if it was deleted meanwhile."""
    with storage("write", target):
        target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target, follow_symlinks=False)
    except FileNotFoundError:
        return False
    except OSError:
        return _copy(source, target)
    return True


def _copy(source: Path, target: Path) -> bool:
    with storage("write", target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            with open(source, "rb") as reading, open(target, "xb") as writing:
                shutil.copyfileobj(reading, writing, BLOCK)
                writing.flush()
                os.fsync(writing.fileno())
        except FileNotFoundError:
            return False
        target.chmod(0o600)
    return True


def _entry(path: Path) -> dict[str, Any]:
    with open(path, "rb") as file:
        return {"size": path.stat().st_size, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}
