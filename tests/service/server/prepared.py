"""Databases with all tables, which are made once a run and copied: making them takes some tenths of a second."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from service.server.base.settings import Settings
from service.server.database.engine import Database, connect
from service.server.database.schema import is_current
from service.server.jobs import queue
from tests.service.postgres import Postgres


def prepare(settings: Settings, database: Database) -> None:
    """As `queue.prepare`, to a database to which nobody has been connected yet."""
    if settings.is_sqlite and not settings.sqlite_file.exists():
        settings.data.mkdir(parents=True, exist_ok=True)
        settings.sqlite_file.write_bytes(_with_tables())
    elif settings.is_sqlite or not is_current(database):
        queue.prepare(settings, database)
    else:
        settings.data.mkdir(parents=True, exist_ok=True)


@contextmanager
def opened(settings: Settings) -> Iterator[Database]:
    """The database of a service, with all tables."""
    with closing(connect(settings.sqlalchemy_url)) as database:
        prepare(settings, database)
        yield database


def new_on(server: Postgres) -> str:
    """The URL of a new database of PostgreSQL with all tables."""
    return server.new_database(_template(server))


@cache
def _template(server: Postgres) -> str:
    url = server.new_database()
    with TemporaryDirectory() as folder:
        settings = Settings(data=Path(folder), database_url=url)
        with closing(connect(settings.sqlalchemy_url)) as database:
            queue.prepare(settings, database)
    return url.rpartition("/")[2]


@cache
def _with_tables() -> bytes:
    with TemporaryDirectory() as folder:
        settings = Settings(data=Path(folder))
        with closing(connect(settings.sqlalchemy_url)) as database:
            queue.prepare(settings, database)
            with database.engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        return settings.sqlite_file.read_bytes()
