"""The log of each job: what happened to it and when, written in the transaction of the change."""

import time

import sqlalchemy as sa

from service.server.database.engine import Database, storable
from service.server.database.tables import job_log, jobs

MOST_ENTRIES = 1000
"""Most entries of a job; what comes after is not recorded."""


def write(connection: sa.Connection, job: str, text: str) -> None:
    """Add an entry to the log of a job, in the caller's transaction.

    Args:
        connection: of the transaction.
        job: identifier.
        text: for a person; it names nothing of the machine.
    """
    count = sa.select(sa.func.count()).where(job_log.c.job == job).scalar_subquery()
    entry = sa.select(jobs.c.id, sa.literal(time.time()), jobs.c.attempt, sa.literal(storable(text))).where(
        jobs.c.id == job, count < MOST_ENTRIES)
    connection.execute(job_log.insert().from_select(["job", "at", "attempt", "text"], entry))


def read(database: Database, job: str) -> list[sa.RowMapping]:
    """Return the entries of a job, the oldest first."""
    return database.rows(sa.select(job_log.c.at, job_log.c.attempt, job_log.c.text).where(job_log.c.job == job).order_by(job_log.c.number))


def remove(connection: sa.Connection, job: str) -> None:
    """Delete the log of a job."""
    connection.execute(job_log.delete().where(job_log.c.job == job))
