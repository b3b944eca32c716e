"""The checks of `relit doctor` on a service; nothing is made or changed."""

import os
import shutil
from collections.abc import Iterator
from contextlib import closing
from importlib.metadata import version
from typing import NamedTuple

from sqlalchemy.exc import DBAPIError

from service.requests.states import ACTIVE, ENDED
from service.server.base.settings import Settings, unknown_variables
from service.server.database import jobs, keys, workers
from service.server.database.engine import Database, DatabaseError, connect
from service.server.database.schema import require_current
from service.server.storage.objects import open_storage
from stage.colour.configuration import current
from stage.errors import ColourError, StorageError

LIBRARIES = ("dbos", "fastapi", "sqlalchemy", "uvicorn", "psycopg")
GIB = 1024**3


class Finding(NamedTuple):
    """A line of the report."""

    subject: str
    text: str
    fault: bool = False


def look(settings: Settings) -> Iterator[Finding]:
    """Yield what is found about the service of these settings."""
    yield Finding("service", ", ".join(f"{name} {version(name)}" for name in LIBRARIES))
    try:
        yield Finding("colours", current().label)
    except ColourError as error:
        yield Finding("colours", str(error), True)
    for name, near in unknown_variables(os.environ).items():
        yield Finding("settings", f"{name} is no setting" + (f": is {near} meant?" if near else ""), True)
    yield from _storage(settings)
    for project, root in (*((None, root) for root in settings.roots), *settings.project_roots):
        there = root.is_dir() and os.access(root, os.R_OK | os.X_OK)
        owner = "" if project is None else f" of {project}"
        yield Finding("root", f"{root}{owner} " + ("can be read" if there else "is no folder that can be read"), not there)
    if settings.is_sqlite and not settings.sqlite_file.exists():
        yield Finding("database", f"{settings.sqlite_file} is not there yet: relit serve makes it")
        return
    try:
        with closing(connect(settings.sqlalchemy_url, connections=1)) as database:
            require_current(database)
            yield Finding("database", f"{settings.sqlite_file if settings.is_sqlite else 'PostgreSQL'} answers")
            yield from _database(settings, database)
    except DatabaseError as error:
        yield Finding("database", str(error), True)
    except DBAPIError as error:
        yield Finding("database", f"does not answer: {' '.join(str(error.orig).split())}", True)


def _storage(settings: Settings) -> Iterator[Finding]:
    if not settings.data.is_dir():
        yield Finding("data", f"{settings.data} is no folder", True)
        return
    try:
        open_storage(settings).check()
        yield Finding("storage", f"{settings.data if settings.storage_url is None else settings.storage_url} can be written")
    except StorageError as error:
        yield Finding("storage", str(error), True)
    free = shutil.disk_usage(settings.data).free
    full = free < settings.min_free_bytes
    yield Finding("space", f"{free / GIB:.1f} GiB free" + (f", less than min_free_bytes ({settings.min_free_bytes / GIB:.1f} GiB)" if full
                                                           else ""), full)


def _database(settings: Settings, database: Database) -> Iterator[Finding]:
    made = [row for row in keys.listing(database) if row["revoked_at"] is None]
    if made:
        yield Finding("keys", f"{len(made)}, of {len({row['project'] for row in made})} projects")
    else:
        yield Finding("keys", "none: requests without a key are let in" if settings.anonymous else
                      "none, and requests without a key are refused: relit keys create makes one", not settings.anonymous)
    counts = jobs.counts(database)
    yield Finding("jobs", ", ".join(f"{counts[state]} {state}" for state in (*ACTIVE, *ENDED) if state in counts) or "none")
    present = workers.seen_lately(database)
    waiting = sum(counts.get(state, 0) for state in ACTIVE)
    for worker in present:
        yield Finding("worker", f"{worker['id']} on {worker['device']}, {worker['state']}")
    if not present:
        wait = f", and {waiting} jobs wait" if waiting else ""
        yield Finding("worker", f"none was seen in the last {workers.SILENT_S:g} seconds{wait}", waiting > 0)
