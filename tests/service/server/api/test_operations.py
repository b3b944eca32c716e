"""Operating the service: health, numbers and the log."""

import json
import shutil
import socket

import httpx2
import pytest
from fastapi.testclient import TestClient
from prometheus_client.parser import text_string_to_metric_families

from service.server.base import log
from service.server.base.settings import Settings
from tests.service.server.api.asgi import app_of
from tests.service.waiting import until


def numbers_of(client: httpx2.Client | TestClient) -> dict[str, list]:
    return {family.name: family.samples for family in text_string_to_metric_families(client.get("/metrics").raise_for_status().text)}


def number(numbers: dict[str, list], family: str, sample: str | None = None, **labels: str) -> float:
    return sum(found.value for found in numbers.get(family, [])
               if found.name == (sample or family) and labels.items() <= found.labels.items())


@pytest.fixture
def app(tmp_path):
    with app_of(Settings(data=tmp_path / "data", anonymous=True, min_free_bytes=0)) as made:
        yield made


@pytest.fixture
def inside(app) -> TestClient:
    return TestClient(app, base_url="http://localhost")


def test_a_service_with_a_worker_is_ready(server, client):
    assert client.get("/healthz").json() == {"status": "ok"}
    until(lambda: client.get("/readyz").status_code == 200, "never ready")
    assert client.get("/readyz").json() == {"status": "ok"}


def test_a_service_that_cannot_work_says_why_and_names_nothing(app, inside, tmp_path):
    assert "no worker was seen in the last 30 seconds" in inside.get("/readyz").json()["detail"]
    app.state.service.database.close()
    shutil.rmtree(tmp_path / "data")
    (tmp_path / "data").write_text("no folder")
    said = until(lambda: (found := inside.get("/readyz").json()["detail"]) != "" and "database" in found and found, "it is still content")
    assert said == "the database does not answer; the storage cannot be written"
    assert inside.get("/readyz").status_code == 503 and inside.get("/healthz").status_code == 200
    assert 'relit_database_up 0.0' in inside.get("/metrics").text


def test_what_was_found_is_told_again_for_a_moment(app, monkeypatch):
    """Who asks a thousand times a second costs one look."""
    looks = []
    monkeypatch.setattr("service.server.api.operations._faults", lambda service: looks.append(1) or [])
    for _ in range(100):
        app.state.readiness.wrong(app.state.service)
    assert len(looks) < 100


def test_requests_are_counted_by_route_and_not_by_path(server, client):
    before = numbers_of(client)
    for name in ("job_00000000000000000000", "job_11111111111111111111", "nothing"):
        client.get(f"/v1/jobs/{name}")
    for path in ("/v1/no/such/thing", "/wp-login.php", "/v1/jobs/a/b/c/d"):
        client.get(path)
    client.request("BREW", "/v1/jobs")
    made = client.post("/v1/captures", content=b'{"name": "abc"}', headers={"Content-Type": "application/json"})
    assert made.status_code == 201
    after = numbers_of(client)

    def more(family: str, sample: str, **labels: str) -> float:
        return number(after, family, sample, **labels) - number(before, family, sample, **labels)

    requests = ("relit_http_requests", "relit_http_requests_total")
    assert more(*requests, method="GET", route="/v1/jobs/{job}", status="404") == 2
    assert more(*requests, method="GET", route="/v1/jobs/{job}") == 3
    assert more(*requests, route="other", status="404") >= 3
    assert more(*requests, method="other") == 1
    assert more(*requests, route="/v1/captures", method="POST", status="201") == 1
    assert more("relit_http_wait_seconds", "relit_http_wait_seconds_count", route="/v1/captures", method="POST") == 1
    assert more("relit_http_received_bytes", "relit_http_received_bytes_total", route="/v1/captures") == len(b'{"name": "abc"}')
    assert "job_0000" not in client.get("/metrics").text and "wp-login" not in client.get("/metrics").text


