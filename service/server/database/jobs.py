"""Jobs: what was asked, how far it is, how it ended.

queued → running → succeeded | failed | cancelled; failed and cancelled → queued again, as the next attempt. Every change of a worker
names the worker and the attempt (a Claim), so that one which was cancelled or given up for dead changes nothing any more.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from service.requests.identifiers import JOB, new_id
from service.requests.jobs import JobRequest
from service.server.database.engine import Database, storable
from service.server.database.tables import intakes, job_inputs, jobs, newest_first
from service.views.states import ACTIVE, CANCELLED, CHECKING, ENDED, FAILED, QUEUED, REFUSED, RUNNING, SUCCEEDED

FRAMES = "frames"
"""The stage that counts frames."""
PATIENCE_S = 600.0
"""How long a change of a worker waits for a database that does not answer."""
LATELY_S = 60.0
"""How long a job that has ended is still news; clocks of workers may differ by this much."""


class Claim(NamedTuple):
    """That a worker works on an attempt of a job."""

    job: str
    attempt: int
    worker: str


class Progress(NamedTuple):
    """Where a job is."""

    stage: str
    done: int
    total: int
    rate: float | None
    """Steps a second."""


def insert(connection: sa.Connection, *, project: str, key: str | None, request: JobRequest, chunk_frames: int,
           inputs: Iterable[str], trace: str | None = None) -> str:
    """Write down a new job in the caller's transaction.

    Args:
        connection: of the transaction.
        project, key: whose it is.
        request: what is asked.
        chunk_frames: frames of a step; kept, so that the steps of a job stay the same whatever the settings become.
        inputs: identifiers of what it reads.
        trace: traceparent of the request, so that the spans of its steps are found with it.

    Returns:
        Its identifier.
    """
    identifier, now = new_id(JOB), time.time()
    connection.execute(jobs.insert().values(
        id=identifier, project=project, key=key, request=request.model_dump(mode="json", by_alias=True), trace=trace,
        chunk_frames=chunk_frames, priority=request.priority, state=QUEUED, attempt=1, revision=1, created_at=now, updated_at=now, lost=0,
        reached=0, finished_steps=[]))
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
    return database.rows(newest_first(query, jobs, limit=limit, before=before))


def watched(database: Database, topics: Sequence[str]) -> list[sa.RowMapping]:
    """Identifier, project and revision of jobs, and of all jobs of projects that have not ended or ended lately."""
    lately = jobs.c.state.in_(ACTIVE) | (jobs.c.updated_at > time.time() - LATELY_S)
    return database.rows(sa.select(jobs.c.id, jobs.c.project, jobs.c.revision).where(
        jobs.c.id.in_(topics) | (jobs.c.project.in_(topics) & lately)))


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


def oldest_queued(database: Database) -> float | None:
    """When the job that has waited for longest began to wait."""
    row = database.row(sa.select(sa.func.min(jobs.c.updated_at).label("since")).where(jobs.c.state == QUEUED))
    return None if row is None else row["since"]


def frames(database: Database) -> int:
    """Frames that all jobs together have made."""
    row = database.row(sa.select(sa.func.sum(jobs.c.done).label("frames")).where(jobs.c.stage == FRAMES))
    return int((row and row["frames"]) or 0)


def users_of(connection: sa.Connection, input_id: str, *, active: bool) -> list[str]:
    """Identifiers of jobs that read something; active: of those alone which have not ended.

    Checks are left out: the state of what they check tells, and changes a moment before they have ended.
    """
    query = sa.select(jobs.c.id).join(job_inputs, job_inputs.c.job == jobs.c.id).where(
        job_inputs.c.input == input_id, jobs.c.request["kind"].as_string() != "check")
    return list(connection.execute(query.where(jobs.c.state.in_(ACTIVE)) if active else query).scalars())


def begin(database: Database, claim: Claim) -> bool:
    """A worker takes a job up; false where it is not to be done any more, or is another worker's."""
    free = sa.or_(jobs.c.worker.is_(None), jobs.c.worker == claim.worker)
    return _change(database, claim, free, state=RUNNING, worker=claim.worker,
                   started_at=sa.func.coalesce(jobs.c.started_at, time.time()))


def is_claimed(database: Database, claim: Claim) -> bool:
    """Whether a worker shall go on."""
    return database.row(sa.select(jobs.c.id).where(*_held(claim))) is not None


def advance(database: Database, claim: Claim, progress: Progress) -> bool:
    """Note where a running job is.

    More frames than it ever had count as a finished step does: a job that comes further is not one that kills its workers.

    Raises:
        DBAPIError: the database does not answer at once.
    """
    reached: dict[str, Any] = {}
    if progress.stage == FRAMES:
        further = jobs.c.reached < progress.done
        reached = {"reached": sa.case((further, progress.done), else_=jobs.c.reached), "lost": sa.case((further, 0), else_=jobs.c.lost)}
    return _change(database, claim, patience_s=0.0, **progress._asdict(), **reached)


def finish_step(database: Database, claim: Claim, steps: Sequence[str]) -> bool:
    """Note the steps that are finished: all of them, this one too."""
    return _change(database, claim, finished_steps=list(steps), lost=0)


