"""Databases of older programs, upgraded when they are opened; and databases that are refused."""

import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory

from service.server.base.settings import Settings
from service.server.database import audit, intakes, jobs, keys, schema, tables, uploads
from service.server.database.engine import Database, DatabaseError, connect
from service.server.database.schema import REVISIONS, is_current, require_current, upgrade
from service.server.jobs.queue import prepare
from tests.service.server.prepared import opened

OLDEST = Path(__file__).parent / "schema_0009.sql"
CAPTURE, RECEIVING, UPLOAD = "cap_0123456789abcdefghjk", "cap_1123456789abcdefghjk", "upl_0123456789abcdefghjk"
DONE, WAITING, KEY = "job_0123456789abcdefghjk", "job_1123456789abcdefghjk", "key_0123456789abcdefghjk"


@pytest.fixture(params=["sqlite", "postgresql"])
def settings(request, tmp_path) -> Settings:
    """Settings of a service whose database is empty."""
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    made = Settings(data=tmp_path / "data", database_url=url)
    made.data.mkdir()
    return made


@pytest.fixture
def database(settings):
    made = connect(settings.sqlalchemy_url)
    yield made
    made.close()


@pytest.fixture
def yesterday(database) -> Database:
    """The database of relit 0.1.0, with something in the tables that matter."""
    text = "\n".join(line for line in OLDEST.read_text().splitlines() if not line.startswith("--"))
    text = text.replace("<BYTEWISE>", "" if database.is_sqlite else 'COLLATE "C"')
    text = text.replace("<NUMBER>", "INTEGER NOT NULL" if database.is_sqlite else "SERIAL")
    text = text.replace("<LARGE NUMBER>", "INTEGER NOT NULL" if database.is_sqlite else "BIGSERIAL")
    with database.engine.begin() as connection:
        for statement in text.split(";\n"):
            if statement.strip():
                connection.exec_driver_sql(statement)
    return database


def differences(database: Database) -> list:
    """Between the tables of the database and those that the program declares."""
    with database.engine.connect() as connection:
        ours = tables.metadata.tables
        options = {"include_name": lambda name, kind, _: kind != "table" or name in ours}  # the others are those of DBOS and Alembic
        return compare_metadata(MigrationContext.configure(connection, opts=options), tables.metadata)


def test_yesterdays_database_is_upgraded_and_keeps_all_it_has(settings, yesterday):
    assert not is_current(yesterday)
    with pytest.raises(DatabaseError, match="tables of an older relit: relit serve of this version"):
        require_current(yesterday)  # who only reads upgrades nothing
    prepare(settings, yesterday)
    require_current(yesterday)
    assert differences(yesterday) == []
    caller = keys.find(yesterday, f"{KEY}.yesterday")
    assert caller is not None and (caller.project, caller.scope.value, caller.key) == ("larch", "write", KEY)
    assert intakes.find(yesterday, CAPTURE, "larch")["facts"] == {"captures": 1}
    assert uploads.find(yesterday, UPLOAD, "larch")["received"] == 40
    assert [row["path"] for row in uploads.listing(yesterday, RECEIVING, limit=9)] == ["Capture.json"]
    assert [row["id"] for row in jobs.latest(yesterday, "larch", limit=9)] == [WAITING, DONE]
    waiting = jobs.find(yesterday, WAITING, "larch")
    assert (waiting["state"], waiting["attempt"], waiting["lost"], waiting["priority"]) == ("queued", 2, 2, 60)
    assert yesterday.transact(lambda connection: jobs.users_of(connection, CAPTURE)) == [WAITING]
    assert yesterday.row(sa.select(tables.idempotency.c.made))["made"] == DONE
    assert [row["object"] for row in audit.listing(yesterday, limit=9)] == [DONE]
    assert [row["text"] for row in jobs.log_of(yesterday, DONE)] == ["succeeded"]
    assert yesterday.transact(lambda connection: jobs.cancel(connection, WAITING))  # it can be changed, too


def test_a_new_database_equals_an_upgraded_one(settings, database):
    assert not is_current(database)
    with pytest.raises(DatabaseError, match="has no tables of relit: relit serve makes them"):
        require_current(database)
    assert sa.inspect(database.engine).get_table_names() == []
    prepare(settings, database)
    assert is_current(database)
    prepare(settings, database)  # a second process finds nothing to do
    require_current(database)
    assert differences(database) == []


def test_the_revisions_are_those_of_alembic(database):
    upgrade(database)
    script = ScriptDirectory(str(Path(schema.__file__).parent / "migrations"))
    with database.engine.connect() as connection:
        assert MigrationContext.configure(connection, opts={"version_table": REVISIONS}).get_current_revision() == script.get_current_head()
    assert len(list(script.walk_revisions())) == len(list(Path(script.versions).glob("*.py")))


def test_an_open_database_needs_nothing_of_alembic(tmp_path):
    with opened(Settings(data=tmp_path)) as made:
        url = made.engine.url.render_as_string()
    code = ("import sys; from service.server.database.engine import connect; from service.server.database.schema import upgrade; "
            f"upgrade(connect({url!r})); assert 'alembic' not in sys.modules")
    subprocess.run([sys.executable, "-c", code], check=True)


def test_an_upgrade_that_fails_changes_nothing(yesterday, monkeypatch):
    monkeypatch.setattr("alembic.command.upgrade", fail)
    with pytest.raises(ZeroDivisionError):
        upgrade(yesterday)
    with yesterday.engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT version FROM relit_about").scalar() == 2
        assert connection.exec_driver_sql(f"SELECT version_num FROM {REVISIONS}").scalar() == "0009"


def fail(config, _revision):
    config.attributes["connection"].exec_driver_sql("UPDATE relit_about SET version = 7")
    raise ZeroDivisionError


@pytest.mark.parametrize("opened", [upgrade, require_current])
@pytest.mark.parametrize("revision", ["0008", None])
def test_a_database_from_before_the_oldest_revision_says_how_to_bring_it_over(yesterday, opened, revision):
    with yesterday.engine.begin() as connection:
        connection.exec_driver_sql(f"DROP TABLE {REVISIONS}" if revision is None else f"UPDATE {REVISIONS} SET version_num = '{revision}'")
    with pytest.raises(DatabaseError, match=rf"early relit \(revision {revision or 'none'}\): start relit serve of version 0.1.0"):
        opened(yesterday)


@pytest.mark.parametrize("opened", [upgrade, require_current])
def test_the_database_of_a_newer_program_is_refused(database, opened):
    upgrade(database)
    with database.engine.begin() as connection:
        connection.exec_driver_sql(f"UPDATE {REVISIONS} SET version_num = '9999'")
    with pytest.raises(DatabaseError, match=r"tables of a newer relit \(revision 9999\): use that program"):
        opened(database)
