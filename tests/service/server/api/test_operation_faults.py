"""A service whose database or worker goes and comes back, and which ends when it is asked to."""

import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from service.server.database import jobs, workers
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted, admitted, refused, submit
from tests.service.server.api.test_events import told
from tests.service.server_process import Server, children_of, environment_with, serving
from tests.service.waiting import PATIENCE_S, at_once, until

pytestmark = pytest.mark.long

DRAIN_S = 4.0
"""Drain time, in seconds, of the server that is ended while it works, on a step that never ends."""


def test_a_database_that_goes_away_and_comes_back(tmp_path, server_postgres):
    with serving(tmp_path, "--anonymous", "--device", "none", database_url=server_postgres.new_database()) as server, \
            server.client() as client:
        assert client.get("/v1/jobs").status_code == 200
        server_postgres.stop("immediate")
        refused(client.get("/v1/jobs"), 503, "database does not answer")
        until(lambda: "the database does not answer" in client.get("/readyz").json()["detail"], "it does not say so")
        assert client.get("/healthz").status_code == 200 and "relit_database_up 0.0" in client.get("/metrics").text
        server_postgres.start()
        until(lambda: client.get("/v1/jobs").status_code == 200, "it does not come back")
        assert "Traceback" not in server.log.read_text()


def test_a_worker_of_its_own_makes_the_service_ready_and_ends_clean(tmp_path):
    with serving(tmp_path, "--anonymous", "--device", "none") as server, server.client() as client:
        assert "no worker" in client.get("/readyz").json()["detail"]
        with open(tmp_path / "worker.txt", "w") as errors:
            worker = subprocess.Popen([sys.executable, "-m", "service.cli.main", "worker", "--data", str(server.data), "--device", "cpu"],
                                      stderr=errors, env=environment_with())
        try:
            until(lambda: client.get("/readyz").status_code == 200, "never ready")
        finally:
            worker.terminate()
            assert worker.wait(PATIENCE_S) == 0
        until(lambda: client.get("/readyz").status_code == 503, "still ready")
        assert "interrupted" not in (tmp_path / "worker.txt").read_text()


@pytest.fixture
def busy(tmp_path) -> Iterator[tuple[Server, httpx2.Client, str]]:
    """A server whose worker is in a step that takes longer than it may take to drain."""
    with serving(tmp_path, "--anonymous", "--device", "cpu", sabotage="hang", roots=str(SAMPLES), drain_s=str(DRAIN_S)) as server, \
            server.client() as client:
        sky = admitted(server, client, SAMPLES / "owl" / "environment.exr", kind="environments")["id"]
        job = submit(client, kind="relight", capture=admitted(server, client, SAMPLES / "lambert")["id"], environment=sky)["id"]
        server.wait(client, f"/v1/jobs/{job}", ("running",))
        yield server, client, job


def test_the_service_drains_and_ends_clean(busy):
    """While the worker drains, the service answers on and is not ready; streams end as streams do; the job, whose step does not end, waits
    for the next worker."""
    server, client, job = busy
    with server.client() as other, other.stream("GET", f"/v1/jobs/{job}/events") as one, other.stream("GET", "/v1/events") as whole:
        found = told(one.iter_lines()), told(whole.iter_lines())
        assert all(any(event["data"]["id"] == job for event in stream) for stream in found)  # the second tells of the checks too
        server.process.send_signal(signal.SIGTERM)
        response = until(lambda: (answer := client.get("/readyz")).status_code == 503 and answer, "still ready")
        refused(response, 503, "the service is ending")
        assert client.get("/healthz").status_code == 200
        assert client.get(f"/v1/jobs/{job}").json()["state"] == "running"
        for stream in found:
            list(stream)  # it ends, and does not break off
    assert server.process.wait(PATIENCE_S) == 0
    text = server.log.read_text()
    assert "interrupted" not in text and "Traceback" not in text and "step is given up" in text
    assert server.lines()[-1]["event"] == "service ended"
    assert not list((server.data / "locks").glob("*.lock"))
    with server.database() as database:
        row = jobs.find(database, job)
        assert (row["state"], row["worker"], row["lost"]) == ("queued", None, 0) and workers.seen_lately(database) == []


def test_asked_twice_it_ends_at_once(busy):
    server, _, _ = busy
    children = children_of(server.process.pid)
    assert children
    server.process.send_signal(signal.SIGINT)
    server.process.send_signal(signal.SIGINT)  # together with the first, it is the same
    until(lambda: "service drains" in server.log.read_text(), "does not drain")
    while server.process.poll() is None:
        time.sleep(0.2)
        server.process.send_signal(signal.SIGINT)
    assert server.process.returncode in (128 + signal.SIGINT, -signal.SIGINT)  # the last one may meet an interpreter that ends
    assert "step is given up" not in server.log.read_text()  # which comes after DRAIN_S
    until(lambda: not any(alive(child) for child in children), "a worker lives on")


def alive(pid: int) -> bool:
    try:
        return re.search(r"^State:\s+Z", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE) is None
    except FileNotFoundError:
        return False


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
