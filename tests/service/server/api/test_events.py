"""Events: jobs as they change, for any number of listeners at the price of one, through restarts of the database."""

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest
import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from service.requests.identifiers import new_id
from service.requests.jobs import SolveJob
from service.server import log
from service.server.api import events, watch
from service.server.api.app import create_app
from service.server.api.problems import ApiError
from service.server.api.watch import Change, Listener, Watcher
from service.server.database import jobs, tables
from service.server.database.engine import Database, connect
from service.server.jobs.queue import prepare
from service.server.settings import Settings
from tests.service.postgres import binaries, postgres
from tests.service.server.api.asgi import Call
from tests.service.server_process import serving

PROJECT, OTHER = "larch", "birch"
WAIT_S = 60.0


def told(lines: Iterator[str]) -> Iterator[dict]:
    """The events of a stream: fields by name, data as JSON; a comment has none but itself."""
    event: dict = {}
    for line in lines:
        if line.startswith(":"):
            yield {"comment": line[1:].strip()}
        elif line:
            name, _, value = line.partition(": ")
            event[name] = json.loads(value) if name == "data" else value
        elif event:
            yield event
            event = {}


def watched(client: httpx2.Client, job: str, **headers: str) -> list[dict]:
    with client.stream("GET", f"/v1/jobs/{job}/events", headers=headers) as response:
        assert response.status_code == 200, response.read()
        assert response.headers["Content-Type"].startswith("text/event-stream")
        assert response.headers["Cache-Control"] == "no-cache"
        return [event for event in told(response.iter_lines()) if "comment" not in event]


