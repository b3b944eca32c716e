"""Limits, on a server where they are small: what is too much is refused by name, and the next who asks is served."""

import asyncio
from collections.abc import Iterator

import httpx2
import pytest

from service.requests.keys import NewKey, Scope
from service.server.api import context, limits
from service.server.api.app import create_app
from service.server.api.limits import CREATION_COST, RateLimiter
from service.server.api.problems import ApiError
from service.server.base.settings import Settings
from service.server.database import intakes, jobs, keys
from service.server.database.engine import Database, connect
from tests.service.server.api.asgi import Call
from tests.service.server.api.conftest import SAMPLES
from tests.service.server_process import Server, serving

BURST, QUEUED, FRAMES, FILES, BYTES = 30, 2, 10, 2, 1000
PER_SECOND = 0.01
"""So slow that no test gains a token."""


@pytest.fixture(scope="module")
def small(tmp_path_factory) -> Iterator[tuple[Server, Database]]:
    with serving(tmp_path_factory.mktemp("limits"), "--device", "none", roots=str(SAMPLES), requests_per_second=str(PER_SECOND),
                 request_burst=str(BURST), max_queued=str(QUEUED), max_frames=str(FRAMES), max_capture_files=str(FILES),
                 max_upload_bytes=str(BYTES), min_free_bytes="0") as server:
        database = connect(Settings(data=server.data).sqlalchemy_url)
        yield server, database
        database.close()


@pytest.fixture
def client(small) -> Iterator[httpx2.Client]:
    """With a key, and so with limits, of its own."""
    server, database = small
    with server.client(key(database)) as made:
        yield made


def key(database: Database) -> str:
    return keys.create(database, NewKey(project="larch", name="test", scope=Scope.ADMIN))


@pytest.fixture
def capture(small, client) -> str:
    """Ready, though there is no worker that would say so."""
    made = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).raise_for_status().json()["id"]
    _, database = small
    intakes.accept(database, made, {"captures": 1})
    for job in jobs.latest(database, "larch", limit=100):  # of the check
        database.transact(lambda connection, job=job["id"]: jobs.cancel(connection, job))
    return made


def refused(response: httpx2.Response, status: int, words: str, *, later: bool = False) -> None:
    assert response.status_code == status, response.text
    assert words in response.json()["detail"]
    assert ("Retry-After" in response.headers) == later
    if later:
        assert int(response.headers["Retry-After"]) >= 1


@pytest.mark.long
def test_a_key_that_asks_too_often_waits_and_others_do_not(small, client):
    server, database = small
    for _ in range(BURST):
        assert client.get("/v1/jobs").status_code == 200
    response = client.get("/v1/jobs")
    refused(response, 429, f"more than {PER_SECOND:g} times a second", later=True)
    assert int(response.headers["Retry-After"]) <= 1 / PER_SECOND
    refused(client.post("/v1/captures", json={"name": "x"}), 429, "more than", later=True)
    assert client.get("/healthz").status_code == 200
    with server.client(key(database)) as other:
        assert other.get("/v1/jobs").status_code == 200


def test_a_key_that_asks_too_often_is_not_even_looked_up(small, client, monkeypatch):
    """Whoever asks ten thousand times a second gets no thread and no query of the database for it."""
    server, database = small
    settings = Settings(data=server.data, requests_per_second=PER_SECOND, request_burst=2)
    app, made = create_app(settings, database), key(database)
    looked: list[str] = []
    find = keys.find
    monkeypatch.setattr(keys, "find", lambda database, given: looked.append(given) or find(database, given))
    found = [asyncio.run(Call(app, "/v1/jobs", headers={"Authorization": f"Bearer {made}"}).run()).status for _ in range(5)]
    assert found == [200, 200, 429, 429, 429] and len(looked) == 2
    stranger = f"{made.partition('.')[0]}.guessed"  # learns that the key is busy, not whether the guess is right
    assert asyncio.run(Call(app, "/v1/jobs", headers={"Authorization": f"Bearer {stranger}"}).run()).status == 429


def test_a_key_has_so_many_requests_under_way_and_no_more(small):
    """An upload or a download that is drawn out holds a connection and a file."""
    server, database = small
    app = create_app(Settings(data=server.data, max_requests=2), database)
    ours, theirs = ({"Authorization": f"Bearer {key(database)}"} for _ in range(2))

    async def follow() -> None:
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

    asyncio.run(asyncio.wait_for(follow(), 60))


def test_tokens_come_back_with_time():
    now = 0.0
    limiter = RateLimiter(2.0, 3, clock=lambda: now)
    for _ in range(3):
        limiter.take("a")
    with pytest.raises(ApiError) as error:
        limiter.take("a")
    assert error.value.headers == {"Retry-After": "1"}
    limiter.take("b")
    now = 0.5  # one token at two a second
    limiter.take("a")
    with pytest.raises(ApiError):
        limiter.take("a")
    now = 1000.0  # no more than the bucket holds
    for _ in range(3):
        limiter.take("a")
    with pytest.raises(ApiError):
        limiter.take("a")


def test_a_cost_above_the_burst_takes_a_full_bucket():
    now = 0.0
    limiter = RateLimiter(2.0, 4, clock=lambda: now)
    limiter.take("a", 10)
    with pytest.raises(ApiError) as error:
        limiter.take("a", 2)
    assert error.value.headers == {"Retry-After": "1"}
    now = 1.0
    limiter.take("a", 2)


