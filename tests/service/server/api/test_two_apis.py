"""Two API processes over one database: a limit is that of the service, not of a process."""

import re
import signal
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import NamedTuple

import pytest

from service.requests.keys import NewKey, Scope
from service.server.database import intakes, jobs, keys, tables
from service.server.database.engine import Database, connect
from service.server.database.streams import LEASE_S
from service.server.settings import Settings
from tests.service.server.api.conftest import SAMPLES
from tests.service.server_process import Server, serving

pytestmark = pytest.mark.long

WAIT_S = 20.0
BURST, CAPTURES, QUEUED, AT_ONCE = 120, 4, 3, 8


class Apis(NamedTuple):
    """Two processes and their database."""

    servers: tuple[Server, Server]
    database: Database

    def key(self, project: str) -> str:
        return keys.create(self.database, NewKey(project=project, name="x", scope=Scope.ADMIN))


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def apis(request, tmp_path_factory) -> Iterator[Apis]:
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    settings = {"min_free_bytes": "0", "roots": str(SAMPLES), "max_streams": "3", "max_project_streams": "5", "max_queued": str(QUEUED),
                "requests_per_second": "0.001", "request_burst": str(BURST), "project_quotas": f"rowan:max_project_captures={CAPTURES}"}
    settings |= {} if url is None else {"database_url": url}
    folder = tmp_path_factory.mktemp("apis")
    second_folder = folder if url is None else folder / "second"  # SQLite: two processes over one data folder
    with serving(folder, "--device", "none", **settings) as first, serving(second_folder, "--device", "none", **settings) as second:
        database = connect(Settings(data=first.data, database_url=url).sqlalchemy_url)
        yield Apis((first, second), database)
        database.close()


def at_once(calls: Sequence[Callable[[], int]]) -> Counter[int]:
    """Make requests at the same time, and count their statuses."""
    found: list[int] = []
    together = threading.Barrier(len(calls))

    def run(call: Callable[[], int]) -> None:
        together.wait()
        found.append(call())

    threads = [threading.Thread(target=run, args=(call,)) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return Counter(found)


def test_requests_of_a_key_are_counted_together(apis):
    """A key had as many requests a second as there were API processes, times the limit."""
    mine, other = apis.key("larch"), apis.key("larch")
    with apis.servers[0].client(mine) as one, apis.servers[1].client(mine) as two:
        served = 0
        while (found := [client.get("/v1/jobs").status_code for client in (one, two)]) != [429, 429]:
            served += found.count(200)
        assert served == BURST
        refused = two.get("/v1/jobs")
        assert "more than 0.001 times a second" in refused.json()["detail"] and 0 < int(refused.headers["Retry-After"]) <= 1000
    for server in apis.servers:
        with server.client(other) as client:
            assert client.get("/v1/jobs").status_code == 200


def test_captures_that_are_created_at_once_keep_within_the_quota(apis):
    with apis.servers[0].client(apis.key("rowan")) as one, apis.servers[1].client(apis.key("rowan")) as two:
        calls = [lambda client=client: client.post("/v1/captures", json={"name": "x"}).status_code for client in (one, two)]
        assert at_once(calls * AT_ONCE) == {201: CAPTURES, 429: 2 * AT_ONCE - CAPTURES}


def test_jobs_that_are_submitted_at_once_keep_within_the_queue(apis):
    key = apis.key("larch")
    with apis.servers[0].client(key) as one, apis.servers[1].client(key) as two:
        capture = one.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).raise_for_status().json()["id"]
        intakes.accept(apis.database, capture, {"captures": 1})  # there is no worker that would check it
        for job in jobs.latest(apis.database, "larch", limit=100):
            apis.database.transact(lambda connection, job=job["id"]: jobs.cancel(connection, job))
        calls = [lambda client=client: client.post("/v1/jobs", json={"kind": "solve", "capture": capture}).status_code
                 for client in (one, two)]
        assert at_once(calls * AT_ONCE) == {202: QUEUED, 429: 2 * AT_ONCE - QUEUED}


def test_streams_are_counted_together_and_those_of_a_killed_process_expire(apis):
    """The last test here: it kills the first process."""
    first, second = apis.servers
    mine, fellow, other = apis.key("birch"), apis.key("birch"), apis.key("willow")
    with ExitStack() as opened:
        def stream(server: Server, key: str) -> tuple[int, socket.socket]:
            connection = socket.create_connection(("127.0.0.1", int(server.url.rpartition(":")[2])), timeout=WAIT_S)
            opened.callback(connection.close)
            connection.sendall(f"GET /v1/events HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {key}\r\n\r\n".encode())
            return int(re.match(rb"HTTP/1.1 (\d+)", connection.recv(4096))[1]), connection

        def soon(server: Server, key: str) -> None:
            deadline = time.monotonic() + WAIT_S
            while stream(server, key)[0] != 200:
                assert time.monotonic() < deadline
                time.sleep(0.5)

        held = stream(first, mine)[1]
        assert [stream(server, mine)[0] for server in (first, second, first, second)] == [200, 200, 429, 429]
        assert [stream(server, fellow)[0] for server in (second, first, second)] == [200, 200, 429]
        assert stream(second, other)[0] == 200
        held.close()
        soon(second, mine)  # once the first has told
        first.process.send_signal(signal.SIGKILL)
        first.process.wait()
        assert stream(second, mine)[0] == 429
        apis.database.transact(lambda connection: connection.execute(  # time passes: the living process writes its own again
            tables.streams.update().values(until=tables.streams.c.until - 2 * LEASE_S)))
        soon(second, mine)
