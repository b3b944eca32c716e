"""The schema of the database: made anew, or upgraded by Alembic when a newer program opens the database.

A new database gets the tables of `tables` as they are. Each change of them since relit 0.1.0 is a revision in `migrations/versions`, which
`upgrade` applies to a database that lacks it, in one transaction. To write one: change `tables`, add a file with the next number there,
and run tests/service/server/database, which compare an upgraded database with a new one.

Alembic is imported only to make or upgrade tables: its import takes a tenth of the start of a worker, and a database is seldom old.
"""

from pathlib import Path

import sqlalchemy as sa

from service.server.database import audit, tables
from service.server.database.engine import Database, DatabaseError

REVISIONS = "relit_schema"
"""Table in which Alembic keeps the revision of the database."""
MIGRATIONS = Path(__file__).parent / "migrations"
UPGRADE_LOCK = 0x72656C6974
"""Number of the advisory lock of PostgreSQL under which the tables are made and changed."""


def upgrade(database: Database) -> None:
    """Make the tables if there are none, or change those of an older program."""
    with database.engine.begin() as connection:
        if database.is_sqlite:
            connection.execute(sa.text("BEGIN IMMEDIATE"))
        else:
            connection.execute(sa.text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": UPGRADE_LOCK})
        found = _revision(connection)
        if found == _known()[-1]:
            return
        from alembic import command
        from alembic.config import Config

        config = Config(attributes={"connection": connection})
        config.set_main_option("script_location", str(MIGRATIONS).replace("%", "%%"))
        if found is None and not _has_tables(connection):
            tables.metadata.create_all(connection)
            command.stamp(config, "head")
        else:
            _require_known(found)
            command.upgrade(config, "head")
        audit.protect(connection)


def is_current(database: Database) -> bool:
    """Return whether the tables are those of this program; nothing is changed."""
    with database.engine.connect() as connection:
        return _revision(connection) == _known()[-1]


def require_current(database: Database) -> None:
    """Raise DatabaseError if the tables are not those of this program; nothing is changed."""
    with database.engine.connect() as connection:
        if not _has_tables(connection):
            raise DatabaseError("the database has no tables of relit: relit serve makes them")
        found = _revision(connection)
    if found != _known()[-1]:
        _require_known(found)
        raise DatabaseError("the database has the tables of an older relit: relit serve of this version upgrades them")


def _has_tables(connection: sa.Connection) -> bool:
    return sa.inspect(connection).has_table(tables.jobs.name)


def _revision(connection: sa.Connection) -> str | None:
    if not sa.inspect(connection).has_table(REVISIONS):
        return None
    version = sa.column("version_num", sa.String)  # as Alembic names it
    return connection.execute(sa.select(version).select_from(sa.table(REVISIONS))).scalar_one_or_none()


def _known() -> list[str]:
    """Return the revisions that this program knows, by the names of their files, oldest first."""
    return sorted(file.name[1:].partition("_")[0] for file in (MIGRATIONS / "versions").glob("r*.py"))


def _require_known(found: str | None) -> None:
    if found is None or found < _known()[0]:
        raise DatabaseError(f"the database has the tables of an early relit (revision {found or 'none'}): start relit serve of version "
                            "0.1.0 with it once, which upgrades them to those that this version knows")
    if found not in _known():
        raise DatabaseError(f"the database has the tables of a newer relit (revision {found}): "
                            "use that program, or another data folder or database")
