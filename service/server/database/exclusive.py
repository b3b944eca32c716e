"""Locks under which a transaction counts what there is before it adds to it, whichever API process runs it."""

import sqlalchemy as sa

PROJECT = 11
"""The kind of the lock of what a project has."""


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
