"""Bodies of JSON: looked at only for who may send them, within bounds, and without keeping others waiting."""

import asyncio
import json
import socket
import threading
from collections.abc import Iterator

import pytest
from starlette.exceptions import HTTPException

from service.requests.keys import NewKey, Scope
from service.server.api import json_body
from service.server.api.app import create_app
from service.server.api.json_body import MAX_DEPTH, MAX_FIELDS, parse
from service.server.base.settings import Settings
from service.server.database import keys
from service.server.database.engine import connect
from service.server.jobs.queue import prepare
from tests.service.server.api.asgi import Call
from tests.service.server_process import Server, serving

JSON = {"Content-Type": "application/json"}
MANY = json.dumps({f"field{number}": 0 for number in range(60_000)}).encode()


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[tuple[Server, str]]:
    with serving(tmp_path_factory.mktemp("bodies"), "--device", "none", min_free_bytes="0") as server:
        database = connect(Settings(data=server.data).sqlalchemy_url)
        key = keys.create(database, NewKey(project="larch", name="x", scope=Scope.WRITE))
        database.close()
        yield server, key


@pytest.mark.long
@pytest.mark.parametrize("body", [b"{", MANY, b"[" * 100_000, b'{"name": "x"}'], ids=["broken", "many", "deep", "good"])
def test_a_body_of_whoever_has_no_key_is_not_parsed(site, body):
    server, _ = site
    for path in ("/v1/captures", "/v1/environments", "/v1/jobs"):
        with server.client() as client:
            assert client.post(path, content=body, headers=JSON).status_code == 401


def test_whoever_has_no_key_is_answered_before_the_body_has_come(site):
    server, _ = site
    with socket.create_connection(("127.0.0.1", int(server.url.rpartition(":")[2])), timeout=20) as connection:
        connection.sendall(b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n{")
        assert connection.recv(4096).startswith(b"HTTP/1.1 401")


@pytest.mark.parametrize("path", ["/v1/captures", "/v1/jobs"])
@pytest.mark.parametrize(("body", "sentence"), [
    (MANY, f"an object of the body has 60000 fields, {MAX_FIELDS} are allowed"),
    (b'{"name": ' * 200 + b"1" + b"}" * 200, f"the body is nested more than {MAX_DEPTH} levels deep"),
    (b"[" * 100_000 + b"]" * 100_000, f"the body is nested more than {MAX_DEPTH} levels deep"),
    (b'{"name": "\xff"}', "the body is not UTF-8 text"),
], ids=["many", "deep object", "deep list", "not text"])
def test_what_is_too_much_is_one_fault(site, path, body, sentence):
    server, key = site
    with server.client(key) as client:
        answer = client.post(path, content=body, headers=JSON)
        assert answer.status_code in (400, 422) and answer.json()["detail"] == sentence and answer.json()["errors"] == []


def test_a_list_of_wrong_values_is_given_up_at_the_first(site):
    """Faults of all values of a list would cost more than anybody reads."""
    server, key = site
    wrong = {f"wrong{number}": 0 for number in range(MAX_FIELDS)}
    tracks = [{"name": "key", "keys": [wrong] * 5}] * 80
    body = {"kind": "relight", "capture": f"cap_{'0' * 20}", "keys": {"schema": "relit.keys/1", "lights": tracks}}
    with server.client(key) as client:
        answer = client.post("/v1/jobs", json=body)
    assert answer.status_code == 422 and len(answer.json()["errors"]) <= 20 and len(answer.content) < 20_000


def test_bounds_are_where_they_are_said_to_be():
    assert parse(json.dumps({str(number): number for number in range(MAX_FIELDS)}).encode()) == {
        str(number): number for number in range(MAX_FIELDS)}
    deep = b"[" * MAX_DEPTH + b"1" + b"]" * MAX_DEPTH
    parse(deep)
    with pytest.raises(HTTPException, match="nested"):
        parse(b"[" + deep + b"]")
    with pytest.raises(json.JSONDecodeError):
        parse(b"{")


def test_a_body_is_parsed_while_others_are_answered(monkeypatch, tmp_path):
    """Parsing it in the event loop kept all clients waiting."""
    settings = Settings(data=tmp_path, anonymous=True, min_free_bytes=0)
    database = connect(settings.sqlalchemy_url)
    prepare(settings, database)
    app, answered, seen = create_app(settings, database), threading.Event(), []

    def slow(body: bytes) -> object:
        seen.append(answered.wait(20))
        return parse(body)

    monkeypatch.setattr(json_body, "parse", slow)

    async def follow() -> int:
        body = b'{"name": "x"}'
        headers = {"Content-Type": "application/json", "Content-Length": str(len(body))}
        creating = asyncio.create_task(Call(app, "/v1/captures", method="POST", headers=headers, sent=body).run())
        await asyncio.sleep(0.1)
        assert (await Call(app, "/healthz").run()).status == 200
        answered.set()
        return (await creating).status

    assert asyncio.run(follow()) == 201 and seen == [True]
    database.close()


def test_a_body_that_does_not_come_is_given_up(monkeypatch, tmp_path):
    monkeypatch.setattr(json_body, "BODY_S", 0.2)
    settings = Settings(data=tmp_path, anonymous=True, min_free_bytes=0)
    database = connect(settings.sqlalchemy_url)
    prepare(settings, database)
    sent: list[dict] = []

    async def never() -> dict:
        await asyncio.sleep(60)
        raise AssertionError

    async def send(message: dict) -> None:
        sent.append(message)

    scope = {"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST", "scheme": "http", "path": "/v1/captures",
             "raw_path": b"/v1/captures", "root_path": "", "query_string": b"", "client": ("127.0.0.1", 1), "server": ("127.0.0.1", 1),
             "headers": [(b"host", b"127.0.0.1"), (b"content-type", b"application/json"), (b"content-length", b"9")]}
    asyncio.run(create_app(settings, database)(scope, never, send))
    database.close()
    assert sent[0]["status"] == 400 and b"did not come within" in sent[1]["body"]
