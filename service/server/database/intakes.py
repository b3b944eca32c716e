"""Intakes: captures and environments, uploaded or registered where they lie, and the annotations of captures, which go with them.

receiving (an upload) → checking → ready | refused. The files of an intake do not change while it is checking or ready.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from service.requests.base.identifiers import ANNOTATION, new_id
from service.requests.states import CHECKING, READY, RECEIVING, REFUSED
from service.server.database.engine import Database, storable
from service.server.database.jobs import PATIENCE_S
from service.server.database.tables import annotations, intakes, job_inputs, jobs, newest_first, uploads

MOST_ANNOTATIONS = 500
"""Annotations of one capture."""
PROPOSAL = "proposal"
"""The fact of a capture that has no manifest: how its files can be imported."""


def insert(connection: sa.Connection, *, project: str, kind: str, name: str, folder: Path | None = None) -> str:
    """Insert an intake, and return its identifier: receiving an upload if `folder` is None, else registered and about to be checked."""
    identifier = new_id(kind)
    connection.execute(intakes.insert().values(
        id=identifier, project=project, kind=kind, name=name, folder=None if folder is None else str(folder), created_at=time.time(),
        state=RECEIVING if folder is None else CHECKING))
    return identifier


def find(database: Database, identifier: str, project: str) -> sa.RowMapping | None:
    """Return an intake of a project, or None."""
    return database.row(sa.select(intakes).where(intakes.c.id == identifier, intakes.c.project == project))


def read_by(database: Database, job: str) -> list[sa.RowMapping]:
    """Return the intakes that a job reads."""
    return database.rows(sa.select(intakes).join(job_inputs, job_inputs.c.input == intakes.c.id).where(job_inputs.c.job == job))


def time_steps(intake: sa.RowMapping | None) -> int:
    """Return how many time steps a sequence of captures has; 0: the intake is no sequence, or there is none."""
    facts = {} if intake is None else intake["facts"] or {}
    captures = int(facts.get("captures", 0))
    return int(facts.get("steps", captures if captures > 1 else 0))  # "steps" is not among the facts of older checks


def latest(database: Database, project: str, kind: str, *, limit: int, before: sa.RowMapping | None = None) -> list[sa.RowMapping]:
    """Return a page of the intakes of a project, the newest first; `before` is that of `jobs.latest`."""
    query = sa.select(intakes).where(intakes.c.project == project, intakes.c.kind == kind)
    return database.rows(newest_first(query, intakes, limit=limit, before=before))


def lock_for_files(connection: sa.Connection, identifier: str, project: str) -> bool:
    """Lock an intake that receives files, also one that was refused, until the transaction ends; return False if its files are fixed."""
    return connection.execute(intakes.update().where(
        intakes.c.id == identifier, intakes.c.project == project, intakes.c.folder.is_(None), intakes.c.state.in_((RECEIVING, REFUSED)),
    ).values(state=RECEIVING, problem=None, facts=sa.null())).rowcount == 1


def last_used(database: Database, identifiers: Sequence[str]) -> dict[str, float]:
    """Return for each intake that exists when a job that reads it last changed or, without such a job, when it was created."""
    used = sa.func.coalesce(sa.func.max(jobs.c.updated_at), intakes.c.created_at).label("used")
    read = intakes.outerjoin(job_inputs, job_inputs.c.input == intakes.c.id).outerjoin(jobs, jobs.c.id == job_inputs.c.job)
    query = sa.select(intakes.c.id, used).select_from(read).where(intakes.c.id.in_(identifiers))
    return {row["id"]: row["used"] for row in database.rows(query.group_by(intakes.c.id, intakes.c.created_at))}


def begin_check(connection: sa.Connection, identifier: str) -> bool:
    """Let an intake receive no more files and wait for its check; return False if it is checking or ready already."""
    return connection.execute(intakes.update().where(intakes.c.id == identifier, intakes.c.state.in_((RECEIVING, REFUSED))).values(
        state=CHECKING, problem=None)).rowcount == 1


def accept(database: Database, identifier: str, facts: dict[str, Any], allow: Callable[[sa.Connection], None] | None = None) -> None:
    """Record the facts of a check that found nothing wrong; `allow` is called in the transaction, and raises if the project may not.

    Nothing happens to an intake that is not checking any more: another run of the same job has judged it.
    """
    _judge(database, identifier, allow, state=READY, facts=facts, problem=None)


def propose(database: Database, identifier: str, proposal: dict[str, Any]) -> None:
    """Record how the files of a capture can be imported; it receives files again."""
    _judge(database, identifier, None, state=RECEIVING, facts={PROPOSAL: proposal}, problem=None)


def refuse(database: Database, identifier: str, problem: str) -> None:
    """Record the problem that the check found; the files of an upload may then be replaced and checked again."""
    _judge(database, identifier, None, state=REFUSED, problem=storable(problem))


def remove(connection: sa.Connection, identifier: str) -> list[str] | None:
    """Delete an intake and its uploads; return the uploads that were not complete, or None if there is no such intake."""
    # locks the row, so that no upload begins meanwhile
    connection.execute(intakes.update().where(intakes.c.id == identifier).values(name=intakes.c.name))
    parts = list(connection.execute(sa.select(uploads.c.id).where(uploads.c.intake == identifier, uploads.c.done.is_(False))).scalars())
    connection.execute(uploads.delete().where(uploads.c.intake == identifier))
    return parts if connection.execute(intakes.delete().where(intakes.c.id == identifier)).rowcount == 1 else None


def annotations_of(database: Database, capture: str) -> list[sa.RowMapping]:
    """Return the annotations of a capture, the oldest first."""
    of_capture = sa.select(annotations).where(annotations.c.intake == capture)
    return database.rows(of_capture.order_by(annotations.c.created_at, annotations.c.id))


def annotate(connection: sa.Connection, capture: str, content: dict[str, object]) -> sa.RowMapping | None:
    """Insert an annotation, and return its row; None: the capture has MOST_ANNOTATIONS already, or is gone."""
    locked = intakes.update().where(intakes.c.id == capture).values(name=intakes.c.name)  # so that the count stays
    if connection.execute(locked).rowcount != 1:
        return None
    if connection.execute(sa.select(sa.func.count()).where(annotations.c.intake == capture)).scalar_one() >= MOST_ANNOTATIONS:
        return None
    return connection.execute(annotations.insert().values(
        id=new_id(ANNOTATION), intake=capture, content=content, created_at=time.time()).returning(annotations)).mappings().one()


def remove_annotation(connection: sa.Connection, capture: str, identifier: str) -> bool:
    """Delete an annotation of a capture; return False if there is none."""
    return connection.execute(annotations.delete().where(annotations.c.id == identifier, annotations.c.intake == capture)).rowcount == 1


def _judge(database: Database, identifier: str, allow: Callable[[sa.Connection], None] | None, **values: Any) -> None:
    def work(connection: sa.Connection) -> None:
        checking = intakes.c.id == identifier, intakes.c.state == CHECKING
        # locks the row; the intake itself must not count yet where `allow` asks for quotas
        if connection.execute(intakes.update().where(*checking).values(state=CHECKING)).rowcount == 1:
            if allow is not None:
                allow(connection)
            connection.execute(intakes.update().where(*checking).values(**values))

    database.transact(work, patience_s=PATIENCE_S)
