"""What was handed in to be worked on: captures and environments, uploaded or registered where they lie.

receiving (an upload) → checking → ready | refused. What is checking or ready is not written to any more.
"""

import time
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from service.server.database.engine import Database, storable
from service.server.database.jobs import PATIENCE_S
from service.server.database.tables import intakes, job_inputs, jobs, newest_first, uploads
from service.views.states import CHECKING, READY, RECEIVING, REFUSED


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
    return database.rows(newest_first(query, intakes, limit=limit, before=before))


def lock_for_files(connection: sa.Connection, identifier: str, project: str) -> bool:
    """Keep one that takes files from being checked or deleted until the transaction ends; what was refused is being mended now.

    Returns:
        False where it is not there, or takes none.
    """
    return connection.execute(intakes.update().where(
        intakes.c.id == identifier, intakes.c.project == project, intakes.c.folder.is_(None), intakes.c.state.in_((RECEIVING, REFUSED)),
    ).values(state=RECEIVING, problem=None)).rowcount == 1


def last_used(database: Database, identifiers: Sequence[str]) -> dict[str, float]:
    """Of those that there are: when a job that reads it last changed, or when it was created."""
    used = sa.func.coalesce(sa.func.max(jobs.c.updated_at), intakes.c.created_at).label("used")
    read = intakes.outerjoin(job_inputs, job_inputs.c.input == intakes.c.id).outerjoin(jobs, jobs.c.id == job_inputs.c.job)
    query = sa.select(intakes.c.id, used).select_from(read).where(intakes.c.id.in_(identifiers))
    return {row["id"]: row["used"] for row in database.rows(query.group_by(intakes.c.id, intakes.c.created_at))}


def begin_check(connection: sa.Connection, identifier: str) -> bool:
    """Take no more files, and wait for the check; false where it is checking or ready already."""
    return connection.execute(intakes.update().where(intakes.c.id == identifier, intakes.c.state.in_((RECEIVING, REFUSED))).values(
        state=CHECKING, problem=None)).rowcount == 1


def accept(database: Database, identifier: str, facts: dict[str, Any]) -> None:
    """The check found nothing wrong."""
    _judge(database, identifier, state=READY, facts=facts, problem=None)


def refuse(database: Database, identifier: str, problem: str) -> None:
    """The check found something: an upload may be mended and checked again."""
    _judge(database, identifier, state=REFUSED, problem=storable(problem))


def remove(connection: sa.Connection, identifier: str) -> list[str] | None:
    """Forget one, and its uploads.

    Returns:
        Identifiers of uploads that were not complete; None where it was not there.
    """
    connection.execute(intakes.update().where(intakes.c.id == identifier).values(name=intakes.c.name))  # no upload may come meanwhile
    parts = list(connection.execute(sa.select(uploads.c.id).where(uploads.c.intake == identifier, uploads.c.done.is_(False))).scalars())
    connection.execute(uploads.delete().where(uploads.c.intake == identifier))
    return parts if connection.execute(intakes.delete().where(intakes.c.id == identifier)).rowcount == 1 else None


def _judge(database: Database, identifier: str, **values: Any) -> None:
    database.transact(lambda connection: connection.execute(intakes.update().where(
        intakes.c.id == identifier, intakes.c.state == CHECKING).values(**values)), patience_s=PATIENCE_S)
