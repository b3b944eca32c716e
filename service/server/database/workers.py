"""The table of workers, for operators. The lock of a worker, and not this table, tells whether it lives."""

import time

import sqlalchemy as sa

from service.server.database.engine import Database
from service.server.database.tables import workers

READY, DRAINING = "ready", "draining"
DRAIN, KILL = "drain", "kill"
"""What an operator may ask of a worker, which it does itself when it next looks."""
SILENT_S = 30.0
"""A worker that was not seen for this long is not counted as present."""


def insert(database: Database, worker: str, *, host: str, pid: int, device: str) -> None:
    """Insert a worker that has started."""
    now = time.time()
    database.execute(workers.insert().values(id=worker, host=host, pid=pid, device=device, started_at=now, seen_at=now, state=READY))


def record_alive(database: Database, worker: str, state: str = READY) -> str | None:
    """Record that a worker is alive, and its state; return what an operator asks of it."""
    alive = workers.update().where(workers.c.id == worker).values(seen_at=time.time(), state=state).returning(workers.c.asked)
    with database.begin() as connection:
        return connection.execute(alive).scalar()


def ask(connection: sa.Connection, worker: str, what: str) -> bool:
    """Ask something of a worker that was seen lately; return False if there is none."""
    is_there = workers.c.id == worker, workers.c.seen_at > time.time() - SILENT_S
    return connection.execute(workers.update().where(*is_there).values(asked=what)).rowcount == 1


def remove(database: Database, worker: str) -> None:
    """Delete a worker that has ended or was found dead."""
    database.execute(workers.delete().where(workers.c.id == worker))


def seen_lately(database: Database) -> list[sa.RowMapping]:
    """Return the workers that were seen in the last SILENT_S, the oldest first."""
    return database.rows(sa.select(workers).where(workers.c.seen_at > time.time() - SILENT_S).order_by(workers.c.started_at))


def not_seen_since(database: Database, since: float) -> list[sa.RowMapping]:
    """Return the workers that were not seen since a time."""
    return database.rows(sa.select(workers).where(workers.c.seen_at < since))