def test_a_job_is_followed_to_its_end(server, client, dome, sky):
    job = client.post("/v1/jobs", json={"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-120"}}).json()
    found = watched(client, job["id"])
    assert {event["event"] for event in found} == {"job"}
    views = [event["data"] for event in found]
    assert [int(event["id"]) for event in found] == [view["revision"] for view in views]
    assert [view["revision"] for view in views] == sorted({view["revision"] for view in views})
    assert {view["id"] for view in views} == {job["id"]} and views[0]["request"] == job["request"] | {
        "options": job["request"]["options"] | {"frames": "1-120"}}
    states = [view["state"] for view in views]
    assert states[-1] == "succeeded" and set(states) <= {"queued", "running", "succeeded"} and len(views) > 2
    done = [view["progress"]["done"] for view in views if view["progress"] and view["progress"]["stage"] == "frames"]
    assert done == sorted(done) and done[-1] == 120
    assert views[-1] == client.get(f"/v1/jobs/{job['id']}").json()

    last = found[-1]["id"]
    middle = views[len(views) // 2]["revision"]
    again = watched(client, job["id"], **{"Last-Event-ID": str(middle)})
    assert [event["data"] for event in again] == [views[-1]]  # what became of it since; what lies between is past
    nothing = client.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": last})
    assert (nothing.status_code, nothing.content) == (204, b"")  # tells a browser to connect no more
    beyond = watched(client, job["id"], **{"Last-Event-ID": "999999999"})  # of a database that was put back
    assert [event["data"] for event in beyond] == [views[-1]]


def test_a_job_that_is_cancelled_and_resumed_is_told(server, client, dome, sky):
    request = {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-20000"}}
    job = client.post("/v1/jobs", json=request).json()["id"]
    with client.stream("GET", f"/v1/jobs/{job}/events") as response:
        found = told(response.iter_lines())
        while next(found)["data"]["state"] != "running":
            pass
        client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
        rest = list(found)
    assert rest[-1]["data"]["state"] == "cancelled" and [event["data"]["state"] for event in rest[:-1]] == ["running"] * (len(rest) - 1)
    client.post(f"/v1/jobs/{job}/resume").raise_for_status()
    with client.stream("GET", f"/v1/jobs/{job}/events", headers={"Last-Event-ID": rest[-1]["id"]}) as response:
        first = next(told(response.iter_lines()))["data"]
        assert first["attempt"] == 2 and first["state"] in ("queued", "running")
        client.post(f"/v1/jobs/{job}/cancel").raise_for_status()


def test_all_jobs_of_a_project_are_watched_at_once(server, client, dome):
    with client.stream("GET", "/v1/events") as response:
        found = told(response.iter_lines())
        made = [client.post("/v1/jobs", json={"kind": "solve", "capture": dome, "options": {"method": "lambert"}}).json()["id"]
                for _ in range(3)]
        ended: set[str] = set()
        deadline = time.monotonic() + WAIT_S
        while ended < set(made):
            event = next(found)
            if event.get("event") == "job" and event["data"]["state"] == "succeeded":
                ended.add(event["data"]["id"])
            assert time.monotonic() < deadline


def test_a_stream_that_cannot_be_is_refused(client, dome):
    nobody = new_id("job")
    response = client.get(f"/v1/jobs/{nobody}/events")
    assert (response.status_code, response.headers["Content-Type"]) == (404, "application/problem+json")
    job = client.post("/v1/jobs", json={"kind": "solve", "capture": dome, "options": {"method": "lambert"}}).json()["id"]
    response = client.get(f"/v1/jobs/{job}/events", headers={"Last-Event-ID": "now"})
    assert (response.status_code, response.json()["errors"][0]["field"]) == (422, "header.Last-Event-ID")


@pytest.fixture
def database(tmp_path) -> Iterator[Database]:
    settings = Settings(data=tmp_path)
    made = connect(settings.sqlalchemy_url)
    prepare(settings, made)
    yield made
    made.close()


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(watch, "TICK_S", 0.01)
    monkeypatch.setattr(events, "SILENCE_S", 0.05)


def queue(database: Database, project: str = PROJECT) -> str:
    return database.transact(lambda connection: jobs.insert(
        connection, project=project, key=None, request=SolveJob(kind="solve", capture=new_id("cap")), chunk_frames=1, inputs=[]))


def put(database: Database, job: str, **values) -> None:
    database.transact(lambda connection: connection.execute(tables.jobs.update().where(tables.jobs.c.id == job).values(
        revision=tables.jobs.c.revision + 1, updated_at=time.time(), **values)))


async def next_of(listener: Listener) -> list[Change]:
    news = await listener.take(WAIT_S)
    assert news, "nothing came"
    return news


def test_one_look_at_the_database_serves_all(database, quick):
    made = [queue(database) for _ in range(20)]
    asked: list[str] = []
    sa.event.listen(database.engine, "before_cursor_execute", lambda _c, _cursor, statement, *_: asked.append(statement))

    async def follow() -> None:
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

    asyncio.run(follow())


def test_who_leaves_is_forgotten_and_with_the_last_one_the_watching_ends(database, quick):
    job = queue(database)

    async def follow() -> None:
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

    asyncio.run(follow())


def test_only_the_last_of_several_changes_is_kept_for_one_who_is_slow(monkeypatch):
    async def lag() -> None:
        listener = Listener(PROJECT, 0)
        for revision in range(1, 1000):
            listener.offer(Change("a", revision, False, "{}"))
        assert [change.revision for change in await next_of(listener)] == [999]
        for number in range(watch.MAX_PENDING + 1):
            listener.offer(Change(str(number), 1, False, "{}"))
        assert await listener.take(0.0) is None  # it comes back, and begins again

    asyncio.run(lag())


def test_a_database_that_does_not_answer_is_waited_for(database, quick, monkeypatch, capfd):
    log.configure("info", "json")  # to the standard error of this test, whatever ran before it
    job = queue(database)
    away = threading.Event()
    ask = jobs.watched

    def answer(*arguments):
        if away.is_set():
            raise OperationalError("SELECT", {}, Exception("the server went away"))
        return ask(*arguments)

    monkeypatch.setattr(jobs, "watched", answer)

    async def follow() -> None:
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

    asyncio.run(follow())
    said = capfd.readouterr()
    assert (said.out + said.err).count("events wait") == 1  # once, however long it takes


def test_a_fault_of_our_own_leaves_nobody_waiting(database, quick, monkeypatch):
    def fault(*_):
        raise ValueError("a fault")

    monkeypatch.setattr(jobs, "watched", fault)

    async def follow() -> None:
        watcher = Watcher(database, threading.Event())
        assert await watcher.listen(queue(database)).take(WAIT_S) is None

    asyncio.run(follow())


def test_a_deleted_job_is_gone(database, quick):
    job, other = queue(database), queue(database)

    async def follow() -> None:
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

    asyncio.run(follow())


def test_a_project_is_told_of_its_own_jobs_alone(database, quick):
    mine, theirs, past = queue(database), queue(database, OTHER), queue(database)
    put(database, past, state=jobs.SUCCEEDED)
    long_ago = time.time() - 2 * jobs.LATELY_S
    database.transact(lambda connection: connection.execute(
        tables.jobs.update().where(tables.jobs.c.id == past).values(updated_at=long_ago, finished_at=long_ago)))

    async def follow() -> None:
        watcher = Watcher(database, threading.Event())
        listener = watcher.listen(PROJECT)
        assert [change.job for change in await next_of(listener)] == [mine]
        put(database, theirs, state=jobs.RUNNING)
        assert await listener.take(0.1) == []
        put(database, past, state=jobs.QUEUED, attempt=2)  # tried again
        assert [change.job for change in await next_of(listener)] == [past]

    asyncio.run(follow())


def test_there_is_a_limit_and_an_end(database, quick):
    closing = threading.Event()

    async def follow() -> None:
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

    asyncio.run(follow())


def test_who_closes_the_connection_is_forgotten_and_who_stays_hears_that_the_service_is_there(database, quick, tmp_path):
    app = create_app(Settings(data=tmp_path, anonymous=True), database)
    job = queue(database, "default")
    watcher = app.state.service.watcher

    async def follow() -> None:
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

    asyncio.run(follow())


def test_streams_end_with_the_service(tmp_path: Path):
    with serving(tmp_path, "--anonymous", "--device", "none", min_free_bytes="0") as server, server.client() as client:
        database = connect(Settings(data=server.data).sqlalchemy_url)
        job = queue(database, "default")
        database.close()
        with (client.stream("GET", f"/v1/jobs/{job}/events") as one, client.stream("GET", "/v1/events") as whole):
            found = told(one.iter_lines()), told(whole.iter_lines())
            assert [next(stream)["data"]["id"] for stream in found] == [job, job]
            server.process.terminate()
            assert [list(stream) for stream in found] == [[], []]  # they end, and do not break off
        assert server.process.wait(WAIT_S) == 0


@pytest.mark.long
@pytest.mark.skipif(binaries() is None, reason="no PostgreSQL server programs: neither on the PATH nor in /usr/lib/postgresql")
def test_streams_stay_open_while_postgresql_restarts(tmp_path: Path):
    with postgres(binaries()) as server_postgres:
        url = server_postgres.new_database()
        with (serving(tmp_path, "--anonymous", "--device", "none", database_url=url, min_free_bytes="0") as server,
              server.client() as client):
            database = connect(Settings(data=server.data, database_url=url).sqlalchemy_url)
            job = queue(database, "default")
            with client.stream("GET", f"/v1/jobs/{job}/events") as response:
                found = told(response.iter_lines())
                assert next(found)["data"]["state"] == "queued"
                server_postgres.restart("immediate", away_s=1.0)
                database.transact(lambda connection: jobs.cancel(connection, job), patience_s=WAIT_S)
                rest = [event for event in found if "comment" not in event]
            assert [event["data"]["state"] for event in rest] == ["cancelled"]
            database.close()
