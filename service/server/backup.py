"""Backups of the service: its database, and then the files of captures and results, while jobs run.

The database is copied first, in one snapshot. Files of the storage get their names only when they are complete and never change
afterwards, so what the database tells about at that moment is there when the files are copied; files that are newer do no harm, because a
step that runs again finds its frames and keeps them. `backup.json`, with the size and the SHA-256 of every file, is written last: without
it a backup is not whole.
"""

import hashlib
import json
import os
import shutil
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import unquote, urlsplit

import sqlalchemy as sa

from service import __version__
from service.errors import RequestError
from service.server.database.engine import connect, usable
from service.server.database.schema import require_current
from service.server.settings import Settings
from service.server.storage.part_files import part_files_folder
from stage.errors import storage
from stage.files import write_text

SCHEMA = "relit.backup/1"
CONTENTS, SQLITE, DUMP = "backup.json", "relit.sqlite", "database.dump"
PROJECTS = "projects"
"""Folder of captures and results, in the data folder and in the backup."""
BLOCK = 1 << 20


class Backup(NamedTuple):
    """A backup that was made or restored."""

    folder: Path
    files: int
    size: int
    """Bytes of all files."""


def backup(settings: Settings, out: Path) -> Backup:
    """Copy the database and the files of a service, which may run meanwhile.

    Args:
        settings: of the service.
        out: folder that does not exist or is empty.

    Raises:
        RequestError: there is no service, the folder is not empty, or the database cannot be copied; nothing is changed in the service.
        StorageError: the folder cannot be written.
    """
    if settings.is_sqlite and not settings.sqlite_file.exists():
        raise RequestError(f"data {settings.data}: there is no service in this folder")
    if out.resolve().is_relative_to(settings.data):
        raise RequestError(f"--out {out}: lies in the data folder, which is to be saved: give a folder elsewhere")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RequestError(f"--out {out}: is not empty: give a new folder")
    with storage("make", out):
        out.mkdir(parents=True, exist_ok=True, mode=0o700)
    with usable(settings):
        database = connect(settings.sqlalchemy_url, connections=1)
        require_current(database)
        database.close()
    at = time.time()
    if settings.is_sqlite:
        with usable(settings):
            _copy_sqlite(settings.sqlite_file, out / SQLITE)
    else:
        _postgres(settings, "pg_dump", "--format=custom", "--no-owner", "--no-privileges", f"--file={out / DUMP}")
    found = {name: _entry(out / name) for name in (SQLITE, DUMP) if (out / name).exists()}
    if settings.storage_url is None:
        for path in _files(settings.data / PROJECTS):
            name = path.relative_to(settings.data).as_posix()
            if _link(path, out / name):
                found[name] = _entry(out / name)
    folder = part_files_folder(settings)
    for path in _files(folder):  # a client may add to them meanwhile, so they are copied
        name = path.relative_to(settings.data).as_posix()
        if _copy(path, out / name):
            found[name] = _entry(out / name)
    write_text(out / CONTENTS, json.dumps({"schema": SCHEMA, "version": __version__, "at": at, "files": found}, indent=1) + "\n")
    return Backup(out, len(found), sum(entry["size"] for entry in found.values()))


def restore(settings: Settings, folder: Path) -> Backup:
    """Make a service from a backup; workers take over the jobs that ran when it was made.

    Args:
        settings: of the new service, whose data folder is empty and whose database has no tables.
        folder: the backup.

    Raises:
        RequestError: the backup is not whole or damaged, or there is a service already; nothing is changed then.
        StorageError: the data folder cannot be written.
    """
    files = _contents(folder)
    kind = SQLITE if settings.is_sqlite else DUMP
    if kind not in files:
        raise RequestError(f"{folder}: is of a service with {'PostgreSQL' if settings.is_sqlite else 'SQLite'}: "
                           f"{'give' if settings.is_sqlite else 'leave out'} database_url")
    if (settings.data / PROJECTS).exists() or (settings.is_sqlite and settings.sqlite_file.exists()):
        raise RequestError(f"data {settings.data}: there is a service in this folder already: give a new one")
    if not settings.is_sqlite:
        with usable(settings):
            database = connect(settings.sqlalchemy_url, connections=1)
            tables = sa.inspect(database.engine).get_table_names()
            database.close()
        if tables:
            raise RequestError("database_url: the database has tables already: give an empty one")
    for name, entry in files.items():
        if not (folder / name).is_file() or _entry(folder / name) != entry:
            raise RequestError(f"{folder / name}: is missing or differs from its checksum: the backup is damaged")
    with storage("make", settings.data):
        settings.data.mkdir(parents=True, exist_ok=True)
    for name in files:
        if name not in (SQLITE, DUMP):
            _copy(folder / name, settings.data / name)
    if settings.is_sqlite:
        _copy(folder / SQLITE, settings.sqlite_file)
    else:
        _postgres(settings, "pg_restore", "--no-owner", "--no-privileges", "--exit-on-error", "--single-transaction", "--dbname",
                  str(urlsplit(str(settings.database_url)).path.lstrip("/")), str(folder / DUMP))
    return Backup(folder, len(files), sum(entry["size"] for entry in files.values()))


def _copy_sqlite(source: Path, target: Path) -> None:
    """Copy a database by SQLite's own means, which see one moment of it."""
    reading, writing = sqlite3.connect(f"file:{source}?mode=ro", uri=True), sqlite3.connect(target)
    try:
        reading.backup(writing)
    except sqlite3.Error as error:
        raise RequestError(f"data {source.parent}: the database in it cannot be copied ({error})") from None
    finally:
        reading.close()
        writing.close()
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


def _contents(folder: Path) -> dict[str, dict[str, Any]]:
    path = folder / CONTENTS
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        files = found["files"]
        assert found["schema"] == SCHEMA
    except OSError:
        raise RequestError(f"{folder}: is no whole backup: there is no {CONTENTS} in it") from None
    except (ValueError, KeyError, TypeError, AssertionError, RecursionError):
        raise RequestError(f"{path}: is not of the schema {SCHEMA}") from None
    for name in files:
        if Path(name).is_absolute() or ".." in Path(name).parts:
            raise RequestError(f"{path}: {name} leads out of the backup")
    return dict(files)


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
