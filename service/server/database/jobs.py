"""Jobs: the request of each, its progress, and how it ended.

queued → running → succeeded | failed | cancelled; failed and cancelled → queued again, as the next attempt. Every change by a worker
names the worker and the attempt (a Claim). So a worker whose job was cancelled or taken over changes nothing any more.
"""

import time
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import sqlalchemy as sa

from service import __version__
from service.requests.base.base import JobRequest
from service.requests.base.identifiers import JOB, new_id
from service.requests.states import ACTIVE, CANCELLED, CHECKING, ENDED, FAILED, QUEUED, REFUSED, RUNNING, SUCCEEDED
from service.server.database import hooks
from service.server.database.engine import Database, lock_project, storable
from service.server.database.tables import intakes, job_inputs, job_log, jobs, newest_first

FRAMES = "frames"
"""The stage that counts frames."""
SEQUENCE = "sequence"
"""Name of the last step of a solve or a depth of a sequence, which joins its time steps."""
PATIENCE_S = 600.0
"""Seconds that a change by a worker waits for a database that does not answer."""
LATELY_S = 60.0
"""Seconds for which `watched` returns a job after it ended; the clocks of workers may differ by this much."""
MOST_ENTRIES = 1000
"""Most entries of the log of a job; what comes after is not recorded."""
KIND = jobs.c.request["kind"].as_string()


class Claim(NamedTuple):
    """The right of a worker to change a job: the worker has this attempt of it."""

    job: str
    attempt: int
    worker: str


NOTHING_LOST: dict[str, Any] = {"lost": 0, "lost_repeating": 0, "stages_begun": [], "repeating": False}
"""Values of a job at the beginning of a step."""
REPEATED = 10
"""Number of times that `max_lost` workers may die one after the other in stages that earlier workers came through."""


def insert(connection: sa.Connection, *, project: str, request: JobRequest, key: str | None = None, chunk_frames: int = 1,
           inputs: Iterable[str] = (), trace: str | None = None, finished: str | None = None) -> str:
    """Insert a new job, which reads `inputs`, in the caller's transaction, and return its identifier.

    `key` is that of whoever submits it; None: the service, or anybody. `chunk_frames` is the number of frames of a step of a relight.
    `finished` is the identifier of a job whose results exist already: it is inserted as one that has succeeded.
    """
    identifier, now = finished or new_id(JOB), time.time()
    ended = {} if finished is None else {"started_at": now, "finished_at": now}
    connection.execute(jobs.insert().values(
        id=identifier, project=project, key=key, request=request.model_dump(mode="json", by_alias=True), trace=trace,
        chunk_frames=chunk_frames, priority=request.priority, state=QUEUED if finished is None else SUCCEEDED, attempt=1, revision=1,
        created_at=now, updated_at=now, lost=0, reached=0, finished_steps=[], **ended))
    if rows := [{"job": identifier, "input": name} for name in dict.fromkeys(inputs)]:
        connection.execute(job_inputs.insert(), rows)
    return identifier


def find(database: Database, job: str, project: str | None = None) -> sa.RowMapping | None:
    """Return a job, or None; with `project`, only if it belongs to that project."""
    query = sa.select(jobs).where(jobs.c.id == job)
    return database.row(query if project is None else query.where(jobs.c.project == project))


def latest(database: Database, project: str, *, states: Sequence[str] = (), kinds: Sequence[str] = (), limit: int,
           before: sa.RowMapping | None = None) -> list[sa.RowMapping]:
    """Return a page of the jobs of a project, the newest first; `before` is the last of the page before."""
    query = sa.select(jobs).where(jobs.c.project == project)
    if states:
        query = query.where(jobs.c.state.in_(states))
    if kinds:
        query = query.where(KIND.in_(kinds))
    return database.rows(newest_first(query, jobs, limit=limit, before=before))


def views_of(database: Database, intakes: Sequence[str]) -> dict[str, str]:
    """Return for each capture that a view was prepared of, the newest job that has prepared one."""
    query = sa.select(job_inputs.c.input, jobs.c.id).join(jobs, jobs.c.id == job_inputs.c.job).where(
        job_inputs.c.input.in_(intakes), jobs.c.state == SUCCEEDED, KIND == "view").order_by(jobs.c.created_at)
    return {row["input"]: row["id"] for row in database.rows(query)}


