"""Locks under which a transaction counts what there is before it adds to it, whichever API process runs it."""

import time

import sqlalchemy as sa

PROJECT, STREAMS, RATES = 11, 12, 13
"""Kinds of locks: of what a project has, and of the tables of event streams and request rates."""


def lock(connection: sa.Connection, kind: int, name: str = "") -> None:
    """Wait until no other transaction has this lock, and keep it until this transaction ends; what the others wrote is then seen.

    SQLite has one writer at a time, so that there every lock is the same. Its driver begins a transaction at the first statement that
    changes something, so that a count before it would be outdated.

    Args:
        connection: of the transaction.
        kind: of the lock; those of different kinds do not wait for each other on PostgreSQL.
        name: of the project.
    """
    if connection.dialect.name == "postgresql":
        connection.execute(sa.text("SELECT pg_advisory_xact_lock(hashtextextended(:name, :space))"), {"name": name, "space": kind})
        return
    driver = connection.connection.dbapi_connection
    assert driver is not None, "the connection is open"
    if not driver.in_transaction:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def now(connection: sa.Connection) -> float:
    """Return the time by the one clock that all processes share, in seconds since 1970: of PostgreSQL's machine, or of this one."""
    if connection.dialect.name == "postgresql":
        return float(connection.execute(sa.select(sa.extract("epoch", sa.func.clock_timestamp()))).scalar_one())
    return time.time()
