"""Limits of event streams across processes, and what a process held that died; `test_two_apis` has them over HTTP."""

import asyncio
import time
from collections.abc import Iterator

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from service.requests.keys import Scope
from service.server.api import stream_leases
from service.server.api.problems import ApiError
from service.server.api.stream_leases import StreamLeases
from service.server.database import streams, tables
from service.server.database.engine import Database, connect
from service.server.database.keys import Caller
from service.server.database.streams import LEASE_S, Holder, Limits
from service.server.jobs.queue import prepare
from service.server.settings import Settings

WAIT_S = 20.0
LARCH, OTHER = Holder("larch", "key_a"), Holder("larch", "key_b")


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request) -> str | None:
    return None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()


@pytest.fixture
def database(url, tmp_path) -> Iterator[Database]:
    settings = Settings(data=tmp_path / "data", database_url=url)
    made = connect(settings.sqlalchemy_url)
    prepare(settings, made)
    yield made
    made.close()


def rows(database: Database) -> dict[tuple[str, str], int]:
    return {(row["process"], row["key"]): row["open"] for row in database.rows(sa.select(tables.streams))}


def test_processes_share_the_limits_of_a_key_and_of_a_project(database):
    limits = Limits(of_project=4, of_key=3)
    assert streams.record(database, "one", {}, [LARCH, LARCH], limits) == [None, None]
    answers = streams.record(database, "two", {}, [LARCH, LARCH, OTHER, OTHER, Holder("birch", "key_c")], limits)
    assert [answer is None for answer in answers] == [True, False, True, False, True]
    assert "this key has 3" in answers[1] and "this project has 4" in answers[3]
    assert rows(database) == {("one", "key_a"): 2, ("two", "key_a"): 1, ("two", "key_b"): 1, ("two", "key_c"): 1}
    streams.record(database, "one", {LARCH: 1}, [], limits)
    assert streams.record(database, "two", {LARCH: 1, OTHER: 1}, [OTHER], limits) == [None]
    streams.record(database, "two", {}, [], limits)
    assert rows(database) == {("one", "key_a"): 1}


@pytest.mark.parametrize("shift_s", [-2 * LEASE_S, 1e9], ids=["died", "its clock was set"])
def test_what_a_dead_process_held_expires(database, shift_s):
    limits = Limits(of_project=9, of_key=2)
    assert streams.record(database, "dead", {}, [LARCH, LARCH], limits) == [None, None]
    assert streams.record(database, "alive", {}, [LARCH], limits) != [None]
    database.transact(lambda connection: connection.execute(tables.streams.update().values(until=tables.streams.c.until + shift_s)))
    assert streams.record(database, "alive", {}, [LARCH, LARCH, LARCH], limits)[:2] == [None, None]
    assert rows(database) == {("alive", "key_a"): 2}


@pytest.fixture
def counted(database) -> list[str]:
    """The statements that change the table."""
    found: list[str] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda _c, _cursor, statement, *_: found.append(statement)
                    if statement.startswith(("INSERT", "DELETE", "UPDATE")) else None)
    return found


def test_streams_that_are_opened_at_once_share_a_transaction_and_open_ones_cost_nothing(database, counted, monkeypatch):
    monkeypatch.setattr(stream_leases, "SETTLE_S", 0.05)
    caller = Caller("larch", Scope.READ, "key_a")

    async def follow() -> None:
        leases = StreamLeases(database, Limits(of_project=100, of_key=40))
        taken = await asyncio.gather(*(leases.take(caller) for _ in range(60)), return_exceptions=True)
        assert [isinstance(each, ApiError) for each in taken] == [False] * 40 + [True] * 20
        assert len(counted) <= 4  # the first alone, the others together; one to delete and one to insert for each
        counted.clear()
        await asyncio.sleep(0.3)
        for _ in range(100):
            with pytest.raises(ApiError):
                await leases.take(caller)
        assert counted == []  # neither what is open nor what this process refuses asks the database
        for _ in range(39):
            leases.release(LARCH)
        await until(lambda: sum(rows(database).values()) == 1)
        assert len(counted) <= 4
        leases.release(LARCH)
        await asyncio.wait_for(leases._task, WAIT_S)  # with the last stream the counting ends
        assert rows(database) == {}

    asyncio.run(follow())


def test_a_refusal_by_other_processes_is_remembered_for_a_moment(database, counted):
    streams.record(database, "other", {}, [LARCH], Limits(9, 1))
    counted.clear()

    async def follow() -> None:
        leases = StreamLeases(database, Limits(of_project=9, of_key=1))
        for _ in range(50):
            with pytest.raises(ApiError) as refused:
                await leases.take(Caller("larch", Scope.READ, "key_a"))
            assert refused.value.kind == "too-many" and "Retry-After" in refused.value.headers
        assert len(counted) <= 2 * 3  # at most one a second, on a slow machine

    asyncio.run(follow())


def test_streams_go_on_while_the_database_is_away_and_are_counted_again(database, monkeypatch):
    monkeypatch.setattr(stream_leases, "RENEW_S", 0.05)
    caller, record = Caller("larch", Scope.READ, "key_a"), streams.record

    def away(*_):
        raise OperationalError("DELETE", {}, Exception("the server went away"))

    async def follow() -> None:
        leases = StreamLeases(database, Limits(of_project=9, of_key=2))
        await leases.take(caller)
        monkeypatch.setattr(streams, "record", away)
        with pytest.raises(OperationalError):
            await leases.take(caller)
        database.transact(lambda connection: connection.execute(tables.streams.delete()))  # they expire meanwhile
        monkeypatch.setattr(streams, "record", record)
        await until(lambda: sum(rows(database).values()) == 1)
        leases.release(await leases.take(caller))
        leases.release(LARCH)
        await asyncio.wait_for(leases._task, WAIT_S)

    asyncio.run(follow())


async def until(holds) -> None:
    deadline = time.monotonic() + WAIT_S
    while not await asyncio.to_thread(holds):
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)
