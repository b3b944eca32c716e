"""How often a key may ask across processes: leases of its bucket; `test_two_apis` has them over HTTP."""

import asyncio
import random
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from service.server.api import request_leases
from service.server.api.access import RateLimiter
from service.server.api.problems import ApiError
from service.server.api.request_leases import RequestLeases
from service.server.database import exclusive, rates, tables
from service.server.database.engine import Database, connect
from service.server.database.rates import LEASE_S, SHARE, Rate, Wanted
from service.server.jobs.queue import prepare
from service.server.settings import Settings

WAIT_S = 20.0
SLOW = Rate(0.001, 80)
"""So slow that no test gains a token."""


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path) -> Iterator[Database]:
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    settings = Settings(data=tmp_path / "data", database_url=url)
    made = connect(settings.sqlalchemy_url)
    prepare(settings, made)
    yield made
    made.close()


class Clock:
    """The time of the database and of every process, as a test sets it."""

    def __init__(self, monkeypatch) -> None:
        self.now = 1e9
        monkeypatch.setattr(exclusive, "now", lambda _connection: self.now)


class Process:
    """A process that asks again when its lease is used up or has expired, as RequestLeases does."""

    def __init__(self, database: Database, clock: Clock, name: str, rate: Rate) -> None:
        self._database, self._clock, self._name, self._rate = database, clock, name, rate
        self._held, self._until = 0, 0.0
        self.asked = 0

    def take(self) -> bool:
        if self._held and self._clock.now < self._until:
            self._held -= 1
            return True
        self.asked += 1
        leased = rates.lease(self._database, self._name, [Wanted("a", 1, self._held)], self._rate)[0]
        self._held, self._until = max(0, leased.tokens - 1), self._clock.now + LEASE_S
        return leased.tokens > 0


@pytest.mark.parametrize("rate", [Rate(5.0, 20), Rate(50.0, 200), Rate(1.0, 1)], ids=str)
def test_no_window_of_time_has_more_than_the_bucket_allows(tmp_path, monkeypatch, rate):
    """Four processes, requests at random moments, sometimes a lull in which leases expire: used(window) ≤ burst + rate · window.

    And nearly as many are served as by one process with the same limit.
    """
    database = connect(f"sqlite:///{tmp_path / 'x.sqlite'}")
    tables.metadata.create_all(database.engine)
    clock, chance = Clock(monkeypatch), random.Random(7)
    processes = [Process(database, clock, name, rate) for name in "abcd"]
    served: list[float] = []
    alone, by_one = RateLimiter(rate.per_second, rate.burst, clock=lambda: clock.now), 0
    for number in range(600):
        clock.now += LEASE_S + 1 if number % 150 == 149 else chance.expovariate(2.5 * rate.per_second)
        if chance.choice(processes).take():
            served.append(clock.now)
        with suppress(ApiError):
            alone.take("a")
            by_one += 1
    database.close()
    for first, begin in enumerate(served):
        assert all(count <= rate.burst + rate.per_second * (end - begin) + 1e-3  # 1e-3: clock of 1e9 s and sums of float64
                   for count, end in enumerate(served[first:], 1))
    assert by_one >= len(served) > 0.85 * by_one


def test_a_process_alone_gets_the_whole_bucket_and_asks_seldom(database, monkeypatch):
    clock = Clock(monkeypatch)
    process = Process(database, clock, "a", SLOW)
    assert [process.take() for _ in range(SLOW.burst + 2)] == [True] * SLOW.burst + [False] * 2
    assert process.asked < SLOW.burst / 2


def test_a_key_that_asks_seldom_is_never_refused(database, monkeypatch):
    """What a lease did not use comes back: 0.4 requests a second are less than 0.5, whichever process is asked."""
    clock, rate = Clock(monkeypatch), Rate(0.5, 60)
    processes = [Process(database, clock, name, rate) for name in "ab"]
    for number in range(200):
        clock.now += 2.5 if number % 7 else LEASE_S + 1
        assert processes[number % 2].take()


