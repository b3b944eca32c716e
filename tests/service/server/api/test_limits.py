"""Limits, in a service where they are small: what is too much is refused by name, and the next who asks is served."""

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import httpx2
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from service.requests.base.identifiers import CAPTURE
from service.server.api import context, limits
from service.server.api.app import create_app
from service.server.api.limits import CREATION_COST, RateLimiter
from service.server.api.problems import ApiError
from service.server.base.settings import Settings
from service.server.database import intakes, keys
from service.server.database.engine import Database
from tests.service.server.api.asgi import Call, app_of, asynchronous
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted, refused
from tests.service.server_process import new_key

BURST, QUEUED, FRAMES, FILES, BYTES = 30, 2, 10, 2, 1000
PER_SECOND = 0.01
"""So slow that no test gains a token."""


class Site(NamedTuple):
    """A service in this process."""

    app: FastAPI
    data: Path
    database: Database

    def key(self) -> str:
        return new_key(self.database)

    def client(self) -> TestClient:
        """With a key, and so with limits, of its own."""
        return TestClient(self.app, headers={"Authorization": f"Bearer {self.key()}"})


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Iterator[Site]:
    settings = Settings(data=tmp_path_factory.mktemp("limits"), roots=str(SAMPLES), requests_per_second=PER_SECOND, request_burst=BURST,
                        max_queued=QUEUED, max_frames=FRAMES, max_capture_files=FILES, max_upload_bytes=BYTES, min_free_bytes=0)
    with app_of(settings) as app:
        yield Site(app, settings.data, app.state.service.database)


@pytest.fixture
def client(small) -> TestClient:
    return small.client()


@pytest.fixture
def capture(small, client) -> str:
    return accepted(small.database, client, "larch", SAMPLES / "owl")


@pytest.mark.long
def test_a_key_that_asks_too_often_waits_and_others_do_not(small, client):
    for _ in range(BURST):
        assert client.get("/v1/jobs").status_code == 200
    response = client.get("/v1/jobs")
    refused(response, 429, f"more than {PER_SECOND:g} times a second")
    assert int(response.headers["Retry-After"]) <= 1 / PER_SECOND
    refused(client.post("/v1/captures", json={"name": "x"}), 429, "more than")
    assert client.get("/healthz").status_code == 200
    assert small.client().get("/v1/jobs").status_code == 200


def test_a_key_that_asks_too_often_is_not_even_looked_up(small, monkeypatch):
    """Whoever asks ten thousand times a second gets no thread and no query of the database for it."""
    app, made = create_app(Settings(data=small.data, requests_per_second=PER_SECOND, request_burst=2), small.database), small.key()
    looked: list[str] = []
    find = keys.find
    monkeypatch.setattr(keys, "find", lambda database, given: looked.append(given) or find(database, given))

    def status(given: str) -> int:
        return asyncio.run(Call(app, "/v1/jobs", headers={"Authorization": f"Bearer {given}"}).run()).status

    assert [status(made) for _ in range(5)] == [200, 200, 429, 429, 429] and len(looked) == 2
    assert status(f"{made.partition('.')[0]}.guessed") == 429  # learns that the key is busy, not whether the guess is right


@asynchronous
async def test_a_key_has_so_many_requests_under_way_and_no_more(small):
    """An upload or a download that is drawn out holds a connection and a file."""
    app = create_app(Settings(data=small.data, max_requests=2), small.database)
    ours, theirs = ({"Authorization": f"Bearer {small.key()}"} for _ in range(2))
    drawn = [Call(app, "/v1/events", headers=ours) for _ in range(2)]
    running = [asyncio.create_task(call.run()) for call in drawn]
    while not all(call.status for call in drawn):
        await asyncio.sleep(0.01)
    assert [call.status for call in drawn] == [200, 200]
    assert (await Call(app, "/v1/jobs", headers=ours).run()).status == 429
    assert (await Call(app, "/v1/jobs", headers=theirs).run()).status == 200
    drawn[0].leave()
    await running[0]
    for _ in range(3):
        assert (await Call(app, "/v1/jobs", headers=ours).run()).status == 200
    drawn[1].leave()
    await running[1]


def answers(limiter: RateLimiter, key: str = "a", *costs: int) -> list[str | None]:
    """What requests of these costs are told: None, or after how many seconds to come again."""
    found: list[str | None] = []
    for cost in costs:
        try:
            limiter.take(key, cost)
            found.append(None)
        except ApiError as error:
            found.append(error.headers["Retry-After"])
    return found