def test_a_new_capture_counts_as_several_requests(client):
    """Each leaves rows in the database also after it is deleted: a key could make any number of them."""
    found = [client.post("/v1/captures", json={"name": "x"}) for _ in range(BURST // CREATION_COST + 1)]
    assert [response.status_code for response in found[:-1]] == [201] * (BURST // CREATION_COST)
    refused(found[-1], 429, "more than", later=True)


def test_keys_that_ask_no_more_are_forgotten(monkeypatch):
    monkeypatch.setattr(limits, "FORGET_ABOVE", 10)
    now = 0.0
    limiter = RateLimiter(1.0, 1, clock=lambda: now)
    for number in range(10):
        limiter.take(str(number))
    now = 100.0
    for number in range(10, 12):
        limiter.take(str(number))
        with pytest.raises(ApiError):
            limiter.take(str(number))  # who asks now is not
    assert len(limiter) == 2


def test_a_key_has_no_more_jobs_in_the_queue_than_it_may(small, client, capture):
    server, database = small
    job = {"kind": "solve", "capture": capture}
    made = [client.post("/v1/jobs", json=job).raise_for_status().json()["id"] for _ in range(QUEUED)]
    refused(client.post("/v1/jobs", json=job), 429, f"{QUEUED} jobs of this key have not begun", later=True)
    assert len(client.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]) == QUEUED  # nothing of it is left
    with server.client(key(database)) as other:
        assert other.post("/v1/jobs", json=job).status_code == 202
    client.post(f"/v1/jobs/{made[0]}/cancel").raise_for_status()
    assert client.post("/v1/jobs", json=job).status_code == 202
    refused(client.post(f"/v1/jobs/{made[0]}/resume"), 429, "have not begun", later=True)
    assert client.get(f"/v1/jobs/{made[0]}").json()["state"] == "cancelled"


def test_a_body_that_is_larger_than_json_has_to_be(client):
    large = b'{"name": "' + b"x" * (1 << 20) + b'"}'
    json = {"Content-Type": "application/json"}
    refused(client.post("/v1/captures", content=large, headers=json), 413, "larger than 1048576 bytes")
    pieces = (large[at : at + 65536] for at in range(0, len(large), 65536))
    refused(client.post("/v1/captures", content=pieces, headers=json), 413, "larger than 1048576 bytes")


@pytest.mark.parametrize("body", [
    b"[" * 500_000, b'{"name": ' * 100_000, b'{"priority": ' + b"9" * 100_000 + b"}", b'{"name": "\xff"}', b"\x00",
], ids=["deep list", "deep object", "long number", "no UTF-8", "NUL"])
def test_a_body_that_is_made_to_hurt(client, body):
    response = client.post("/v1/captures", content=body, headers={"Content-Type": "application/json"})
    assert response.status_code in (400, 422), response.text


def test_more_frames_than_a_job_may_have(small, client, capture):
    sky = client.post("/v1/environments", json={"name": "sky", "file": str(SAMPLES / "owl" / "environment.exr")}).json()["id"]
    _, database = small
    intakes.accept(database, sky, {})
    job = {"kind": "relight", "capture": capture, "environment": sky}
    refused(client.post("/v1/jobs", json=job | {"options": {"frames": f"1-{FRAMES + 1}"}}), 422, f"{FRAMES} are allowed")
    refused(client.post("/v1/jobs", json=job | {"options": {"frames": "1-999999999999"}}), 422, "frames")
    assert client.post("/v1/jobs", json=job | {"options": {"frames": f"1-{FRAMES}"}}).status_code == 202


def test_files_that_are_too_large_or_too_many(client):
    capture = client.post("/v1/captures", json={"name": "x"}).json()["id"]

    def begin(name: str, length: int) -> httpx2.Response:
        return client.post(f"/v1/captures/{capture}/files", headers={
            "Tus-Resumable": "1.0.0", "Upload-Length": str(length), "Upload-Metadata": f"path {name}"})

    refused(begin("YQ==", BYTES + 1), 413, f"a file may have {BYTES} bytes")
    assert begin("YQ==", BYTES).status_code == begin("Yg==", 1).status_code == 201
    refused(begin("Yw==", 1), 413, f"more than {FILES} are not taken")


@pytest.mark.long
def test_without_space_nothing_new_is_taken_and_the_service_says_so(tmp_path):
    """What is there can be read on."""
    with serving(tmp_path, "--anonymous", "--device", "none", roots=str(SAMPLES), min_free_bytes=str(10**18)) as server, \
            server.client() as client:
        for path, body in (("/v1/captures", {"name": "x"}), ("/v1/captures", {"name": "x", "folder": str(SAMPLES / "owl")}),
                           ("/v1/environments", {"name": "x"})):
            refused(client.post(path, json=body), 507, "no space left", later=True)
        ready = client.get("/readyz")
        assert ready.status_code == 503 and "less space left than min_free_bytes" in ready.json()["detail"]
        for path in ("/v1/captures", "/v1/jobs", "/healthz", "/metrics"):
            assert client.get(path).status_code == 200


def test_a_file_system_without_room_for_files_takes_nothing_new(small, monkeypatch):
    server, database = small
    monkeypatch.setattr(context, "MIN_FREE_FILES", 1 << 62)
    app = create_app(Settings(data=server.data, min_free_bytes=0), database)
    headers = {"Authorization": f"Bearer {key(database)}", "Content-Type": "application/json", "Content-Length": "13"}
    call = Call(app, "/v1/captures", method="POST", headers=headers, sent=b'{"name": "x"}')
    assert asyncio.run(call.run()).status == 507
