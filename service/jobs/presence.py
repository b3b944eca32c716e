"""Which workers live: each holds a lock named after it, which the operating system or the database drops when it dies.

On SQLite all workers are on one machine and the lock is one on a file; on PostgreSQL it is an advisory lock of a session.
"""

import fcntl
import os
from pathlib import Path
from typing import IO, Protocol

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.store.database import Database

SPACE = 7
"""Seed of the hash of names, so that our advisory locks meet no one else's."""


class Presence(Protocol):
    """The lock of a worker, and whether others hold theirs."""

    def hold(self) -> bool:
        """Take the own lock, or make sure that it is still held; false where it is another's."""

    def is_dead(self, worker: str) -> bool:
        """Whether a worker does not hold its lock."""

    def close(self) -> None:
        """Let go."""


class FilePresence:
    """Locks on files of a folder."""

    def __init__(self, folder: Path, worker: str) -> None:
        """Args: folder: of the locks. worker: who we are."""
        self._folder, self._worker = folder, worker
        self._file: IO[bytes] | None = None

    def hold(self) -> bool:
        """A lock on a file lasts as long as the process."""
        if self._file is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            file = open(self._path(self._worker), "wb")  # noqa: SIM115  (held until the end)
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._file = file
        return True

    def is_dead(self, worker: str) -> bool:
        """Try its lock."""
        try:
            file = os.open(self._path(worker), os.O_RDWR)
        except FileNotFoundError:
            return True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        else:
            self._path(worker).unlink(missing_ok=True)  # names are never used again
            return True
        finally:
            os.close(file)

    def close(self) -> None:
        """Let go."""
        if self._file is not None:
            self._path(self._worker).unlink(missing_ok=True)
            self._file.close()
            self._file = None

    def _path(self, worker: str) -> Path:
        return self._folder / f"{worker.replace('/', '_')}.lock"


class SessionPresence:
    """Advisory locks of one PostgreSQL session."""

    def __init__(self, database: Database, worker: str) -> None:
        """Args: database: the store's. worker: who we are."""
        self._engine, self._worker = database.engine, worker
        self._session: sa.Connection | None = None

    def hold(self) -> bool:
        """Ask the session, which after a restart of the server is a new one and has to take the lock again."""
        if self._session is not None:
            try:
                self._session.execute(sa.text("SELECT 1"))
            except DBAPIError:
                self._session.invalidate()
                self._session.close()
                self._session = None
            else:
                return True
        session = self._engine.connect().execution_options(isolation_level="AUTOCOMMIT")
        if not self._take(session, self._worker):
            session.close()
            return False
        self._session = session
        return True

    def is_dead(self, worker: str) -> bool:
        """Try its lock."""
        assert self._session is not None, "hold the own lock first"
        if not self._take(self._session, worker):
            return False
        self._session.execute(sa.text("SELECT pg_advisory_unlock(hashtextextended(:name, :space))"), {"name": worker, "space": SPACE})
        return True

    def close(self) -> None:
        """End the session."""
        if self._session is not None:
            self._session.invalidate()
            self._session.close()
            self._session = None

    def _take(self, session: sa.Connection, worker: str) -> bool:
        return bool(session.execute(sa.text("SELECT pg_try_advisory_lock(hashtextextended(:name, :space))"),
                                    {"name": worker, "space": SPACE}).scalar())


def presence(database: Database, locks: Path, worker: str) -> Presence:
    """The kind of lock that the database allows."""
    return FilePresence(locks, worker) if database.is_sqlite else SessionPresence(database, worker)
