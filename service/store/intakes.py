"""What was handed in to be worked on: captures and environments, uploaded or registered where they lie.

receiving (an upload) → checking → ready | refused. What is checking or ready is not written to any more.
"""

import time
from typing import Any

import sqlalchemy as sa

from service.store.database import Database
from service.store.jobs import PATIENCE_S
from service.store.tables import intakes, uploads

RECEIVING, CHECKING, READY, REFUSED = "receiving", "checking", "ready", "refused"


def insert(connection: sa.Connection, *, identifier: str, project: str, kind: str, name: str, folder: str | None) -> None:
    """Write down a new one: receiving an upload, or registered and about to be checked."""
    connection.execute(intakes.insert().values(id=identifier, project=project, kind=kind, name=name, folder=folder, created_at=time.time(),
                                               state=RECEIVING if folder is None else CHECKING))


def find(database: Database, identifier: str, project: str) -> sa.RowMapping | None:
    """One of a project."""
    return database.row(sa.select(intakes).where(intakes.c.id == identifier, intakes.c.project == project))


def latest(database: Database, project: str, kind: str, *, limit: int, before: tuple[float, str] | None = None) -> list[sa.RowMapping]:
    """Those of a project, the newest first; `before` as in `jobs.latest`."""
    query = sa.select(intakes).where(intakes.c.project == project, intakes.c.kind == kind)
    if before is not None:
        query = query.where(sa.tuple_(intakes.c.created_at, intakes.c.id) < sa.tuple_(*before))
    return database.rows(query.order_by(intakes.c.created_at.desc(), intakes.c.id.desc()).limit(limit))


def close(connection: sa.Connection, identifier: str) -> bool:
    """Take no more files, and wait for the check; false where it is checking or ready already."""
    return connection.execute(intakes.update().where(intakes.c.id == identifier, intakes.c.state.in_((RECEIVING, REFUSED))).values(
        state=CHECKING, problem=None)).rowcount == 1


def accept(database: Database, identifier: str, facts: dict[str, Any]) -> None:
    """The check found nothing wrong."""
    _judge(database, identifier, state=READY, facts=facts, problem=None)


def refuse(database: Database, identifier: str, problem: str) -> None:
    """The check found something: an upload may be mended and checked again."""
    _judge(database, identifier, state=REFUSED, problem=problem)


def remove(connection: sa.Connection, identifier: str) -> bool:
    """Forget one, and its uploads."""
    connection.execute(uploads.delete().where(uploads.c.intake == identifier))
    return connection.execute(intakes.delete().where(intakes.c.id == identifier)).rowcount == 1


def _judge(database: Database, identifier: str, **values: Any) -> None:
    database.transact(lambda connection: connection.execute(intakes.update().where(
        intakes.c.id == identifier, intakes.c.state == CHECKING).values(**values)), patience_s=PATIENCE_S)
