"""Which workers live: each holds a lock named after it, which the operating system or the database drops when it dies.

On SQLite all workers are on one machine and the lock is one on a file; on PostgreSQL it is an advisory lock of a session. Who takes over
from a dead worker holds its lock meanwhile, so that one alone does. Names are never used again.
"""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from enum import Enum
from pathlib import Path
from typing import Protocol

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.server import file_lock
from service.server.database.engine import Database

SPACE = 7
"""Seed of the hash of names, so that our advisory locks meet no one else's."""
KEEPALIVE = {"tcp_keepalives_idle": 3, "tcp_keepalives_interval": 1, "tcp_keepalives_count": 3}
"""Seconds and tries after which the server ends the session of a machine that is gone; by itself it would wait for hours."""


class LockState(Enum):
    """How the own lock is."""

    KEPT = "kept"
    TAKEN = "taken"
    """It had been lost, or is the first."""
    REFUSED = "refused"
    """Another has it."""


class WorkerLock(Protocol):
    """The lock of a worker, and whether others hold theirs."""

    def hold(self) -> LockState:
        """Take the own lock, or make sure that it is still held."""

    def dead(self, worker: str) -> AbstractContextManager[bool]:
        """Whether a worker does not hold its lock; where it does not, it cannot take it, nor can another, within the context."""

    def close(self) -> None:
        """Let go."""


class FileWorkerLock:
    """Locks on files of a folder."""

    def __init__(self, folder: Path, worker: str) -> None:
        """Args: folder: of the locks. worker: who we are."""
        self._folder, self._worker = folder, worker
        self._file: int | None = None

    def hold(self) -> LockState:
        """A lock on a file lasts as long as the process, and is seen by others as long as the file has its name."""
        if self._file is not None:
            if file_lock.is_named(self._file, self._path(self._worker)):
                return LockState.KEPT
            os.close(self._file)
        self._file = self._take(self._worker)
        return LockState.REFUSED if self._file is None else LockState.TAKEN

    @contextmanager
    def dead(self, worker: str) -> Iterator[bool]:
        """Try its lock."""
        file = self._take(worker)
        try:
            yield file is not None
        finally:
            if file is not None:
                self._drop(file, worker)

    def close(self) -> None:
        """Let go."""
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
        """Args: database: the store's. worker: who we are."""
        self._engine, self._worker = database.engine, worker
        self._session: sa.Connection | None = None

    def hold(self) -> LockState:
        """Ask the session, which after a restart of the server is a new one and has to take the lock again."""
        if self._session is not None:
            try:
                self._session.execute(sa.text("SELECT 1"))
            except DBAPIError:
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
        """Try its lock."""
        session = self._session
        assert session is not None, "hold the own lock first"
        taken = self._take(session, worker)
        try:
            yield taken
        finally:
            if taken:
                with suppress(DBAPIError):  # a session that has ended holds nothing
                    session.execute(sa.text("SELECT pg_advisory_unlock(hashtextextended(:name, :space))"), {"name": worker, "space": SPACE})

    def close(self) -> None:
        """End the session."""
        if self._session is not None:
            self._session.invalidate()
            self._session.close()
            self._session = None

    def _take(self, session: sa.Connection, worker: str) -> bool:
        return bool(session.execute(sa.text("SELECT pg_try_advisory_lock(hashtextextended(:name, :space))"),
                                    {"name": worker, "space": SPACE}).scalar())


def open_worker_lock(database: Database, locks: Path, worker: str) -> WorkerLock:
    """The kind of lock that the database allows."""
    return FileWorkerLock(locks, worker) if database.is_sqlite else AdvisoryWorkerLock(database, worker)
