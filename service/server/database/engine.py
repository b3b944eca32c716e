"""The database: SQLite in the data folder, or PostgreSQL. Transactions can wait while its server restarts."""

import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError, InterfaceError, InternalError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from service.errors import RequestError
from service.server.base.settings import Settings

T = TypeVar("T")
BUSY_MS = 30_000
"""Milliseconds for which a write on SQLite waits for that of another process."""
OPTIONS: dict[str, dict[str, Any]] = {"sqlite": {}, "postgresql": {"pool_pre_ping": True, "connect_args": {
    "application_name": "relit", "connect_timeout": 10, "keepalives_idle": 5, "keepalives_interval": 2, "keepalives_count": 3}}}
PROJECT = 11
"""Seed of the hash of projects' names, so that these advisory locks do not coincide with those of other programs."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
UNANSWERED = (OperationalError, InterfaceError, InternalError, PoolTimeoutError)
"""Exceptions of a database that may answer later: it restarts, its disk is full, or it is locked for long."""


def message_of(error: BaseException) -> str:
    """Return the message of the database, without the SQL statement."""
    return str(getattr(error, "orig", error))


class DatabaseError(Exception):
    """The database cannot be used; the message says which and why."""


class Database:
    """Transactions on the tables of the service."""

    def __init__(self, engine: sa.Engine) -> None:
        self.engine = engine

    @property
    def is_sqlite(self) -> bool:
        """Return whether the database is a file of SQLite."""
        return self.engine.dialect.name == "sqlite"

    def begin(self) -> AbstractContextManager[sa.Connection]:
        """Begin a transaction, which ends with the block; an exception undoes it."""
        return self.engine.begin()

    def transact(self, work: Callable[[sa.Connection], T], *, patience_s: float = 0.0) -> T:
        """Run `work` in one transaction, which may do nothing else, and again for `patience_s` while the database is away or full."""
        pause, deadline = FIRST_PAUSE_S, time.monotonic() + patience_s
        while True:
            try:
                with self.begin() as connection:
                    return work(connection)
            except UNANSWERED:
                if time.monotonic() + pause > deadline:
                    raise
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def execute(self, statement: sa.Update | sa.Delete | sa.Insert) -> int:
        """Run one statement in a transaction of its own, and return the number of rows that it changed."""
        with self.begin() as connection:
            return connection.execute(statement).rowcount

    def rows(self, query: "sa.Select[Any]") -> list[sa.RowMapping]:
        """Return all rows of a query."""
        with self.engine.connect() as connection:
            return list(connection.execute(query).mappings())

    def row(self, query: "sa.Select[Any]") -> sa.RowMapping | None:
        """Return the first row of a query; None: there is none."""
        return next(iter(self.rows(query.limit(1))), None)

    def close(self) -> None:
        """Close the connections."""
        self.engine.dispose()


def connect(url: str, *, connections: int = 10) -> Database:
    """Open a database by its URL for SQLAlchemy (sqlite:///path or postgresql+psycopg://…); nothing is created."""
    try:
        parsed = sa.make_url(url)
        kind = parsed.get_backend_name()
        if kind not in OPTIONS:
            raise DatabaseError(f"database_url: {kind} is not supported: give postgresql://…, or none for SQLite")
        engine = sa.create_engine(parsed, pool_size=connections, max_overflow=0, pool_timeout=30, **OPTIONS[kind])
    except (sa.exc.ArgumentError, sa.exc.NoSuchModuleError, ValueError) as error:  # ValueError: a port that is no number
        raise DatabaseError("database_url: is not of the form postgresql://user:password@host/name") from error
    if kind == "sqlite":
        sa.event.listen(engine, "connect", _sqlite)
    return Database(engine)


def open_database(settings: Settings, prepare: Callable[[Settings, Database], None]) -> Database:
    """Open the database that the settings name; `prepare` makes the tables, or checks that they exist."""
    with usable(settings):
        database = connect(settings.sqlalchemy_url)
        prepare(settings, database)
    return database


@contextmanager
def usable(settings: Settings) -> Iterator[None]:
    """Turn errors of the data folder and the database into a RequestError for people, without SQL and without values."""
    try:
        yield
    except DatabaseError as error:
        raise RequestError(str(error)) from error
    except OSError as error:
        raise RequestError(f"data {settings.data}: the folder cannot be used ({error.strerror})") from None
    except DBAPIError as error:
        what = f"data {settings.data}: the database in it" if settings.is_sqlite else "database_url: the database"
        raise RequestError(f"{what} cannot be used ({' '.join(str(error.orig).split())})") from None


def _sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = "IMMEDIATE"  # a write takes the lock at its beginning, so that none fails halfway
    for pragma in (f"busy_timeout={BUSY_MS}", "journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
        connection.execute(f"PRAGMA {pragma}")
    if sqlite3.sqlite_version_info < (3, 42):  # DBOS expects that the SQLite of Python 3.12 knows 'subsec'; that of the system may not
        connection.create_function("unixepoch", 1, lambda _subsec: time.time())


def lock_project(connection: sa.Connection, project: str) -> None:
    """Wait for the lock of a project, and keep it until this transaction ends, which sees what earlier ones wrote and can count it."""
    if connection.dialect.name == "postgresql":
        connection.execute(sa.text("SELECT pg_advisory_xact_lock(hashtextextended(:name, :space))"), {"name": project, "space": PROJECT})
    else:
        begin_writing(connection)


def begin_writing(connection: sa.Connection) -> None:
    """Begin the transaction on SQLite, which has one writer at a time; its driver would begin at the first statement that changes rows."""
    driver = connection.connection.dbapi_connection
    if connection.dialect.name == "sqlite" and driver is not None and not driver.in_transaction:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def storable(text: str) -> str:
    """Return a text that every database accepts: without NUL, and without bytes that are not text."""
    return text.replace("\0", "\ufffd").encode("utf-8", "replace").decode()
