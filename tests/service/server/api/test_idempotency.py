"""Idempotency keys: the same request sent again creates nothing again, however it comes."""

from collections.abc import Iterator

import httpx2
import pytest

from service.requests.base.identifiers import new_id
from service.requests.keys import Scope
from service.server.database import idempotency, intakes
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import accepted, refused
from tests.service.waiting import at_once

PROJECT = "alder"
AT_ONCE = 12


@pytest.fixture(scope="module")
def client(keyed) -> Iterator[httpx2.Client]:
    with keyed.client(keyed.key(PROJECT)) as made:
        yield made


@pytest.fixture
def capture(keyed_database, client) -> str:
    return accepted(keyed_database, client, PROJECT, SAMPLES / "owl")


def count(client: httpx2.Client) -> int:
    return len(client.get("/v1/jobs", params={"limit": 500, "state": "queued"}).json()["jobs"])


def test_the_same_request_again_is_the_same_job_and_another_is_refused(client, capture):
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
    for other in ({"kind": "solve", "capture": capture, "priority": 51}, {"kind": "depth", "capture": capture}):
        refused(client.post("/v1/jobs", json=other, headers=token), 422, "came with another request before")
    assert client.post("/v1/captures", json={"name": "owl"}, headers=token).status_code == 422


@pytest.mark.parametrize(("priorities", "statuses"), [(1, {202}), (2, {202, 422})], ids=["the same", "two requests"])
def test_many_requests_with_one_token_at_once_create_one_job(client, capture, priorities, statuses):
    token, before = {"Idempotency-Key": new_id("test")}, count(client)
    answers = at_once(AT_ONCE, lambda number: client.post(
        "/v1/jobs", json={"kind": "solve", "capture": capture, "priority": number % priorities}, headers=token))
    assert {answer.status_code for answer in answers} == statuses, [answer.text for answer in answers]
    assert len({answer.json()["id"] for answer in answers if answer.status_code == 202}) == 1
    assert count(client) == before + 1


def test_what_was_created_is_answered_though_it_could_not_be_created_now(keyed_database, client):
    token = {"Idempotency-Key": new_id("test")}
    capture = client.post("/v1/captures", json={"name": "owl", "folder": str(SAMPLES / "owl")}).json()["id"]
    request = {"kind": "solve", "capture": capture}
    assert client.post("/v1/jobs", json=request, headers=token).status_code == 409  # it is not checked yet: nothing is created
    intakes.accept(keyed_database, capture, {"captures": 1})
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


def test_captures_and_environments_take_tokens_too_of_which_each_is_one_projects_own(client, keyed):
    for path in ("/v1/captures", "/v1/environments"):
        token = {"Idempotency-Key": new_id("test")}
        made = [client.post(path, json={"name": "x"}, headers=token).json()["id"] for _ in range(2)]
        assert made[0] == made[1]
        assert client.post(path, json={"name": "y"}, headers=token).status_code == 422
    token = {"Idempotency-Key": new_id("test")}
    mine = client.post("/v1/captures", json={"name": "x"}, headers=token).json()["id"]
    with keyed.client(keyed.key("birch", Scope.WRITE)) as other:
        response = other.post("/v1/captures", json={"name": "another"}, headers=token)
        assert response.status_code == 201 and response.json()["id"] != mine


@pytest.mark.parametrize("token", ["", "a b", "x" * 256, "é"], ids=["empty", "space", "long", "not ascii"])
def test_a_token_that_cannot_be_is_refused(client, token):
    response = client.post("/v1/captures", json={"name": "x"}, headers=[(b"Idempotency-Key", token.encode())])
    assert (response.status_code, response.json()["errors"][0]["field"]) == (422, "header.Idempotency-Key")


@pytest.mark.long
def test_at_once_on_either_database(database):
    def make(connection) -> str:
        return intakes.insert(connection, project=PROJECT, kind="cap", name="x")

    made = at_once(AT_ONCE, lambda _: idempotency.create_once(database, PROJECT, "token", ["x"], make))
    assert [row["id"] for row in intakes.latest(database, PROJECT, "cap", limit=10)] == list(set(made))
    assert idempotency.created_by(database, PROJECT, "token", ["x"]) == made[0]
    assert idempotency.created_by(database, PROJECT, "other", ["x"]) is None
    with pytest.raises(idempotency.TokenReused):
        idempotency.created_by(database, PROJECT, "token", ["y"])