def watched(database: Database, topics: Sequence[str]) -> list[sa.RowMapping]:
    """Return identifier, project and revision of jobs, and of those of projects that have not ended or ended lately."""
    lately = jobs.c.state.in_(ACTIVE) | (jobs.c.updated_at > time.time() - LATELY_S)
    return database.rows(sa.select(jobs.c.id, jobs.c.project, jobs.c.revision).where(
        jobs.c.id.in_(topics) | (jobs.c.project.in_(topics) & lately)))


def revisions(database: Database, identifiers: Sequence[str]) -> dict[str, sa.RowMapping]:
    """Return jobs by their identifiers."""
    return {row["id"]: row for row in database.rows(sa.select(jobs).where(jobs.c.id.in_(identifiers)))}


def count_queued(connection: sa.Connection, project: str, key: str | None) -> int:
    """Return how many jobs of a key are queued; other requests of the project wait for the end of the caller's transaction."""
    lock_project(connection, project)
    query = sa.select(sa.func.count()).where(jobs.c.project == project, jobs.c.state == QUEUED,
                                             jobs.c.key.is_(None) if key is None else jobs.c.key == key)
    return int(connection.execute(query).scalar_one())


def counts(database: Database) -> dict[str, int]:
    """Return how many jobs are in each state."""
    return {row["state"]: row["count"] for row in database.rows(
        sa.select(jobs.c.state, sa.func.count().label("count")).group_by(jobs.c.state))}


def oldest_queued(database: Database) -> float | None:
    """Return when the job that has waited longest was queued; None if none is queued."""
    row = database.row(sa.select(sa.func.min(jobs.c.updated_at).label("since")).where(jobs.c.state == QUEUED))
    return None if row is None else row["since"]


def frames(database: Database) -> int:
    """Return how many frames all jobs together have made."""
    row = database.row(sa.select(sa.func.sum(jobs.c.done).label("frames")).where(jobs.c.stage == FRAMES))
    return int((row and row["frames"]) or 0)


def users_of(connection: sa.Connection, input_id: str) -> list[str]:
    """Return the jobs, checks apart, that read a capture, an environment or a job and have not ended."""
    query = sa.select(jobs.c.id).join(job_inputs, job_inputs.c.job == jobs.c.id).where(
        job_inputs.c.input == input_id, KIND != "check", jobs.c.state.in_(ACTIVE))
    return list(connection.execute(query).scalars())


def begin(database: Database, claim: Claim) -> bool:
    """Let a worker begin a job; return False if the job was cancelled or another worker has it."""
    return database.transact(lambda connection: _update(
        connection, claim.job, _free(claim), "begun by a worker", state=RUNNING, worker=claim.worker,
        started_at=sa.func.coalesce(jobs.c.started_at, time.time()), version=sa.func.coalesce(jobs.c.version, __version__)),
        patience_s=PATIENCE_S)


def begin_anew(database: Database, claim: Claim) -> bool:
    """Begin a job from its first step, as this version of the program does it; return False if the worker no longer has it."""
    return _change(database, claim, entry="begun anew: another version of relit had begun it", version=__version__, finished_steps=[],
                   reached=0, **NOTHING_LOST)


def is_claimed(database: Database, claim: Claim) -> bool:
    """Return whether the worker still has the job."""
    return database.row(sa.select(jobs.c.id).where(*_held(claim))) is not None


def correct_reached(database: Database, claim: Claim, frames: int) -> bool:
    """Record how many frames a worker that takes over has found; return False if it no longer has the job."""
    return _change(database, claim, reached=frames)


