"""Two API processes over one database: quotas and the queue are those of the service, not of a process."""

from collections import Counter
from collections.abc import Iterator

import httpx2
import pytest

from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted
from tests.service.server_process import Server, serving
from tests.service.waiting import at_once

pytestmark = pytest.mark.long

CAPTURES, QUEUED, AT_ONCE = 4, 3, 8


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def apis(request, tmp_path_factory) -> Iterator[tuple[Server, Server]]:
    """Two processes over one database; with SQLite also over one data folder."""
    url = {} if request.param == "sqlite" else {"database_url": request.getfixturevalue("server_postgres").new_database()}
    settings = {"min_free_bytes": "0", "roots": str(SAMPLES), "max_queued": str(QUEUED),
                "project_quotas": f"rowan:max_project_captures={CAPTURES}"} | url
    folder = tmp_path_factory.mktemp("apis")
    with (serving(folder, "--device", "none", **settings) as first,
          serving(folder / "second" if url else folder, "--device", "none", **settings) as second):
        yield first, second


def statuses(clients: list[httpx2.Client], path: str, body: dict) -> Counter[int]:
    """Send a request many times at once to the two in turn, and count what they answer."""
    return Counter(at_once(2 * AT_ONCE, lambda number: clients[number % 2].post(path, json=body).status_code))


def test_what_is_created_at_once_keeps_within_the_quota_and_the_queue(apis):
    with apis[0].client(apis[0].key("rowan")) as one, apis[1].client(apis[1].key("rowan")) as two:
        assert statuses([one, two], "/v1/captures", {"name": "x"}) == {201: CAPTURES, 429: 2 * AT_ONCE - CAPTURES}
    key = apis[0].key()
    with apis[0].client(key) as one, apis[1].client(key) as two, apis[0].database() as database:
        job = {"kind": "solve", "capture": accepted(database, one, "larch", SAMPLES / "owl")}
        assert statuses([one, two], "/v1/jobs", job) == {202: QUEUED, 429: 2 * AT_ONCE - QUEUED}