def end(database: Database, claim: Claim, state: str, error: str | None = None) -> bool:
    """A worker ends a job."""
    done: dict[str, Any] = {"done": jobs.c.total} if state == SUCCEEDED else {}  # what was told last may lie half a second back
    return _change(database, claim, state=state, error=None if error is None else storable(error), finished_at=time.time(), **done)


def record_lost_worker(connection: sa.Connection, claim: Claim, limit: int, sentence: str) -> str | None:
    """A worker died with this job, which waits for the next one, or has failed where it lost too many.

    Args:
        connection: of the caller's transaction.
        claim: of the dead.
        limit: workers that a job may lose in one step.
        sentence: the error of a job that lost more.

    Returns:
        The job's state; None where it had ended.
    """
    active = [jobs.c.id == claim.job, jobs.c.attempt == claim.attempt, jobs.c.state.in_(ACTIVE)]
    row = connection.execute(sa.select(jobs.c.lost, jobs.c.worker).where(*active).with_for_update()).one_or_none()
    if row is None:
        return None
    lost = row.lost + (row.worker == claim.worker)  # not one that died before it began, and none twice
    state, now = FAILED if lost > limit else QUEUED, time.time()
    done = connection.execute(jobs.update().where(*active).values(
        state=state, lost=lost, worker=None, updated_at=now, revision=jobs.c.revision + 1,
        **({"error": sentence, "finished_at": now} if state == FAILED else {})))
    if state == FAILED:
        _end_check(connection, claim.job, sentence)
    return state if done.rowcount == 1 else None


def release(connection: sa.Connection, claim: Claim) -> bool:
    """A worker gives a job back; false where it is not wanted any more."""
    mine = sa.or_(jobs.c.worker.is_(None), jobs.c.worker == claim.worker)
    return connection.execute(jobs.update().where(
        jobs.c.id == claim.job, jobs.c.attempt == claim.attempt, jobs.c.state.in_(ACTIVE), mine).values(
        state=QUEUED, worker=None, updated_at=time.time(), revision=jobs.c.revision + 1)).rowcount == 1


def cancel(connection: sa.Connection, job: str) -> bool:
    """Cancel a job that has not ended."""
    now = time.time()
    done = connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.state.in_(ACTIVE)).values(
        state=CANCELLED, finished_at=now, updated_at=now, revision=jobs.c.revision + 1))
    if done.rowcount == 1:
        _end_check(connection, job, "its check was cancelled: validate it again")
    return done.rowcount == 1


def queue_again(connection: sa.Connection, job: str, state: str) -> int | None:
    """Queue a job that is in this state once more.

    Returns:
        The number of the attempt; None where the job is in another state.
    """
    done = connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.state == state).values(
        state=QUEUED, attempt=jobs.c.attempt + 1, revision=jobs.c.revision + 1, updated_at=time.time(), finished_at=None,
        error=None, lost=0, reached=0, worker=None, stage=None, done=None, total=None, rate=None))
    if done.rowcount != 1:
        return None
    return int(connection.execute(sa.select(jobs.c.attempt).where(jobs.c.id == job)).scalar_one())


def set_priority(connection: sa.Connection, job: str, priority: int) -> int | None:
    """Give a queued job another priority, as another attempt.

    Returns:
        The number of the attempt; None where the job is not queued.
    """
    attempt = queue_again(connection, job, QUEUED)
    if attempt is not None:
        connection.execute(jobs.update().where(jobs.c.id == job).values(priority=priority))
    return attempt


def remove(connection: sa.Connection, job: str) -> bool:
    """Forget a job that has ended."""
    connection.execute(job_inputs.delete().where(job_inputs.c.job == job))
    return connection.execute(jobs.delete().where(jobs.c.id == job, jobs.c.state.in_(ENDED))).rowcount == 1


def ended_before(database: Database, when: float) -> list[sa.RowMapping]:
    """Jobs that ended before a time."""
    return database.rows(sa.select(jobs.c.id, jobs.c.project, jobs.c.attempt).where(jobs.c.state.in_(ENDED), jobs.c.finished_at < when))


def _held(claim: Claim) -> list[sa.ColumnElement[bool]]:
    return [jobs.c.id == claim.job, jobs.c.attempt == claim.attempt, jobs.c.worker == claim.worker, jobs.c.state.in_(ACTIVE)]


def _end_check(connection: sa.Connection, job: str, problem: str) -> None:
    """What a check was to look at is refused, so that it does not wait for ever; other jobs read nothing that is being checked."""
    connection.execute(intakes.update().where(
        intakes.c.state == CHECKING, intakes.c.id.in_(sa.select(job_inputs.c.input).where(job_inputs.c.job == job))).values(
        state=REFUSED, problem=problem))


def _change(database: Database, claim: Claim, free: sa.ColumnElement[bool] | None = None, *, patience_s: float = PATIENCE_S,
            **values: Any) -> bool:
    """Change what a worker holds, or what is free for it to take."""
    found = _held(claim) if free is None else [jobs.c.id == claim.job, jobs.c.attempt == claim.attempt, jobs.c.state.in_(ACTIVE), free]
    statement = jobs.update().where(*found).values(updated_at=time.time(), revision=jobs.c.revision + 1, **values)
    return database.transact(lambda connection: connection.execute(statement).rowcount == 1, patience_s=patience_s)