def advance(database: Database, claim: Claim, stage: str, done: int, total: int, rate: float | None, *, frames: int | None = None,
            repeating: bool | None = None, begun: Sequence[str] | None = None, entered: bool = False) -> bool:
    """Record the progress of a running job, as users see it, without patience; return False if the worker no longer has it.

    `rate` counts are done a second. More frames than the attempt ever had, and a stage that the step never came to (`begun`), set `lost` to
    0, as a finished step does: a job that makes progress does not kill its workers. `repeating`: an earlier worker went on from this stage
    to a further one; `entered`: the log gets an entry for the stage.
    """
    values: dict[str, Any] = {"stage": stage, "done": done, "total": total, "rate": rate}
    if stage == FRAMES:
        made = done if frames is None else frames
        further = jobs.c.reached < made
        values |= {"reached": sa.case((further, made), else_=jobs.c.reached), "lost": sa.case((further, 0), else_=jobs.c.lost),
                   "lost_repeating": sa.case((further, 0), else_=jobs.c.lost_repeating)}
    if repeating is not None:
        values["repeating"] = repeating
    if begun is not None:
        values |= {"stages_begun": list(begun), "lost": 0, "lost_repeating": 0}
    return _change(database, claim, entry=f"{stage}, {total} to do" if entered else None, patience_s=0.0, **values)


def finish_step(database: Database, claim: Claim, steps: Sequence[str], result_bytes: int | None = None) -> bool:
    """Record all finished steps, and the size of all results unless it is None; return False if the worker no longer has the job."""
    size: dict[str, Any] = {} if result_bytes is None else {"result_bytes": result_bytes}
    return _change(database, claim, finished_steps=list(steps), **size, **NOTHING_LOST)


def end(database: Database, claim: Claim, state: str, error: str | None = None) -> bool:
    """End a job; return False if the worker no longer has it."""
    done: dict[str, Any] = {"done": jobs.c.total} if state == SUCCEEDED else {}  # the last recorded progress may be half a second old
    return _change(database, claim, entry=state if error is None else f"{state}: {error}", state=state,
                   error=None if error is None else storable(error), finished_at=time.time(), **done)


def record_lost_worker(connection: sa.Connection, claim: Claim, limit: int) -> str | None:
    """Record that a worker died while it had a job: the job is queued again, or fails if it has lost more than `limit`.

    A worker that died in a stage that an earlier worker came through was hardly killed by the job. So it does not count, unless there are
    REPEATED times `limit` of them. Return the new state of the job; None if it had ended.
    """
    active = _active(claim)
    row = connection.execute(sa.select(jobs).where(*active).with_for_update()).one_or_none()
    if row is None:
        return None
    counts = row.worker == claim.worker  # a worker that died before it began does not count, and none counts twice
    lost, repeating = row.lost + (counts and not row.repeating), row.lost_repeating + (counts and row.repeating)
    state, now = FAILED if lost > limit or repeating > REPEATED * limit else QUEUED, time.time()
    sentence = f"lost {lost + repeating} workers without progress ({row.stage or 'begin'}): it may need more memory than they have"
    failed = {"error": sentence, "finished_at": now} if state == FAILED else {}
    if not _update(connection, claim.job, active, f"failed: {sentence}" if state == FAILED else "lost its worker, queued again",
                   state=state, lost=lost, lost_repeating=repeating, repeating=bool(row.stages_begun), worker=None, **failed):
        return None
    if state == FAILED:
        _end_check(connection, claim.job, sentence)
    return state


def release(connection: sa.Connection, claim: Claim) -> bool:
    """Queue a job again that the worker had taken; return False if it was cancelled or another worker has it."""
    return _update(connection, claim.job, _free(claim), "given back by its worker, queued again", state=QUEUED, worker=None)


def cancel(connection: sa.Connection, job: str) -> bool:
    """Cancel a job; return False if it has ended."""
    active = jobs.c.id == job, jobs.c.state.in_(ACTIVE)
    if done := _update(connection, job, active, CANCELLED, state=CANCELLED, finished_at=time.time()):
        _end_check(connection, job, "its check was cancelled: validate it again")
    return done


def queue_again(connection: sa.Connection, job: str, state: str) -> int | None:
    """Queue a job again that has ended in `state`; return the number of its new attempt, or None if it is in another state."""
    ended = jobs.c.id == job, jobs.c.state == state
    if not _update(connection, job, ended, "queued again", state=QUEUED, attempt=jobs.c.attempt + 1, finished_at=None, error=None,
                   reached=0, **NOTHING_LOST, worker=None, stage=None, done=None, total=None, rate=None):
        return None
    return int(connection.execute(sa.select(jobs.c.attempt).where(jobs.c.id == job)).scalar_one())


