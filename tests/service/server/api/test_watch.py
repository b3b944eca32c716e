"""The watcher of jobs: one look at the database serves all who listen, whoever is slow, leaves, or finds the database away."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator

import pytest
import sqlalchemy as sa
from fastapi import FastAPI
from sqlalchemy.exc import OperationalError

from service.requests.base.identifiers import new_id
from service.requests.jobs import SolveJob
from service.server.api import events, watch
from service.server.api.problems import ApiError
from service.server.api.watch import Change, Listener, Watcher
from service.server.base import log
from service.server.base.settings import Settings
from service.server.database import jobs, tables
from service.server.database.engine import Database
from tests.service.server.api.asgi import Call, app_of, asynchronous

PROJECT, OTHER = "larch", "birch"
WAIT_S = 60.0


@pytest.fixture
def app(tmp_path) -> Iterator[FastAPI]:
    with app_of(Settings(data=tmp_path, anonymous=True)) as made:
        yield made


@pytest.fixture
def database(app) -> Database:
    return app.state.service.database


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(watch, "TICK_S", 0.01)
    monkeypatch.setattr(events, "SILENCE_S", 0.05)


def queue(database: Database, project: str = PROJECT) -> str:
    return database.transact(lambda connection: jobs.insert(
        connection, project=project, request=SolveJob(kind="solve", capture=new_id("cap"))))


def put(database: Database, job: str, **values) -> None:
    database.transact(lambda connection: connection.execute(tables.jobs.update().where(tables.jobs.c.id == job).values(
        revision=tables.jobs.c.revision + 1, updated_at=time.time(), **values)))


async def next_of(listener: Listener) -> list[Change]:
    news = await listener.take(WAIT_S)
    assert news, "nothing came"
    return news


@asynchronous
async def test_one_look_at_the_database_serves_all(database, quick):
    made = [queue(database) for _ in range(20)]
    asked: list[str] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda _c, _cursor, statement, *_: asked.append(statement))
    watcher = Watcher(database, threading.Event())
    listeners = [watcher.listen(job) for job in made for _ in range(20)] + [watcher.listen(PROJECT) for _ in range(20)]
    for listener in listeners[:-20]:
        change, = await next_of(listener)
        assert (change.job, change.revision, change.ended) == (listener.topic, 1, False)
    for listener in listeners[-20:]:
        assert {change.job for change in await next_of(listener)} == set(made)
    assert len(asked) <= 4  # two looks at the most: the jobs that there are, and those that are new
    asked.clear()
    threads = threading.active_count()
    put(database, made[0], stage="frames", done=3, total=9)
    for listener in listeners[:20] + listeners[-20:]:
        change, = await next_of(listener)
        view = json.loads(change.data)
        assert (change.job, view["revision"], view["progress"]["done"]) == (made[0], 2, 3)
    for listener in listeners[20:-20]:
        assert await listener.take(0.0) == []  # those of the others are told nothing
    assert threading.active_count() - threads < 20  # a pool's at the most, none for each who listens
    assert len([statement for statement in asked if "relit_jobs.request" in statement]) == 1  # made once for all
    for listener in listeners:
        watcher.remove(listener)


@asynchronous
async def test_who_leaves_is_forgotten_and_with_the_last_one_the_watching_ends(database, quick):
    job = queue(database)
    watcher = Watcher(database, threading.Event())
    first, second = watcher.listen(job), watcher.listen(PROJECT)
    await next_of(first)
    task = watcher._task
    watcher.remove(first)
    watcher.remove(second)
    assert watcher._listeners == {}
    await asyncio.wait_for(task, WAIT_S)
    assert watcher._seen == {}
    third = watcher.listen(job)  # and begins again
    assert [change.revision for change in await next_of(third)] == [1]
    watcher.remove(third)


@asynchronous
async def test_only_the_last_of_several_changes_is_kept_for_one_who_is_slow(monkeypatch):
    listener = Listener(PROJECT, 0)
    for revision in range(1, 1000):
        listener.offer(Change("a", revision, False, "{}"))
    assert [change.revision for change in await next_of(listener)] == [999]
    for number in range(watch.MAX_PENDING + 1):
        listener.offer(Change(str(number), 1, False, "{}"))
    assert await listener.take(0.0) is None  # it comes back, and begins again


@asynchronous
async def test_a_database_that_does_not_answer_is_waited_for(database, quick, monkeypatch, capfd):
    log.configure("info", "json")  # to the standard error of this test, whatever ran before it
    job = queue(database)
    away = threading.Event()
    ask = jobs.watched

    def answer(*arguments):
        if away.is_set():
            raise OperationalError("SELECT", {}, Exception("the server went away"))
        return ask(*arguments)

    monkeypatch.setattr(jobs, "watched", answer)
    watcher = Watcher(database, threading.Event())
    listener = watcher.listen(job)
    await next_of(listener)
    away.set()
    put(database, job, state=jobs.RUNNING)
    assert await listener.take(0.2) == []
    away.clear()
    change, = await next_of(listener)
    assert json.loads(change.data)["state"] == "running"
    watcher.remove(listener)
    said = capfd.readouterr()
    assert (said.out + said.err).count("events wait") == 1  # once, however long it takes


@asynchronous
async def test_a_fault_of_our_own_leaves_nobody_waiting(database, quick, monkeypatch):
    def fault(*_):
        raise ValueError("a fault")

    monkeypatch.setattr(jobs, "watched", fault)
    watcher = Watcher(database, threading.Event())
    assert await watcher.listen(queue(database)).take(WAIT_S) is None


@asynchronous
async def test_a_deleted_job_is_gone(database, quick):
    job, other = queue(database), queue(database)
    watcher = Watcher(database, threading.Event())
    one, whole = watcher.listen(job), watcher.listen(PROJECT)
    await next_of(one)
    await next_of(whole)
    database.transact(lambda connection: connection.execute(tables.jobs.delete().where(tables.jobs.c.id == job)))
    assert await next_of(one) == [Change(job, 1, True, None)] == await next_of(whole)
    late = watcher.listen(job)  # it was there when it was looked up, and is not any more
    assert await next_of(late) == [Change(job, 0, True, None)]
    assert await one.take(0.1) == [] == await whole.take(0.0)  # told once
    put(database, other, state=jobs.FAILED, error="it is so")
    change, = await next_of(whole)
    assert (change.job, change.ended) == (other, True)


@asynchronous
async def test_a_project_is_told_of_its_own_jobs_alone(database, quick):
    mine, theirs, past = queue(database), queue(database, OTHER), queue(database)
    put(database, past, state=jobs.SUCCEEDED)
    long_ago = time.time() - 2 * jobs.LATELY_S
    database.transact(lambda connection: connection.execute(
        tables.jobs.update().where(tables.jobs.c.id == past).values(updated_at=long_ago, finished_at=long_ago)))
    watcher = Watcher(database, threading.Event())
    listener = watcher.listen(PROJECT)
    assert [change.job for change in await next_of(listener)] == [mine]
    put(database, theirs, state=jobs.RUNNING)
    assert await listener.take(0.1) == []
    put(database, past, state=jobs.QUEUED, attempt=2)  # tried again
    assert [change.job for change in await next_of(listener)] == [past]


@asynchronous
async def test_there_is_a_limit_and_an_end(database, quick):
    closing = threading.Event()
    watcher = Watcher(database, closing, most=2)
    first, _second = watcher.listen(PROJECT), watcher.listen(OTHER)
    with pytest.raises(ApiError) as refused:
        watcher.listen(OTHER)
    assert refused.value.kind == "unavailable" and "Retry-After" in refused.value.headers
    watcher.remove(first)
    last = watcher.listen(PROJECT)
    closing.set()
    assert await last.take(WAIT_S) is None
    with pytest.raises(ApiError):
        watcher.listen(PROJECT)


@asynchronous
async def test_who_closes_the_connection_is_forgotten_and_who_stays_hears_that_the_service_is_there(app, database, quick):
    job = queue(database, "default")
    watcher = app.state.service.watcher
    call = Call(app, f"/v1/jobs/{job}/events")
    running = asyncio.create_task(call.run())
    deadline = time.monotonic() + WAIT_S
    while call.body.count(b": ping") < 2:
        assert time.monotonic() < deadline and not running.done()
        await asyncio.sleep(0.01)
    assert watcher._listeners.keys() == {job}
    call.leave()
    await asyncio.wait_for(running, WAIT_S)
    assert watcher._listeners == {}
