"""Idempotency keys: the same request sent again creates nothing again, however it comes."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import httpx2
import pytest

from service.requests.base.identifiers import new_id
from service.requests.keys import NewKey, Scope
from service.server.base.settings import Settings
from service.server.database import idempotency, intakes, keys
from service.server.database.engine import Database, connect
from service.server.database.schema import upgrade
from tests.service.server.api.conftest import SAMPLES
from tests.service.server_process import Server, serving

PROJECT = "larch"
AT_ONCE = 12


@pytest.fixture(scope="module")
def quiet(tmp_path_factory) -> Iterator[tuple[Server, Database]]:
    """A server without workers, so that jobs stay as they were handed in."""
    with serving(tmp_path_factory.mktemp("quiet"), "--device", "none", roots=str(SAMPLES), min_free_bytes="0") as server:
        database = connect(Settings(data=server.data).sqlalchemy_url)
        yield server, database
        database.close()


@pytest.fixture(scope="module")
def client(quiet) -> Iterator[httpx2.Client]:
    server, database = quiet
    with server.client(keys.create(database, NewKey(project=PROJECT, name="test", scope=Scope.ADMIN))) as made:
        yield made


@pytest.fixture
def capture(quiet, client) -> str:
    """Ready, though there is no worker that would say so."""
    made = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).raise_for_status().json()["id"]
    intakes.accept(quiet[1], made, {"captures": 1})
    return made


def count(client: httpx2.Client) -> int:
    return len(client.get("/v1/jobs", params={"limit": 500, "state": "queued"}).json()["jobs"])


@pytest.mark.long
def test_the_same_request_again_is_the_same_job(client, capture):
    token = {"Idempotency-Key": new_id("test")}
    before = count(client)
    first = client.post("/v1/jobs", json={"kind": "solve", "capture": capture}, headers=token)
    again = client.post("/v1/jobs", headers=token, json={"priority": 50, "options": {"align": False}, "capture": capture, "kind": "solve"})
    assert first.status_code == again.status_code == 202  # what is not said and what is said as it would be anyway are the same
    assert first.json() == again.json() and first.headers["Location"] == again.headers["Location"]
    assert count(client) == before + 1
    other = client.post("/v1/jobs", json={"kind": "solve", "capture": capture}, headers={"Idempotency-Key": new_id("test")})
    without = client.post("/v1/jobs", json={"kind": "solve", "capture": capture})
    assert len({response.json()["id"] for response in (first, other, without)}) == 3


def test_another_request_with_the_same_token_is_refused(client, capture):
    token = {"Idempotency-Key": new_id("test")}
    assert client.post("/v1/jobs", json={"kind": "solve", "capture": capture}, headers=token).status_code == 202
    for other in ({"kind": "solve", "capture": capture, "priority": 51}, {"kind": "depth", "capture": capture}):
        response = client.post("/v1/jobs", json=other, headers=token)
        assert response.status_code == 422 and "came with another request before" in response.json()["detail"]
    assert client.post("/v1/captures", json={"name": "owl"}, headers=token).status_code == 422


def test_the_same_request_many_times_at_once_creates_one_job(quiet, client, capture):
    token, before = {"Idempotency-Key": new_id("test")}, count(client)
    together = threading.Barrier(AT_ONCE)

    def ask(_: int) -> httpx2.Response:
        together.wait()
        return client.post("/v1/jobs", json={"kind": "solve", "capture": capture}, headers=token)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(ask, range(AT_ONCE)))
    assert {answer.status_code for answer in answers} == {202}, [answer.text for answer in answers if answer.status_code != 202]
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert count(client) == before + 1


def test_two_requests_with_one_token_at_once_create_one_of_them(client, capture):
    token, before = {"Idempotency-Key": new_id("test")}, count(client)
    together = threading.Barrier(AT_ONCE)

    def ask(number: int) -> httpx2.Response:
        together.wait()
        return client.post("/v1/jobs", json={"kind": "solve", "capture": capture, "priority": number % 2}, headers=token)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(ask, range(AT_ONCE)))
    assert sorted({answer.status_code for answer in answers}) == [202, 422]
    assert len({answer.json()["id"] for answer in answers if answer.status_code == 202}) == 1
    assert count(client) == before + 1


def test_what_was_created_is_answered_though_it_could_not_be_created_now(quiet, client):
    token = {"Idempotency-Key": new_id("test")}
    capture = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).json()["id"]
    request = {"kind": "solve", "capture": capture}
    assert client.post("/v1/jobs", json=request, headers=token).status_code == 409  # it is not checked yet: nothing is created
    intakes.accept(quiet[1], capture, {"captures": 1})
    made = client.post("/v1/jobs", json=request, headers=token)
    assert made.status_code == 202
    for job in client.get("/v1/jobs").json()["jobs"]:  # the check among them
        client.post(f"/v1/jobs/{job['id']}/cancel")
    assert client.delete(f"/v1/captures/{capture}").status_code == 204
    again = client.post("/v1/jobs", json=request, headers=token)
    assert (again.status_code, again.json()["id"], again.json()["state"]) == (202, made.json()["id"], "cancelled")
    assert client.post("/v1/jobs", json=request).status_code == 404
    assert client.delete(f"/v1/jobs/{made.json()['id']}").status_code == 204
    assert client.post("/v1/jobs", json=request, headers=token).status_code == 404  # neither is it created anew


def test_captures_and_environments_take_tokens_too(client):
    for path in ("/v1/captures", "/v1/environments"):
        token = {"Idempotency-Key": new_id("test")}
        made = [client.post(path, json={"name": "x"}, headers=token).json()["id"] for _ in range(2)]
        assert made[0] == made[1]
        assert client.post(path, json={"name": "y"}, headers=token).status_code == 422


def test_a_token_is_one_projects_own(quiet, client):
    server, database = quiet
    token = {"Idempotency-Key": new_id("test")}
    mine = client.post("/v1/captures", json={"name": "x"}, headers=token).json()["id"]
    with server.client(keys.create(database, NewKey(project="birch", name="test", scope=Scope.WRITE))) as other:
        response = other.post("/v1/captures", json={"name": "another"}, headers=token)
        assert response.status_code == 201 and response.json()["id"] != mine


@pytest.mark.parametrize("token", ["", "a b", "x" * 256, "é"], ids=["empty", "space", "long", "not ascii"])
def test_a_token_that_cannot_be_is_refused(client, token):
    response = client.post("/v1/captures", json={"name": "x"}, headers=[(b"Idempotency-Key", token.encode())])
    assert (response.status_code, response.json()["errors"][0]["field"]) == (422, "header.Idempotency-Key")


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request, tmp_path) -> Iterator[Database]:
    if request.param == "sqlite":
        made = connect(f"sqlite:///{tmp_path / 'test.sqlite'}", connections=AT_ONCE)
        upgrade(made)
        yield made
        made.close()
        return
    url = request.getfixturevalue("server_postgres").new_database()
    made = connect(Settings(data=tmp_path, database_url=url).sqlalchemy_url, connections=AT_ONCE)
    upgrade(made)
    yield made
    made.close()


@pytest.mark.long
def test_at_once_on_either_database(database):
    together = threading.Barrier(AT_ONCE)

    def make(connection) -> str:
        identifier = new_id("cap")
        intakes.insert(connection, identifier=identifier, project=PROJECT, kind="cap", name="x", folder=None)
        return identifier

    def ask(_: int) -> tuple[str, bool]:
        together.wait()
        return idempotency.create_once(database, PROJECT, "token", ["x"], make)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        made = list(pool.map(ask, range(AT_ONCE)))
    assert len({identifier for identifier, _ in made}) == 1 and sum(new for _, new in made) == 1
    assert [row["id"] for row in intakes.latest(database, PROJECT, "cap", limit=10)] == [made[0][0]]
    assert idempotency.created_by(database, PROJECT, "token", ["x"]) == made[0][0]
    assert idempotency.created_by(database, PROJECT, "other", ["x"]) is None
    with pytest.raises(idempotency.TokenReused):
        idempotency.created_by(database, PROJECT, "token", ["y"])