def test_leases_of_a_dead_process_expire_and_a_clock_that_was_set_stops_nothing(database, monkeypatch):
    clock, rate = Clock(monkeypatch), Rate(8.0, 80)
    assert rates.lease(database, "dead", [Wanted("a", 20, 0)], rate)[0].tokens > 20
    assert rates.lease(database, "alive", [Wanted("a", 80, 0)], rate)[0].tokens < 60  # the rest is leased
    clock.now += 2 * LEASE_S
    assert rates.lease(database, "alive", [Wanted("a", 80, 0)], rate)[0].tokens == 80
    clock.now -= 1e6
    found = rates.lease(database, "alive", [Wanted("a", 1, 0)], rate)[0]
    assert found.tokens == 0 and found.wait_s == pytest.approx(1 / rate.per_second, rel=1e-6)
    clock.now += 1.0
    assert rates.lease(database, "alive", [Wanted("a", 1, 0)], rate)[0].tokens >= 1


def test_buckets_that_are_full_again_leave_no_row(database, monkeypatch):
    clock, rate = Clock(monkeypatch), Rate(8.0, 80)
    rates.lease(database, "one", [Wanted(key, 1, 0) for key in "abc"], rate)
    clock.now += 2 * LEASE_S
    rates.lease(database, "one", [Wanted("d", 1, 0)], rate)
    assert [row["key"] for row in database.rows(sa.select(tables.rates))] == ["d"]


@pytest.fixture
def counted(database) -> list[str]:
    """The statements that change the table."""
    found: list[str] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda _c, _cursor, statement, *_: found.append(statement)
                    if statement.startswith(("INSERT", "UPDATE")) else None)
    return found


def test_requests_at_once_share_a_transaction_and_refusals_cost_none(database, counted):
    async def follow() -> None:
        leases = RequestLeases(database, SLOW)
        found = await asyncio.gather(*(leases.take("a") for _ in range(SLOW.burst + 20)), return_exceptions=True)
        assert [isinstance(each, ApiError) for each in found] == [False] * SLOW.burst + [True] * 20
        assert len(counted) <= 3
        counted.clear()
        for _ in range(100):
            with pytest.raises(ApiError) as refused:
                await leases.take("a")
            assert refused.value.kind == "too-many" and 0 < int(refused.value.headers["Retry-After"]) <= 1000
            with pytest.raises(ApiError):
                leases.require("a")
        leases.require("b")
        assert counted == []
        for _ in range(SLOW.burst // SHARE):
            await leases.take("b")
        assert len(counted) == 1  # the lease

    asyncio.run(asyncio.wait_for(follow(), WAIT_S))


@pytest.mark.parametrize("patience_s", [60.0, 0.05], ids=["refuses to write", "is locked"])
def test_requests_go_on_while_the_database_is_away(database, monkeypatch, patience_s):
    """Each process has its own limit beside this one (`RateLimiter`)."""
    monkeypatch.setattr(request_leases, "PATIENCE_S", patience_s)
    monkeypatch.setattr(request_leases, "AWAY_S", 0.2)
    lease, called = rates.lease, []

    def away(*_):
        called.append(1)
        time.sleep(0.3 if patience_s < 1 else 0)
        raise OperationalError("UPDATE", {}, Exception("the disk is full"))

    async def follow() -> None:
        leases = RequestLeases(database, SLOW)
        monkeypatch.setattr(rates, "lease", away)
        for _ in range(2 * SLOW.burst if patience_s > 1 else 3):
            await leases.take("a")
        assert len(called) < 20
        monkeypatch.setattr(rates, "lease", lease)
        monkeypatch.setattr(request_leases, "PATIENCE_S", WAIT_S)  # the database may be slow again, and is waited for
        await asyncio.sleep(0.6)
        found = await asyncio.gather(*(leases.take("a") for _ in range(SLOW.burst + 5)), return_exceptions=True)
        assert 5 <= sum(isinstance(each, ApiError) for each in found) <= 5 + 3  # those that did not wait may be counted in the end

    asyncio.run(asyncio.wait_for(follow(), WAIT_S))
