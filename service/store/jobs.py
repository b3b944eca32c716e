"""Jobs: what was asked, how far it is, how it ended.

queued → running → succeeded | failed | cancelled; failed and cancelled → queued again, as the next attempt. Every change of a worker
names the attempt that it works on, so that one which was cancelled or given up for dead changes nothing any more.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from service.identifiers import JOB, new_id
from service.job_requests import ANY_JOB, JobRequest
from service.store.database import Database
from service.store.tables import job_inputs, jobs

QUEUED, RUNNING, SUCCEEDED, FAILED, CANCELLED = "queued", "running", "succeeded", "failed", "cancelled"
ACTIVE, ENDED = (QUEUED, RUNNING), (SUCCEEDED, FAILED, CANCELLED)
PATIENCE_S = 600.0
"""How long a worker waits for a database that does not answer."""


class Progress(NamedTuple):
    """Where a job is."""

    stage: str
    done: int
    total: int
    rate: float | None
    """Steps a second."""


def insert(connection: sa.Connection, *, project: str, key: str | None, request: JobRequest, chunk_frames: int,
           inputs: Iterable[str]) -> str:
    """Write down a new job in the caller's transaction.

    Args:
        connection: of the transaction.
        project, key: whose it is.
        request: what is asked.
        chunk_frames: frames of a step; kept, so that the steps of a job stay the same whatever the settings become.
        inputs: identifiers of what it reads.

    Returns:
        Its identifier.
    """
    identifier, now = new_id(JOB), time.time()
    connection.execute(jobs.insert().values(
        id=identifier, project=project, key=key, request=request.model_dump(mode="json", by_alias=True), chunk_frames=chunk_frames,
        priority=request.priority, state=QUEUED, attempt=1, revision=1, created_at=now, updated_at=now, lost=0, finished_steps=[]))
    if rows := [{"job": identifier, "input": name} for name in dict.fromkeys(inputs)]:
        connection.execute(job_inputs.insert(), rows)
    return identifier


def find(database: Database, job: str, project: str | None = None) -> sa.RowMapping | None:
    """One job; of a project, where one is named."""
    query = sa.select(jobs).where(jobs.c.id == job)
    return database.row(query if project is None else query.where(jobs.c.project == project))


def latest(database: Database, project: str, *, states: Sequence[str] = (), limit: int, before: tuple[float, str] | None = None,
           ) -> list[sa.RowMapping]:
    """Jobs of a project, the newest first.

    Args:
        database: where they are.
        project: whose.
        states: of these alone; none: of all.
        limit: how many at most.
        before: creation time and identifier of the last one of the page before.
    """
    query = sa.select(jobs).where(jobs.c.project == project)
    if states:
        query = query.where(jobs.c.state.in_(states))
    if before is not None:
        query = query.where(sa.tuple_(jobs.c.created_at, jobs.c.id) < sa.tuple_(*before))
    return database.rows(query.order_by(jobs.c.created_at.desc(), jobs.c.id.desc()).limit(limit))


def revisions(database: Database, identifiers: Sequence[str]) -> dict[str, sa.RowMapping]:
    """Jobs by identifier, for those who watch them."""
    return {row["id"]: row for row in database.rows(sa.select(jobs).where(jobs.c.id.in_(identifiers)))}


def count_queued(connection: sa.Connection, project: str, key: str | None) -> int:
    """Jobs of a key that have not begun."""
    query = sa.select(sa.func.count()).where(jobs.c.project == project, jobs.c.state == QUEUED,
                                             jobs.c.key.is_(None) if key is None else jobs.c.key == key)
    return int(connection.execute(query).scalar_one())


def counts(database: Database) -> dict[str, int]:
    """Jobs by state."""
    return {row["state"]: row["count"] for row in database.rows(
        sa.select(jobs.c.state, sa.func.count().label("count")).group_by(jobs.c.state))}


def users_of(connection: sa.Connection, input_id: str, *, active: bool) -> list[str]:
    """Identifiers of jobs that read something; active: of those alone which have not ended."""
    query = sa.select(jobs.c.id).join(job_inputs, job_inputs.c.job == jobs.c.id).where(job_inputs.c.input == input_id)
    return list(connection.execute(query.where(jobs.c.state.in_(ACTIVE)) if active else query).scalars())


def begin(database: Database, job: str, attempt: int, worker: str) -> bool:
    """A worker takes a job up; false where it is not to be done any more."""
    now = time.time()
    return _change(database, job, attempt, state=RUNNING, worker=worker, started_at=sa.func.coalesce(jobs.c.started_at, now))


def is_wanted(database: Database, job: str, attempt: int) -> bool:
    """Whether a worker shall go on with an attempt."""
    row = database.row(sa.select(jobs.c.state, jobs.c.attempt).where(jobs.c.id == job))
    return row is not None and row["attempt"] == attempt and row["state"] in ACTIVE


def advance(database: Database, job: str, attempt: int, progress: Progress) -> bool:
    """Note where a running job is; lost where the database does not answer at once."""
    return _change(database, job, attempt, patience_s=0.0, **progress._asdict())


def finish_step(database: Database, job: str, attempt: int, steps: Sequence[str]) -> bool:
    """Note the steps that are finished: all of them, this one too."""
    return _change(database, job, attempt, finished_steps=list(steps), lost=0)


def end(database: Database, job: str, attempt: int, state: str, error: str | None = None) -> bool:
    """A worker ends a job."""
    done: dict[str, Any] = {"done": jobs.c.total} if state == SUCCEEDED else {}  # what was told last may lie half a second back
    return _change(database, job, attempt, state=state, error=error, finished_at=time.time(), **done)


def lose_worker(connection: sa.Connection, job: str, attempt: int, limit: int, sentence: str) -> bool:
    """A worker died with this job; false where it has lost too many, and has failed.

    Args:
        connection: of the caller's transaction.
        job, attempt: what it worked on.
        limit: workers that a job may lose in one step.
        sentence: the error of a job that lost more.
    """
    row = connection.execute(sa.select(jobs.c.lost).where(
        jobs.c.id == job, jobs.c.attempt == attempt, jobs.c.state.in_(ACTIVE)).with_for_update()).one_or_none()
    if row is None:
        return False
    lost, now = row.lost + 1, time.time()
    failed = lost > limit
    connection.execute(jobs.update().where(jobs.c.id == job).values(
        lost=lost, worker=None, updated_at=now, revision=jobs.c.revision + 1,
        **({"state": FAILED, "error": sentence, "finished_at": now} if failed else {"state": QUEUED})))
    return not failed


def hand_back(connection: sa.Connection, job: str, attempt: int) -> JobRequest | None:
    """A worker that ends gives a job back; what is asked, or None where the job is not wanted any more."""
    done = connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.attempt == attempt, jobs.c.state.in_(ACTIVE)).values(
        state=QUEUED, worker=None, updated_at=time.time(), revision=jobs.c.revision + 1))
    if done.rowcount != 1:
        return None
    return ANY_JOB.validate_python(connection.execute(sa.select(jobs.c.request).where(jobs.c.id == job)).scalar_one())


def cancel(connection: sa.Connection, job: str) -> bool:
    """Cancel a job that has not ended."""
    now = time.time()
    done = connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.state.in_(ACTIVE)).values(
        state=CANCELLED, finished_at=now, updated_at=now, revision=jobs.c.revision + 1))
    return done.rowcount == 1


def begin_again(connection: sa.Connection, job: str, state: str) -> int | None:
    """Queue a job that is in this state once more.

    Returns:
        The number of the attempt; None where the job is in another state.
    """
    done = connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.state == state).values(
        state=QUEUED, attempt=jobs.c.attempt + 1, revision=jobs.c.revision + 1, updated_at=time.time(), finished_at=None,
        error=None, lost=0, worker=None, stage=None, done=None, total=None, rate=None))
    if done.rowcount != 1:
        return None
    return int(connection.execute(sa.select(jobs.c.attempt).where(jobs.c.id == job)).scalar_one())


def set_priority(connection: sa.Connection, job: str, priority: int) -> int | None:
    """Give a queued job another priority, as another attempt.

    Returns:
        The number of the attempt; None where the job is not queued.
    """
    attempt = begin_again(connection, job, QUEUED)
    if attempt is not None:
        connection.execute(jobs.update().where(jobs.c.id == job).values(priority=priority))
    return attempt


def remove(connection: sa.Connection, job: str) -> bool:
    """Forget a job that has ended."""
    connection.execute(job_inputs.delete().where(job_inputs.c.job == job))
    return connection.execute(jobs.delete().where(jobs.c.id == job, jobs.c.state.in_(ENDED))).rowcount == 1


def ended_before(database: Database, when: float) -> list[sa.RowMapping]:
    """Jobs that ended before a time."""
    return database.rows(sa.select(jobs.c.id, jobs.c.project).where(jobs.c.state.in_(ENDED), jobs.c.finished_at < when))


def _change(database: Database, job: str, attempt: int, *, patience_s: float = PATIENCE_S, **values: Any) -> bool:
    statement = jobs.update().where(jobs.c.id == job, jobs.c.attempt == attempt, jobs.c.state.in_(ACTIVE)).values(
        updated_at=time.time(), revision=jobs.c.revision + 1, **values)
    return database.transact(lambda connection: connection.execute(statement).rowcount == 1, patience_s=patience_s)
