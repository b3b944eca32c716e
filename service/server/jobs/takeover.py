"""Takeover: the jobs of a worker that died go back to the queue.

DBOS gives a worker's jobs back only to a worker of the same name. So each worker holds a lock that is named after it, and looks every few
seconds whether a worker that has jobs has lost its lock. On SQLite, where all workers are on one machine, it is a lock on a file, which the
operating system releases; on PostgreSQL an advisory lock of a session, which the server releases. A worker that takes over from a dead one
holds that one's lock meanwhile, so that no two take over the same jobs. Names of workers are never used again.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import TypeAlias

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from service.requests.states import QUEUED
from service.server.base import file_lock
from service.server.base.log import logger
from service.server.base.rounds import Rounds
from service.server.database import jobs, workers
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.jobs import Claim
from service.server.jobs.queue import JobQueue, is_help, job_and_attempt

SPACE = 7
"""Seed of the hash of names, so that these advisory locks do not coincide with those of other programs."""
KEEPALIVE = {"tcp_keepalives_idle": 3, "tcp_keepalives_interval": 1, "tcp_keepalives_count": 3}
"""Seconds and tries after which the server ends the session of a machine that is gone; its own default is hours."""
GRACE_ROUNDS = 2
"""Rounds without a takeover after this worker had to take its lock again: a restart of the database released the locks of all other workers
as well, and they need time to take them again."""
FORGOTTEN_ROUNDS = 3
"""Rounds after which a workflow is put back that DBOS assigns to this worker but that does not run here. This happens when the database
stops after it has assigned the workflow and before this worker receives the answer."""


class LockState(Enum):
    """Results of `WorkerLock.hold`."""

    KEPT = "kept"
    TAKEN = "taken"
    """The lock was not held before, or had been lost."""
    REFUSED = "refused"
    """Another process has the lock."""


WorkerLock: TypeAlias = "FileWorkerLock | AdvisoryWorkerLock"
"""The lock of this worker, and a look at those of others."""


class FileWorkerLock:
    """Locks on the files of a folder."""

    def __init__(self, folder: Path, worker: str) -> None:
        self._folder, self._worker = folder, worker
        self._file: int | None = None

    def hold(self) -> LockState:
        """Take or keep the lock, which other processes see as long as the file has its name."""
        if self._file is not None:
            if file_lock.is_named(self._file, self._path(self._worker)):
                return LockState.KEPT
            os.close(self._file)
        self._file = self._take(self._worker)
        return LockState.REFUSED if self._file is None else LockState.TAKEN

    @contextmanager
    def dead(self, worker: str) -> Iterator[bool]:
        """Return whether a worker has lost its lock; if so, nobody else can take that lock within the context."""
        file = self._take(worker)
        try:
            yield file is not None
        finally:
            if file is not None:
                self._drop(file, worker)

    def close(self) -> None:
        """Release the lock."""
        if self._file is not None:
            self._drop(self._file, self._worker)
            self._file = None

    def _take(self, worker: str) -> int | None:
        self._folder.mkdir(parents=True, exist_ok=True)
        return file_lock.take(self._path(worker))

    def _drop(self, file: int, worker: str) -> None:
        self._path(worker).unlink(missing_ok=True)
        os.close(file)

    def _path(self, worker: str) -> Path:
        return self._folder / f"{worker.replace('/', '_')}.lock"


class AdvisoryWorkerLock:
    """Advisory locks of one PostgreSQL session."""

    def __init__(self, database: Database, worker: str) -> None:
        self._engine, self._worker = database.engine, worker
        self._session: sa.Connection | None = None

    def hold(self) -> LockState:
        """Take or keep the lock; after a restart of the server it is taken in a new session."""
        if self._session is not None:
            try:
                self._session.execute(sa.text("SELECT 1"))
            except SQLAlchemyError:  # one that broke in a look at another worker, too, which then waits to be rolled back
                self.close()
            else:
                return LockState.KEPT
        session = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        try:
            for name, value in KEEPALIVE.items():
                session.execute(sa.text(f"SET {name} = {value}"))
            if self._take(session, self._worker):
                self._session = session
                return LockState.TAKEN
            return LockState.REFUSED
        finally:
            if self._session is None:
                session.close()

    @contextmanager
    def dead(self, worker: str) -> Iterator[bool]:
        """Return whether a worker has lost its lock; if so, nobody else can take that lock within the context."""
        session = self._session
        assert session is not None, "hold the lock of this worker first"
        taken = self._take(session, worker)
        try:
            yield taken
        finally:
            if taken:
                with suppress(SQLAlchemyError):  # a session that has ended holds nothing
                    session.execute(sa.text("SELECT pg_advisory_unlock(hashtextextended(:name, :space))"), {"name": worker, "space": SPACE})

    def close(self) -> None:
        """End the session, which releases the lock."""
        if self._session is not None:
            self._session.invalidate()
            self._session.close()
            self._session = None

    def _take(self, session: sa.Connection, worker: str) -> bool:
        return bool(session.execute(sa.text("SELECT pg_try_advisory_lock(hashtextextended(:name, :space))"),
                                    {"name": worker, "space": SPACE}).scalar())


def open_worker_lock(database: Database, locks: Path, worker: str) -> WorkerLock:
    """Return the lock of a worker: a file in `locks` with SQLite, else an advisory lock of PostgreSQL."""
    return FileWorkerLock(locks, worker) if database.is_sqlite else AdvisoryWorkerLock(database, worker)


class Takeover(Rounds):
    """A thread that keeps the worker's own lock and takes over from workers that died."""

    def __init__(self, database: Database, queue: JobQueue, lock: WorkerLock, worker: str, *, every_s: float, max_lost: int,
                 running: Callable[[], frozenset[str]], beat: Callable[[], None], lock_lost: Callable[[], None],
                 asked: Callable[[str], None]) -> None:
        """Create the thread of the worker that holds `lock`; `start` starts it.

        Every `every_s` seconds it calls `beat`. `running` returns the workflows that run in this process, `max_lost` is the number of
        workers that a job may lose without progress, and `lock_lost` is called when another process has this worker's lock for good;
        `asked` is called with what an operator asks of this worker, each round.
        """
        self._database, self._queue, self._lock, self._worker = database, queue, lock, worker
        super().__init__("relit-takeover", every_s, self._guarded_round)
        self._max_lost = max_lost
        self._running, self._beat, self._lock_lost, self._asked = running, beat, lock_lost, asked
        self.state = workers.READY
        """State of this worker for the table of workers."""
        self._grace = self._refused = 0
        self._unknown: Counter[str] = Counter()

    def round(self) -> None:
        """Renew the lock, then look at the other workers once."""
        held = self._lock.hold()
        self._refused = self._refused + 1 if held is LockState.REFUSED else 0
        if self._refused > GRACE_ROUNDS:  # a worker that takes over from this one holds the lock for a moment only
            self._lock_lost()
        if held is LockState.REFUSED:
            return
        if held is LockState.TAKEN:
            self._grace = GRACE_ROUNDS
        if (what := workers.record_alive(self._database, self._worker, self.state)) is not None:
            self._asked(what)
        taken = self._queue.taken_by()
        self._return_forgotten(taken.pop(self._worker, []))
        if self._grace > 0:
            self._grace -= 1
            return
        for worker in taken:
            with self._lock.dead(worker) as dead:
                if dead:
                    self._take_over(worker)

    def _guarded_round(self) -> None:
        self._beat()
        try:
            self.round()
        except UNANSWERED as error:
            logger.warning("database does not answer", error=message_of(error))
        except Exception as error:  # the next round may succeed; a worker without rounds would seem dead
            logger.error("takeover failed", exc_info=error)

    def _take_over(self, worker: str) -> None:
        """Queue the workflows of a dead worker again, or end those of its jobs that have lost too many workers."""
        workflows = self._queue.taken_by().get(worker, [])  # read again under the worker's lock: another may have been faster
        if workflows:
            logger.warning("worker died", dead=worker, jobs=[job_and_attempt(workflow)[0] for workflow in workflows])
        for workflow in workflows:
            with self._database.begin() as connection:
                state = None if is_help(workflow) else jobs.record_lost_worker(
                    connection, Claim(*job_and_attempt(workflow), worker), self._max_lost)
            if state == QUEUED:
                self._queue.requeue(workflow)
            else:  # also of help, as the worker that has the job does what is left
                self._queue.cancel(workflow)
        workers.remove(self._database, worker)

    def _return_forgotten(self, workflows: list[str]) -> None:
        unknown = set(workflows) - self._running()
        self._unknown = Counter({workflow: self._unknown[workflow] + 1 for workflow in unknown})
        for workflow, rounds in self._unknown.items():
            if rounds >= FORGOTTEN_ROUNDS:
                logger.warning("job is put back: this worker had it and did not begin", job=job_and_attempt(workflow)[0])
                self._queue.return_job(workflow, self._worker)
