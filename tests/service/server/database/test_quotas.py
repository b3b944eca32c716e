"""Quotas of projects, and that two requests at once do not both take the last place; and the audit log."""

from contextlib import suppress

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.errors import RequestError
from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import CheckJob, SolveJob
from service.requests.keys import Scope
from service.server.base.settings import Settings
from service.server.database import audit, intakes, jobs, quotas, tables, uploads
from service.server.database.engine import Database
from service.server.database.keys import DAY_S, Caller
from tests.service.waiting import at_once


def capture(connection, project: str) -> str:
    return intakes.insert(connection, project=project, kind=CAPTURE, name="x")


def allowed(database: Database, quota: str, project: str, more: int, **settings: object) -> bool:
    try:
        database.transact(lambda connection: quotas.require(connection, Settings(**settings), quota, project, more))
    except quotas.QuotaExceeded:
        return False
    return True


def test_bytes_are_those_of_uploads_and_results(database):
    def work(connection):
        place = capture(connection, "larch")
        uploads.insert(connection, project="larch", intake=place, path="a", length=60)
        job = jobs.insert(connection, project="larch", request=SolveJob(kind="solve", capture=place))
        connection.execute(tables.jobs.update().where(tables.jobs.c.id == job).values(result_bytes=30))

    database.transact(work)
    assert allowed(database, quotas.BYTES, "larch", 10, max_project_bytes=100)
    assert not allowed(database, quotas.BYTES, "larch", 11, max_project_bytes=100)
    assert allowed(database, quotas.BYTES, "larch", 11)
    assert allowed(database, quotas.BYTES, "willow", 100, max_project_bytes=100)


def test_checks_and_ended_jobs_do_not_count(database):
    def work(connection):
        for request in (SolveJob(kind="solve", capture=new_id(CAPTURE)), CheckJob(kind="check", intake=new_id(CAPTURE))):
            jobs.insert(connection, project="larch", request=request)
        jobs.cancel(connection, jobs.insert(connection, project="larch", request=SolveJob(kind="solve", capture=new_id(CAPTURE))))

    database.transact(work)
    assert allowed(database, quotas.JOBS, "larch", 1, max_project_jobs=2)
    assert not allowed(database, quotas.JOBS, "larch", 2, max_project_jobs=2)


def test_pixels_are_those_of_all_images_and_a_check_refuses_more(database):
    first, second = (database.transact(lambda connection: capture(connection, "larch")) for _ in range(2))
    for name in (first, second):
        database.transact(lambda connection, name=name: intakes.begin_check(connection, name))
    facts, settings = {"resolution": [10, 20], "frames": 3, "captures": 1}, Settings(max_project_pixels=1000)

    def allow(connection):
        quotas.require(connection, settings, quotas.PIXELS, "larch", quotas.pixels_of(facts))

    intakes.accept(database, first, facts, allow)
    with pytest.raises(RequestError, match="quota max_project_pixels: the project larch has 600 of 1000"):
        intakes.accept(database, second, facts, allow)
    assert intakes.find(database, second, "larch")["state"] == "checking"


def test_a_project_may_have_a_quota_of_its_own(database):
    database.transact(lambda connection: [capture(connection, project) for project in ("larch", "willow")])
    own = {"max_project_captures": 1, "project_quotas": "larch:max_project_captures=2,willow:max_project_bytes=1"}
    assert allowed(database, quotas.CAPTURES, "larch", 1, **own)
    assert not allowed(database, quotas.CAPTURES, "willow", 1, **own)


def test_several_at_once_do_not_all_take_the_last_place(database):
    """As in several API processes, each of eight transactions counts what the others have not yet written."""
    settings = Settings(max_project_captures=1)

    def work(connection):  # without an Idempotency-Key a request writes nothing before it counts
        quotas.require(connection, settings, quotas.CAPTURES, "larch", 1)
        return capture(connection, "larch")

    def is_taken(_: int) -> bool:
        with suppress(RequestError):
            database.transact(work)
            return True
        return False

    assert sum(at_once(8, is_taken)) == 1


CALLER = Caller("larch", Scope.WRITE, "key_0123456789abcdefghjk")


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