def test_tokens_come_back_with_time_and_a_cost_above_the_burst_takes_a_full_bucket():
    now = 0.0
    limiter = RateLimiter(2.0, 3, clock=lambda: now)
    assert answers(limiter, "a", 1, 1, 1, 1) == [None, None, None, "1"] and answers(limiter, "b", 1) == [None]
    now = 0.5  # one token at two a second
    assert answers(limiter, "a", 1, 1) == [None, "1"]
    now = 1000.0  # no more than the bucket holds
    assert answers(limiter, "a", 1, 1, 1, 1) == [None, None, None, "1"]
    limiter = RateLimiter(2.0, 4, clock=lambda: now)
    assert answers(limiter, "a", 10, 2) == [None, "1"]
    now = 1001.0
    assert answers(limiter, "a", 2) == [None]


def test_a_new_capture_counts_as_several_requests(client):
    """Each leaves rows in the database also after it is deleted: a key could make any number of them."""
    found = [client.post("/v1/captures", json={"name": "x"}) for _ in range(BURST // CREATION_COST + 1)]
    assert [response.status_code for response in found[:-1]] == [201] * (BURST // CREATION_COST)
    refused(found[-1], 429, "more than")


def test_keys_that_ask_no_more_are_forgotten(monkeypatch):
    monkeypatch.setattr(limits, "FORGET_ABOVE", 10)
    now = 0.0
    limiter = RateLimiter(1.0, 1, clock=lambda: now)
    for number in range(10):
        limiter.take(str(number))
    now = 100.0
    for key in ("one", "other"):  # who asks now is not
        assert answers(limiter, key, 1, 1) == [None, "1"]
    assert len(limiter) == 2


def test_a_key_has_no_more_jobs_in_the_queue_than_it_may(small, client, capture):
    job = {"kind": "solve", "capture": capture}
    made = [client.post("/v1/jobs", json=job).raise_for_status().json()["id"] for _ in range(QUEUED)]
    refused(client.post("/v1/jobs", json=job), 429, f"{QUEUED} jobs of this key have not begun")
    assert len(client.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]) == QUEUED  # nothing of it is left
    assert small.client().post("/v1/jobs", json=job).status_code == 202
    client.post(f"/v1/jobs/{made[0]}/cancel").raise_for_status()
    assert client.post("/v1/jobs", json=job).status_code == 202
    refused(client.post(f"/v1/jobs/{made[0]}/resume"), 429, "have not begun")
    assert client.get(f"/v1/jobs/{made[0]}").json()["state"] == "cancelled"


def test_more_frames_than_a_job_may_have(small, client, capture):
    sky = client.post("/v1/environments", json={"name": "sky", "file": str(SAMPLES / "owl" / "environment.exr")}).json()["id"]
    intakes.accept(small.database, sky, {})
    job = {"kind": "relight", "capture": capture, "environment": sky}
    refused(client.post("/v1/jobs", json=job | {"options": {"frames": f"1-{FRAMES + 1}"}}), 422, f"{FRAMES} are allowed")
    refused(client.post("/v1/jobs", json=job | {"options": {"frames": "1-999999999999"}}), 422, "frames")
    assert client.post("/v1/jobs", json=job | {"options": {"frames": f"1-{FRAMES}"}}).status_code == 202


def begin(client: httpx2.Client, capture: str, name: str, length: int) -> httpx2.Response:
    return client.post(f"/v1/captures/{capture}/files", headers={
        "Tus-Resumable": "1.0.0", "Upload-Length": str(length), "Upload-Metadata": f"path {name}"})


def test_files_that_are_too_large_or_too_many(client):
    capture = client.post("/v1/captures", json={"name": "x"}).json()["id"]
    refused(begin(client, capture, "YQ==", BYTES + 1), 413, f"a file may have {BYTES} bytes")
    assert begin(client, capture, "YQ==", BYTES).status_code == begin(client, capture, "Yg==", 1).status_code == 201
    refused(begin(client, capture, "Yw==", 1), 413, f"more than {FILES} are not taken")


def test_without_space_nothing_new_is_taken_and_the_service_says_so(tmp_path):
    """What is there can be read on."""
    with app_of(Settings(data=tmp_path, anonymous=True, roots=str(SAMPLES), min_free_bytes=1 << 60)) as app, \
            TestClient(app, base_url="http://localhost") as client:
        there = app.state.service.database.transact(lambda connection: intakes.insert(
            connection, project="default", kind=CAPTURE, name="test"))
        for path, body in (("/v1/captures", {"name": "x"}), ("/v1/captures", {"name": "x", "folder": str(SAMPLES / "owl")}),
                           ("/v1/environments", {"name": "x"})):
            refused(client.post(path, json=body), 507, "no space left")
        refused(begin(client, there, "YQ==", 1), 507, "no space left")
        assert client.get(f"/v1/captures/{there}/files").json()["files"] == []
        refused(client.get("/readyz"), 503, "less space left than min_free_bytes")
        for path in ("/v1/captures", "/v1/jobs", "/healthz", "/metrics"):
            assert client.get(path).status_code == 200


def test_a_file_system_without_room_for_files_takes_nothing_new(small, monkeypatch):
    monkeypatch.setattr(context, "MIN_FREE_FILES", 1 << 62)
    app = create_app(Settings(data=small.data, min_free_bytes=0), small.database)
    headers = {"Authorization": f"Bearer {small.key()}", "Content-Type": "application/json", "Content-Length": "13"}
    call = Call(app, "/v1/captures", method="POST", headers=headers, sent=b'{"name": "x"}')
    assert asyncio.run(call.run()).status == 507


TUS = {"Tus-Resumable": "1.0.0", "Upload-Metadata": "path YQ=="}


def test_captures(keyed):
    with keyed.client(keyed.key("quota-larch")) as larch, keyed.client(keyed.key("quota-willow")) as willow:
        made = [larch.post("/v1/captures", json={"name": "a"}).raise_for_status().json()["id"] for _ in range(2)]
        refused(larch.post("/v1/environments", json={"name": "a"}), 429, "quota max_project_captures: the project quota-larch has 2 ")
        assert larch.delete(f"/v1/captures/{made[0]}").status_code == 204
        assert larch.post("/v1/environments", json={"name": "a"}).status_code == 201
        assert [willow.post("/v1/captures", json={"name": "a"}).status_code for _ in range(4)] == [201, 201, 201, 429]


def test_bytes(keyed):
    with keyed.client(keyed.key("oak")) as oak:
        place = f"/v1/captures/{oak.post('/v1/captures', json={'name': 'a'}).json()['id']}/files"
        assert oak.post(place, headers=TUS | {"Upload-Length": "60"}).status_code == 201
        refused(oak.post(place, headers=TUS | {"Upload-Length": "41", "Upload-Metadata": "path Yg=="}), 413,
                "quota max_project_bytes: the project oak has 60 of 100 ")
        assert oak.post(place, headers=TUS | {"Upload-Length": "40", "Upload-Metadata": "path Yg=="}).status_code == 201


def test_a_file_whose_replacement_is_refused_stays(keyed):
    with keyed.client(keyed.key("beech")) as beech:
        capture = beech.post("/v1/captures", json={"name": "a"}).json()["id"]
        made = beech.post(f"/v1/captures/{capture}/files", headers=TUS | {"Upload-Length": "3"})
        beech.patch(made.headers["location"], content=b"old", headers={
            "Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}).raise_for_status()
        refused(beech.post(f"/v1/captures/{capture}/files", headers=TUS | {"Upload-Length": "101"}), 413, "quota max_project_bytes: ")
        assert (keyed.data / "projects" / "beech" / "captures" / capture / "a").read_bytes() == b"old"
        assert beech.get(f"/v1/captures/{capture}/files").json()["files"][0]["done"]


def test_jobs(keyed, keyed_database):
    with keyed.client(keyed.key("elm")) as elm:
        request = {"kind": "solve", "capture": accepted(keyed_database, elm, "elm", SAMPLES / "owl")}
        first = elm.post("/v1/jobs", json=request)
        assert first.status_code == 202
        refused(elm.post("/v1/jobs", json=request), 429, "quota max_project_jobs: ")
        assert len(elm.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]) == 1  # nothing is left behind
        elm.post(f"/v1/jobs/{first.json()['id']}/cancel").raise_for_status()
        assert elm.post("/v1/jobs", json=request).status_code == 202
        assert elm.post(f"/v1/jobs/{first.json()['id']}/resume").status_code == 429