def set_priority(connection: sa.Connection, job: str, priority: int) -> int | None:
    """Change the priority of a queued job; return its attempt, whose place in the queue is to change, or None if it is not queued."""
    return connection.execute(jobs.update().where(jobs.c.id == job, jobs.c.state == QUEUED).values(
        priority=priority).returning(jobs.c.attempt)).scalar()


def remove(connection: sa.Connection, job: str) -> bool:
    """Delete a job; return False if it has not ended."""
    connection.execute(job_inputs.delete().where(job_inputs.c.job == job))
    connection.execute(job_log.delete().where(job_log.c.job == job))
    return connection.execute(jobs.delete().where(jobs.c.id == job, jobs.c.state.in_(ENDED))).rowcount == 1


def log_of(database: Database, job: str) -> list[sa.RowMapping]:
    """Return the entries of the log of a job, the oldest first."""
    return database.rows(sa.select(job_log.c.at, job_log.c.attempt, job_log.c.text).where(job_log.c.job == job).order_by(job_log.c.number))


def note_once(database: Database, job: str, texts: Sequence[str]) -> None:
    """Add entries to the log of a job that it has not, as those of a step that is done again."""
    with database.begin() as connection:
        there = set(connection.scalars(sa.select(job_log.c.text).where(job_log.c.job == job)))
        for text in dict.fromkeys(map(storable, texts)):
            if text not in there:
                note(connection, job, text)


def ended_before(database: Database, when: float) -> list[sa.RowMapping]:
    """Return the jobs that ended before a time."""
    return database.rows(sa.select(jobs.c.id, jobs.c.project, jobs.c.attempt).where(jobs.c.state.in_(ENDED), jobs.c.finished_at < when))


def _active(claim: Claim) -> list[sa.ColumnElement[bool]]:
    return [jobs.c.id == claim.job, jobs.c.attempt == claim.attempt, jobs.c.state.in_(ACTIVE)]


def _held(claim: Claim) -> list[sa.ColumnElement[bool]]:
    return [*_active(claim), jobs.c.worker == claim.worker]


def _free(claim: Claim) -> list[sa.ColumnElement[bool]]:
    """Return the conditions under which a worker may take a job: nobody has it, or the worker itself."""
    return [*_active(claim), jobs.c.worker.is_(None) | (jobs.c.worker == claim.worker)]


def note(connection: sa.Connection, job: str, text: str) -> None:
    """Add an entry to the log of a job: a text for a person, which names nothing of the machine."""
    count = sa.select(sa.func.count()).where(job_log.c.job == job).scalar_subquery()
    entry = sa.select(jobs.c.id, sa.literal(time.time()), jobs.c.attempt, sa.literal(storable(text))).where(
        jobs.c.id == job, count < MOST_ENTRIES)
    connection.execute(job_log.insert().from_select(["job", "at", "attempt", "text"], entry))


def _end_check(connection: sa.Connection, job: str, problem: str) -> None:
    """Refuse the intake that a check had to look at, so that it does not stay in checking; no other job reads one that is being checked."""
    connection.execute(intakes.update().where(
        intakes.c.state == CHECKING, intakes.c.id.in_(sa.select(job_inputs.c.input).where(job_inputs.c.job == job))).values(
        state=REFUSED, problem=problem))


def _change(database: Database, claim: Claim, *, entry: str | None = None, patience_s: float = PATIENCE_S, **values: Any) -> bool:
    """Change a job that the worker has, as `_update` does."""
    return database.transact(lambda connection: _update(connection, claim.job, _held(claim), entry, **values), patience_s=patience_s)


def _update(connection: sa.Connection, job: str, where: Iterable[sa.ColumnElement[bool]], entry: str | None, **values: Any) -> bool:
    """Change a job for which these conditions hold, add an entry to its log, and tell hooks of its end; return False if they do not."""
    if connection.execute(jobs.update().where(*where).values(**values)).rowcount != 1:
        return False
    if entry is not None:
        note(connection, job, entry)
    if values.get("state") in ENDED:
        hooks.record_end(connection, job)
    return True
