"""Locks that tell whether a worker lives: each worker holds one named after it, which is released when the worker dies.

On SQLite all workers are on one machine, and a lock is one on a file, which the operating system releases. On PostgreSQL it is an advisory
lock of a session, which the server releases. A worker that takes over from a dead one holds that one's lock meanwhile, so that no two take
over at once. Names of workers are never used again.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import TypeAlias

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from service.server.base import file_lock
from service.server.database.engine import Database

SPACE = 7
"""Seed of the hash of names, so that these advisory locks do not coincide with those of other programs."""
KEEPALIVE = {"tcp_keepalives_idle": 3, "tcp_keepalives_interval": 1, "tcp_keepalives_count": 3}
"""Seconds and tries after which the server ends the session of a machine that is gone; its own default is hours."""


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
