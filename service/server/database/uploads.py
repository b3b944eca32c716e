"""Uploads: a row for each file of a capture or an environment, from its creation until the capture is deleted.

`received` counts bytes that are on the disk and verified; what the part file has behind them is cut off before more is appended.
"""

import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import sqlalchemy as sa

from service.requests.base.identifiers import UPLOAD, new_id
from service.server.base.safe_names import folded, folders_of, shown
from service.server.database.engine import Database
from service.server.database.tables import uploads

Row = Mapping[Any, Any]
"""A row of the uploads table."""
AFTER_SLASH = "0"
"""The character after /: the paths of the files in a folder sort between the two."""


class PathTaken(Exception):
    """Another file has the path, or one that some file systems take for the same; the message is one sentence."""


def insert(connection: sa.Connection, *, project: str, intake: str, path: str, length: int, sha256: str | None = None,
           made: bool = False) -> str:
    """Insert an upload without bytes, and return its identifier; the caller has locked the intake.

    `made`: the service has made the file and put it into the storage, in place of another of this path.
    """
    if made:
        connection.execute(uploads.delete().where(uploads.c.intake == intake, uploads.c.path == path))
    _require_free(connection, intake, path)
    identifier = new_id(UPLOAD)
    connection.execute(uploads.insert().values(
        id=identifier, project=project, intake=intake, path=path, folded=folded(path), length=length, sha256=sha256, touched_at=time.time(),
        received=length if made else 0, done=made))
    return identifier


def find(database: Database, identifier: str, project: str) -> Row | None:
    """Return an upload of a project, or None."""
    return database.row(sa.select(uploads).where(uploads.c.id == identifier, uploads.c.project == project))


def at_path(connection: sa.Connection, intake: str, path: str) -> Row | None:
    """Return the upload that will be stored at `path`, or None."""
    return connection.execute(sa.select(uploads).where(uploads.c.intake == intake, uploads.c.path == path)).mappings().one_or_none()


def count(connection: sa.Connection, intake: str) -> int:
    """Return the number of files of an intake, complete or not."""
    return int(connection.execute(sa.select(sa.func.count()).where(uploads.c.intake == intake)).scalar_one())


def unfinished(connection: sa.Connection, intake: str) -> Row | None:
    """Return a file of an intake that is not complete; None: all are complete."""
    return connection.execute(sa.select(uploads).where(uploads.c.intake == intake, uploads.c.done.is_(False)).limit(1)).mappings().first()


def listing(database: Database, intake: str, *, limit: int, after: str | None = None) -> Sequence[Row]:
    """Return a page of the files of an intake, by path; with `after`, those after that path."""
    query = sa.select(uploads).where(uploads.c.intake == intake)
    if after is not None:
        query = query.where(uploads.c.folded > folded(after))
    return database.rows(query.order_by(uploads.c.folded).limit(limit))


def take(database: Database, identifier: str, writer: str, *, now: float, until: float) -> bool:
    """Let a writer change an upload until a time (seconds since 1970); return False if another has it, or it was deleted."""
    free = uploads.c.writer.is_(None) | (uploads.c.writer_until < now)
    return database.execute(uploads.update().where(uploads.c.id == identifier, free).values(writer=writer, writer_until=until)) == 1


def renew(database: Database, writers: Collection[str], until: float) -> None:
    """Let writers change their uploads until a later time."""
    database.execute(uploads.update().where(uploads.c.writer.in_(writers)).values(writer_until=until))


def release(database: Database, identifier: str, writer: str) -> None:
    """Let others change an upload that this writer has."""
    mine = uploads.c.id == identifier, uploads.c.writer == writer
    database.execute(uploads.update().where(*mine).values(writer=None, writer_until=None))


def advance(database: Database, identifier: str, received: int, *, writer: str | None = None,
            pieces: Sequence[tuple[str, int]] | None = None) -> bool:
    """Record the number of bytes that are safe; return False if the upload was deleted, or the `writer`, if given, has it no longer.

    `pieces` are names and lengths of the objects that hold the bytes; None: they are not in objects.
    """
    values: dict[str, Any] = {"received": received} | ({} if pieces is None else {"pieces": [list(piece) for piece in pieces]})
    return _change(database, identifier, writer, values)


def finish(database: Database, identifier: str, length: int, *, writer: str | None = None) -> bool:
    """Record that the complete file is in the storage; the arguments and the answer are those of `advance`."""
    return _change(database, identifier, writer, {"received": length, "done": True, "pieces": []})


def remove(connection: sa.Connection, identifier: str) -> bool:
    """Delete an upload; return False if there is none."""
    return connection.execute(uploads.delete().where(uploads.c.id == identifier)).rowcount == 1


def untouched(database: Database, before: float) -> Sequence[Row]:
    """Return the uploads that were not continued since a time."""
    return database.rows(sa.select(uploads).where(uploads.c.done.is_(False), uploads.c.touched_at < before))


def unfinished_of(database: Database, identifiers: Collection[str]) -> set[str]:
    """Return those of the uploads that exist and are not complete."""
    return {row["id"] for row in database.rows(sa.select(uploads.c.id).where(uploads.c.id.in_(identifiers), uploads.c.done.is_(False)))}


def drop_untouched(database: Database, identifier: str, before: float) -> bool:
    """Delete the row of an upload unless it was continued since a time; return whether it was deleted."""
    old = uploads.c.id == identifier, uploads.c.done.is_(False), uploads.c.touched_at < before
    return database.execute(uploads.delete().where(*old)) == 1


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


def _change(database: Database, identifier: str, writer: str | None, values: Mapping[str, Any]) -> bool:
    mine = [uploads.c.id == identifier] + ([] if writer is None else [uploads.c.writer == writer])
    return database.execute(uploads.update().where(*mine).values(touched_at=time.time(), **values)) == 1
