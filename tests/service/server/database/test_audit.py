"""The audit log: a line for each change, in its transaction, for ever."""

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.requests.keys import Scope
from service.server.database import audit
from service.server.database.engine import connect
from service.server.database.keys import Caller
from service.server.database.schema import upgrade
from service.server.settings import Settings

CALLER = Caller("larch", Scope.WRITE, "key_0123456789abcdefghjk")


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path):
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    settings = Settings(data=tmp_path, database_url=url)
    made = connect(settings.sqlalchemy_url)
    upgrade(made)
    yield made
    made.close()


def test_lines_are_listed_by_project_the_newest_first(database):
    for project, target in (("larch", "job_1"), ("willow", "job_2"), ("larch", "job_3")):
        database.transact(lambda connection, project=project, target=target: audit.record(
            connection, CALLER._replace(project=project), "job.submit", target))
    assert [row["object"] for row in audit.listing(database, limit=9)] == ["job_3", "job_2", "job_1"]
    assert [row["object"] for row in audit.listing(database, project="larch", limit=1)] == ["job_3"]
    assert audit.listing(database, limit=1)[0]["actor"] == CALLER.key


def test_a_change_that_is_rolled_back_leaves_no_line(database):
    def work(connection):
        audit.record(connection, CALLER, "job.submit", "job_1")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        database.transact(work)
    assert audit.listing(database, limit=9) == []


@pytest.mark.parametrize("statement", ["UPDATE relit_audit SET actor = 'another'", "DELETE FROM relit_audit"])
def test_a_line_is_neither_changed_nor_deleted(database, statement):
    database.transact(lambda connection: audit.record(connection, CALLER, "job.submit", "job_1"))
    with pytest.raises(DBAPIError, match="the audit log is append-only"):
        database.transact(lambda connection: connection.execute(sa.text(statement)))
    assert [row["actor"] for row in audit.listing(database, limit=9)] == [CALLER.key]
