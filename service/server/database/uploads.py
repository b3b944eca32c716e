"""Files on their way into a capture or an environment: one row each, from the first byte until the capture is deleted.

`received` counts bytes that are on the disk and were found right; what lies behind them in the part file is cut off before more come.
"""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from service.server.database.engine import Database
from service.server.database.tables import uploads
from service.server.safe_names import folded, folders_of, shown
from service.server.storage.parts import Part, PartLocked, leftovers

Row = Mapping[str, Any]
"""An upload: the columns of its table."""
AFTER_SLASH = "0"
"""The character behind /: a folder's files are those between the two."""


class PathTaken(Exception):
    """Another file has the path, or one that is the same on some file systems; one sentence."""


def insert(connection: sa.Connection, *, identifier: str, project: str, intake: str, path: str, length: int, sha256: str | None) -> None:
    """Write down a new one, of which nothing has come; the caller holds the capture.

    Args:
        connection: of the caller's transaction.
        identifier: its own.
        project, intake: where it belongs.
        path: within the capture, safe.
        length: bytes that will come.
        sha256: of all of them, where it is known.

    Raises:
        PathTaken: by a file that is not this very one.
    """
    _require_free(connection, intake, path)
    connection.execute(uploads.insert().values(
        id=identifier, project=project, intake=intake, path=path, folded=folded(path), length=length, received=0, sha256=sha256,
        touched_at=time.time(), done=False))


def find(database: Database, identifier: str, project: str) -> Row | None:
    """One of a project."""
    row = database.row(sa.select(uploads).where(uploads.c.id == identifier, uploads.c.project == project))
    return None if row is None else dict(row)


def at_path(connection: sa.Connection, intake: str, path: str) -> sa.RowMapping | None:
    """The one of a path."""
    return connection.execute(sa.select(uploads).where(uploads.c.intake == intake, uploads.c.path == path)).mappings().one_or_none()


def count(connection: sa.Connection, intake: str) -> int:
    """Files of a capture, complete or not."""
    return int(connection.execute(sa.select(sa.func.count()).where(uploads.c.intake == intake)).scalar_one())


def unfinished(connection: sa.Connection, intake: str) -> sa.RowMapping | None:
    """A file of a capture that is not complete."""
    return connection.execute(sa.select(uploads).where(uploads.c.intake == intake, uploads.c.done.is_(False)).limit(1)).mappings().first()


def listing(database: Database, intake: str, *, limit: int, after: str | None = None) -> list[Row]:
    """Files of a capture by path, those behind a path alone where one is given."""
    query = sa.select(uploads).where(uploads.c.intake == intake)
    if after is not None:
        query = query.where(uploads.c.folded > folded(after))
    return [dict(row) for row in database.rows(query.order_by(uploads.c.folded).limit(limit))]


def advance(database: Database, identifier: str, received: int) -> bool:
    """So many bytes are safe; false where the upload is there no more."""
    return _change(database, identifier, received=received)


def finish(database: Database, identifier: str, length: int) -> bool:
    """All bytes are in the storage; false where the upload is there no more."""
    return _change(database, identifier, received=length, done=True)


def remove(connection: sa.Connection, identifier: str) -> bool:
    """Forget one."""
    return connection.execute(uploads.delete().where(uploads.c.id == identifier)).rowcount == 1


def expire(database: Database, folder: Path, before: float) -> int:
    """Remove uploads that nobody has added to since a time, and part files that belong to none.

    Args:
        database: of the store.
        folder: of the part files.
        before: seconds since 1970.

    Returns:
        How many were removed.
    """
    removed = 0
    for row in database.rows(sa.select(uploads.c.id).where(uploads.c.done.is_(False), uploads.c.touched_at < before)):
        removed += _expire(database, folder, row["id"], before)
    for identifier in leftovers(folder, before):
        if database.row(sa.select(uploads.c.id).where(uploads.c.id == identifier, uploads.c.done.is_(False))) is None:
            Part.discard(folder, identifier)
    return removed


def _expire(database: Database, folder: Path, identifier: str, before: float) -> bool:
    try:
        part = Part.open(folder, identifier)
    except PartLocked:  # somebody is adding to it
        return False
    with part:
        gone = database.transact(lambda connection: connection.execute(uploads.delete().where(
            uploads.c.id == identifier, uploads.c.done.is_(False), uploads.c.touched_at < before))).rowcount == 1
        if gone:
            part.drop()
    return gone


def _require_free(connection: sa.Connection, intake: str, path: str) -> None:
    def first(*conditions: "sa.ColumnElement[bool]") -> str | None:
        return connection.execute(sa.select(uploads.c.path).where(uploads.c.intake == intake, *conditions).limit(1)).scalar()

    def inside(folder: str) -> str | None:
        return first(uploads.c.folded >= f"{folded(folder)}/", uploads.c.folded < f"{folded(folder)}{AFTER_SLASH}")

    if other := first(uploads.c.folded == folded(path)):
        raise PathTaken(f"path {shown(path)}: is there already" if other == path else
                        f"path {shown(path)}: {shown(other)} is there already, the same where upper and lower case are not told apart")
    if other := inside(path):
        raise PathTaken(f"path {shown(path)}: is a folder already, that of {shown(other)}")
    for folder in folders_of(path):
        if other := first(uploads.c.folded == folded(folder)):
            raise PathTaken(f"path {shown(path)}: {shown(other)} is a file, not a folder")
        if (other := inside(folder)) and not other.startswith(f"{folder}/"):
            raise PathTaken(f"path {shown(path)}: lies in the folder of {shown(other)} where upper and lower case are not told apart")


def _change(database: Database, identifier: str, **values: int | bool) -> bool:
    return database.transact(lambda connection: connection.execute(uploads.update().where(uploads.c.id == identifier).values(
        touched_at=time.time(), **values))).rowcount == 1
