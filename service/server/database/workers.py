"""The workers that are there, for those who operate the service; whether one lives is told by its lock, not by this table."""

import time

import sqlalchemy as sa

from service.server.database.engine import Database
from service.server.database.tables import workers

READY, DRAINING = "ready", "draining"
SILENT_S = 30.0
"""A worker that was not seen for this long is not counted."""


def insert(database: Database, worker: str, *, host: str, pid: int, device: str) -> None:
    """A worker has started."""
    now = time.time()
    database.transact(lambda connection: connection.execute(workers.insert().values(
        id=worker, host=host, pid=pid, device=device, started_at=now, seen_at=now, state=READY)))


def record_alive(database: Database, worker: str, state: str = READY) -> None:
    """It is there."""
    database.transact(lambda connection: connection.execute(workers.update().where(workers.c.id == worker).values(
        seen_at=time.time(), state=state)))


def remove(database: Database, worker: str) -> None:
    """It has ended, or was found dead."""
    database.transact(lambda connection: connection.execute(workers.delete().where(workers.c.id == worker)))


def seen_lately(database: Database) -> list[sa.RowMapping]:
    """Workers that were seen lately."""
    return database.rows(sa.select(workers).where(workers.c.seen_at > time.time() - SILENT_S).order_by(workers.c.started_at))


def not_seen_since(database: Database, since: float) -> list[sa.RowMapping]:
    """Workers that were not seen since a time."""
    return database.rows(sa.select(workers).where(workers.c.seen_at < since))
