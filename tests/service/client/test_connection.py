"""What the client does when the service is away, busy, or not the service at all; the network is played."""

import json
import socket
from typing import Any

import httpx2
import pytest

from service.client import Busy, Client, ClientError, Conflict, Faulty, Invalid, NotAllowed, NotFound, Unreachable, connection
from service.requests.jobs import SolveJob

JOB = "job_0123456789abcdefghjk"
VIEW = {"id": JOB, "state": "queued", "attempt": 1, "revision": 1, "priority": 50, "request": {"kind": "solve",
        "capture": "cap_0123456789abcdefghjk"}, "created_at": "2026-01-01T00:00:00Z", "started_at": None, "finished_at": None,
        "progress": None, "error": None}


class Played(httpx2.BaseTransport):
    """Answers in turn; an exception is raised."""

    def __init__(self, *answers: httpx2.Response | Exception) -> None:
        self.answers, self.requests = list(answers), []

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


def problem(status: int, kind: str, detail: str, **headers: str) -> httpx2.Response:
    body = {"type": f"urn:relit:problem:{kind}", "title": "", "status": status, "detail": detail, "request_id": "12ab", "errors": [
        {"field": "body.name", "message": "is wrong"}]}
    return httpx2.Response(status, headers={"Content-Type": "application/problem+json", **headers}, content=json.dumps(body))


def view() -> httpx2.Response:
    return httpx2.Response(200, json=VIEW)


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pauses are noted and not made."""
    found: list[float] = []
    monkeypatch.setattr(connection.time, "sleep", found.append)
    return found


def client(transport: httpx2.BaseTransport, **options: Any) -> Client:
    return Client("http://service.test", "a-key", transport=transport, **options)


def test_a_busy_service_is_asked_again_when_it_says_within_the_patience_there_is(pauses):
    played = Played(problem(429, "too-many", "slow down", **{"Retry-After": "7"}), problem(503, "unavailable", "soon"), view())
    assert client(played).jobs.get(JOB).id == JOB
    assert pauses[0] == 7
    assert 0 < pauses[1] <= connection.FIRST_PAUSE_S * 2
    assert len(pauses) == 2
    with pytest.raises(Busy, match="slow down") as caught:
        client(Played(problem(429, "too-many", "slow down", **{"Retry-After": "500"})), patience_s=100).jobs.get(JOB)
    assert (caught.value.status, caught.value.kind, caught.value.request_id) == (429, "too-many", "12ab")
    assert len(pauses) == 2
    answer = httpx2.Response(503, headers={"Retry-After": "Fri, 31 Dec 1999 23:59:59 GMT"})
    assert connection.retry_after(answer) == 0
    assert connection.retry_after(httpx2.Response(503, headers={"Retry-After": "soon"})) is None


def test_a_job_is_handed_in_again_with_the_same_token_and_the_next_with_another(pauses):
    played = Played(httpx2.ReadError("gone"), httpx2.ConnectError("refused"), httpx2.Response(502), view(), view())
    with client(played) as asking:
        for _ in range(2):
            asking.jobs.submit(SolveJob.model_validate(VIEW["request"]))
    tokens = [request.headers["idempotency-key"] for request in played.requests]
    assert len(tokens) == 5 and len(set(tokens[:4])) == 1 and tokens[4] != tokens[0]


@pytest.mark.parametrize("error", [httpx2.ReadError("gone"), httpx2.ReadTimeout("silent"), httpx2.RemoteProtocolError("cut")])
def test_what_may_have_been_done_is_not_done_twice(pauses, error):
    played = Played(httpx2.ConnectError("refused"), error)  # what was not sent is sent again
    with pytest.raises(Unreachable, match="may have done what was asked"):
        client(played).jobs.cancel(JOB)
    assert len(played.requests) == 2


def test_patience_ends_and_nobody_listens(pauses, monkeypatch: pytest.MonkeyPatch):
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr(connection.time, "monotonic", lambda: next(clock))
    played, said = Played(*[httpx2.ConnectError("refused")] * 100), []
    with pytest.raises(Unreachable, match=r"http://service\.test does not answer: refused"):
        client(played, patience_s=50, on_silence=said.append).jobs.get(JOB)
    assert 1 < len(played.requests) < 10 and said == ["http://service.test does not answer: refused; asked again for 50 s"]
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and never listens
        url = f"http://127.0.0.1:{taken.getsockname()[1]}"
        with Client(url, patience_s=0) as asking, pytest.raises(Unreachable, match=f"{url} does not answer"):
            asking.jobs.get(JOB)


@pytest.mark.parametrize(("status", "kind", "error"), [
    (401, "unauthenticated", NotAllowed), (403, "forbidden", NotAllowed), (404, "not-found", NotFound), (410, "gone", NotFound),
    (409, "conflict", Conflict), (422, "invalid", Invalid), (460, "checksum-mismatch", Invalid), (507, "full", Busy),
    (500, "internal", Faulty)])
def test_a_problem_becomes_an_error(status, kind, error):
    played = Played(problem(status, kind, "one sentence"))
    with pytest.raises(error) as caught:
        client(played).jobs.get(JOB)
    assert (str(caught.value), caught.value.kind, caught.value.errors) == ("one sentence", kind, (("body.name", "is wrong"),))
    assert type(caught.value) is error


@pytest.mark.parametrize("answer", [
    httpx2.Response(404, text="<html>"), httpx2.Response(302, headers={"Location": "http://elsewhere.test/"}),
    httpx2.Response(400, headers={"Content-Type": "application/problem+json"}, content=b"\xff")])
def test_something_else_answers(answer):
    with pytest.raises(Unreachable, match=f"status {answer.status_code}: look at the server's URL"):
        client(Played(answer)).jobs.get(JOB)


@pytest.mark.parametrize("server", ["http://service.test", "http://service.test/", "http://service.test/v1", "http://service.test/v1/"])
def test_the_address_may_be_the_one_that_serve_prints(server):
    played = Played(view())
    Client(server, transport=played).jobs.get(JOB)
    assert str(played.requests[0].url) == f"http://service.test/v1/jobs/{JOB}"


@pytest.mark.parametrize(("given", "words"), [
    *(([server], "is no URL of a service") for server in ("", "service.test", "ftp://service.test", "http://", "http://service.test:x")),
    *((["http://service.test", key], "the key has characters that no key") for key in ("schlüssel", "key\nX-Other: header", "key\x00"))])
def test_an_address_or_a_key_that_is_none(given, words):
    with pytest.raises(ClientError, match=words):
        Client(*given)


def test_an_identifier_stays_one_part_of_the_path_and_pages_are_followed():
    played = Played(problem(404, "not-found", "there is no such job"))
    with pytest.raises(NotFound):
        client(played).jobs.get("../keys?all=1#")
    assert played.requests[0].url.raw_path == b"/v1/jobs/..%2Fkeys%3Fall%3D1%23"
    played = Played(*(httpx2.Response(200, json={"jobs": [VIEW], "next": following}) for following in (JOB, None)))
    assert len(list(client(played).jobs.all(["queued", "running"]))) == 2
    asked = b"state=queued&state=running"
    assert [request.url.query for request in played.requests] == [asked, asked + b"&before=" + JOB.encode()]
