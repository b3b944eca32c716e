"""The audit log: a line for each change, in its transaction; it neither changes nor grows without bound."""

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.requests.keys import Scope
from service.server.database import audit
from service.server.database.keys import DAY_S, Caller

CALLER = Caller("larch", Scope.WRITE, "key_0123456789abcdefghjk")


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


def write(database, at, *, actions=("job.submit",), project="larch"):
    """Write lines one second after the other."""
    database.transact(lambda connection: connection.execute(audit.audit.insert(), [
        {"project": project, "at": at + second, "actor": CALLER.key, "action": action, "object": f"job_{second}"}
        for second, action in enumerate(actions)]))


def test_old_lines_go_and_the_rest_stays_protected(database):
    now = 1000 * DAY_S
    for days in (500, 401, 399, 1):
        write(database, now - days * DAY_S)
    assert audit.prune(database, before=now - 400 * DAY_S, now=now) == 2
    assert [round((now - row["at"]) / DAY_S) for row in audit.listing(database, limit=9)] == [1, 399]
    assert audit.prune(database, before=now - 400 * DAY_S, now=now) == 0
    with pytest.raises(DBAPIError, match=audit.REFUSAL):
        database.transact(lambda connection: connection.execute(audit.audit.delete()))


def test_a_project_that_changes_very_much_in_a_day_is_summed_up(database, monkeypatch):
    """Who did what how often stays known."""
    monkeypatch.setattr(audit, "MOST_A_DAY", 3)
    noon = 1000.5 * DAY_S
    write(database, noon - DAY_S, actions=("job.submit",) * 4)
    write(database, noon, actions=("key.create", "intake.create", "intake.create", "intake.create", "intake.delete", "intake.create"))
    write(database, noon, project="willow", actions=("job.submit",) * 3)

    def lines(project="larch"):
        return [(row["action"], row["object"]) for row in reversed(audit.listing(database, project=project, limit=99)) if row["at"] >= noon]

    first = [("key.create", "job_0"), ("intake.create", "job_1"), ("intake.create", "job_2")]
    for deleted, created in ((2, 2), (0, 2)):
        assert audit.prune(database, before=0.0, now=noon + 3600) == deleted - (deleted and 1)
        assert lines() == [*first, ("intake.create", f"{created} more"), ("intake.delete", "1 more")]
    write(database, noon + 3600, actions=("intake.create",) * 5)
    audit.prune(database, before=0.0, now=noon + 2 * 3600)
    assert lines() == [*first, ("intake.create", "7 more"), ("intake.delete", "1 more")]
    assert len(lines("willow")) == 3
    assert [row["object"] for row in audit.listing(database, limit=99) if row["at"] < noon] == ["1 more", "job_2", "job_1", "job_0"]