@pytest.mark.long
def test_numbers_of_jobs_workers_and_the_process_and_the_log_of_a_job(server, client, owl, sky):
    done = client.post("/v1/jobs", json={"kind": "relight", "capture": owl, "environment": sky, "options": {"frames": "1-2"}}).json()
    server.wait(client, f"/v1/jobs/{done['id']}", ("succeeded",))
    numbers = numbers_of(client)
    assert number(numbers, "relit_jobs", state="succeeded") >= 3  # two checks, and this
    assert {sample.labels["state"] for sample in numbers["relit_jobs"]} == {"queued", "running", "succeeded", "failed", "cancelled"}
    assert number(numbers, "relit_workers", device="cpu", state="ready") == 1
    assert number(numbers, "relit_job_frames") >= 2
    assert number(numbers, "relit_database_up") == 1
    assert number(numbers, "relit_storage_free_bytes") > 0 and number(numbers, "process_resident_memory_bytes") > 0
    assert number(numbers, "relit_queue_age_seconds") >= 0
    job = client.post("/v1/jobs", json={"kind": "solve", "capture": owl, "options": {"method": "lambert"}}).json()["id"]
    server.wait(client, f"/v1/jobs/{job}", ("succeeded",))
    events = until(lambda: [line["event"] for line in server.lines() if line.get("job") == job][2:] and [
        line["event"] for line in server.lines() if line.get("job") == job], "not logged")
    assert events[:2] == ["step begins", "step done"]


def test_the_queue_ages(inside):
    assert "relit_queue_age_seconds 0.0" in inside.get("/metrics").text
    inside.post("/v1/samples/captures").raise_for_status()  # its check waits
    numbers = numbers_of(inside)
    assert number(numbers, "relit_queue_age_seconds") > 0 and number(numbers, "relit_jobs", state="queued") == 1


def test_every_request_is_one_line_of_the_log(server, client):
    name = client.get("/v1/jobs", params={"limit": 7}).headers["X-Request-ID"]
    found = until(lambda: [line for line in server.lines() if line.get("request") == name], "not logged")
    assert len(found) == 1
    assert found[0] | {"ms": 0, "timestamp": ""} == {
        "event": "request", "level": "info", "timestamp": "", "request": name, "method": "GET", "path": "/v1/jobs", "status": 200, "ms": 0,
        "client": "127.0.0.1", "project": "default", "key": None}
    refused = client.get("/v1/jobs/job_00000000000000000000")
    assert refused.json()["request_id"] == refused.headers["X-Request-ID"]
    until(lambda: any(line.get("request") == refused.headers["X-Request-ID"] for line in server.lines()), "not logged")
    for path in ("/healthz", "/readyz", "/metrics", "/set/state"):  # of level debug, which is not asked for
        name = client.get(path).headers["X-Request-ID"]
        later = client.get("/v1/jobs").headers["X-Request-ID"]
        until(lambda later=later: any(line.get("request") == later for line in server.lines()), "not logged")
        assert not any(line.get("request") == name for line in server.lines())


def test_what_libraries_say_is_in_the_same_log(server):
    """Here uvicorn, of bytes that are no HTTP."""
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        connection.sendall(b"\x16\x03\x01\x00\xff no http\r\n\r\n")
        connection.recv(100)
    until(lambda: [line for line in server.lines() if line.get("logger") == "uvicorn.error"], "nothing of uvicorn")


def test_a_fault_of_our_own_is_a_problem_too_and_logged_once(app, capfd):
    log.configure("info", "json")

    @app.get("/v1/broken")
    def broken() -> None:
        raise RuntimeError("a secret of the machine")

    with TestClient(app, base_url="http://localhost") as client:
        response = client.get("/v1/broken")
    assert (response.status_code, response.headers["Content-Type"]) == (500, "application/problem+json")
    assert response.json()["request_id"] == response.headers["X-Request-ID"] and "secret" not in response.text
    lines = [json.loads(line) for line in capfd.readouterr().err.splitlines()]
    faults = [line for line in lines if line["event"] == "request failed"]
    assert len(faults) == 1 and "RuntimeError: a secret of the machine" in faults[0]["exception"]
    assert faults[0]["request"] == response.headers["X-Request-ID"]
    assert 'route="/v1/broken",status="500"} 1.0' in TestClient(app, base_url="http://localhost").get("/metrics").text
