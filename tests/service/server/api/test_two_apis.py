"""Two API processes over one database: quotas and the queue are those of the service, not of a process."""

import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import pytest

from service.requests.keys import NewKey, Scope
from service.server.base.settings import Settings
from service.server.database import intakes, jobs, keys
from service.server.database.engine import Database, connect
from tests.service.server.api.conftest import SAMPLES
from tests.service.server_process import Server, serving

pytestmark = pytest.mark.long

CAPTURES, QUEUED, AT_ONCE = 4, 3, 8


class Apis(NamedTuple):
    """Two processes and their database."""

    servers: tuple[Server, Server]
    database: Database

    def key(self, project: str) -> str:
        return keys.create(self.database, NewKey(project=project, name="x", scope=Scope.ADMIN))


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def apis(request, tmp_path_factory) -> Iterator[Apis]:
    url = None if request.param == "sqlite" else request.getfixturevalue("server_postgres").new_database()
    settings = {"min_free_bytes": "0", "roots": str(SAMPLES), "max_queued": str(QUEUED),
                "project_quotas": f"rowan:max_project_captures={CAPTURES}"}
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

