"""Events: jobs as they change, for any number of listeners at the price of one, through restarts of the database."""

import json
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from service.server.database import jobs
from tests.service.server.api.job_calls import NOBODY, refused, submit
from tests.service.server.api.test_watch import queue
from tests.service.server_process import serving

pytestmark = pytest.mark.long
WAIT_S = 60.0


def told(lines: Iterator[str]) -> Iterator[dict]:
    """The events of a stream, without its comments: fields by name, data as JSON."""
    event: dict = {}
    for line in lines:
        if line and not line.startswith(":"):
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
        return list(told(response.iter_lines()))


def test_a_job_is_followed_to_its_end(server, client, dome, sky):
    job = client.post("/v1/jobs", json={"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-60"}}).json()
    found = watched(client, job["id"])
    assert {event["event"] for event in found} == {"job"}
    views = [event["data"] for event in found]
    assert [int(event["id"]) for event in found] == [view["revision"] for view in views]
    assert [view["revision"] for view in views] == sorted({view["revision"] for view in views})
    assert {view["id"] for view in views} == {job["id"]} and views[0]["request"] == job["request"] | {
        "options": job["request"]["options"] | {"frames": "1-60"}}
    states = [view["state"] for view in views]
    assert states[-1] == "succeeded" and set(states) <= {"queued", "running", "succeeded"} and len(views) > 2
    done = [view["progress"]["done"] for view in views if view["progress"] and view["progress"]["stage"] == "frames"]
    assert done == sorted(done) and done[-1] == 60
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
    request = {"kind": "relight", "capture": dome, "environment": sky, "options": {"frames": "1-300"}}
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
        left = {submit(client, kind="solve", capture=dome, options={"method": "lambert"})["id"] for _ in range(2)}
        deadline = time.monotonic() + WAIT_S
        while left:
            event = next(found)
            if event.get("event") == "job" and event["data"]["state"] == "succeeded":
                left.discard(event["data"]["id"])
            assert time.monotonic() < deadline


def test_a_stream_that_cannot_be_is_refused(client, solved):
    refused(client.get(f"/v1/jobs/{NOBODY}/events"), 404, NOBODY)
    response = client.get(f"/v1/jobs/{solved}/events", headers={"Last-Event-ID": "now"})
    assert (response.status_code, response.json()["errors"][0]["field"]) == (422, "header.Last-Event-ID")


def test_streams_stay_open_while_postgresql_restarts(tmp_path: Path, server_postgres):
    with (serving(tmp_path, "--anonymous", "--device", "none", database_url=server_postgres.new_database()) as server,
          server.client() as client, server.database() as database):
        job = queue(database, "default")
        with client.stream("GET", f"/v1/jobs/{job}/events") as response:
            found = told(response.iter_lines())
            assert next(found)["data"]["state"] == "queued"
            server_postgres.restart("immediate", away_s=1.0)
            database.transact(lambda connection: jobs.cancel(connection, job), patience_s=WAIT_S)
            assert [event["data"]["state"] for event in found] == ["cancelled"]
