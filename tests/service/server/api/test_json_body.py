"""Bodies of JSON: looked at only for who may send them, within bounds, and without keeping others waiting; bad requests, names and
metadata: refused by name, logged once, nothing left behind."""

import asyncio
import json
import socket
import threading

import pytest
from starlette.exceptions import HTTPException

from service.requests.base.identifiers import new_id
from service.server.api import json_body
from service.server.api.json_body import MAX_DEPTH, MAX_FIELDS, parse
from service.server.base.settings import Settings
from tests.service.server.api.asgi import Call, app_of
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import refused
from tests.service.server.api.tus import encoded
from tests.service.waiting import until

JSON = {"Content-Type": "application/json"}
MANY = json.dumps({f"field{number}": 0 for number in range(60_000)}).encode()


@pytest.mark.parametrize("body", [b"{", MANY, b"[" * 100_000, b'{"name": "x"}'], ids=["broken", "many", "deep", "good"])
def test_a_body_of_whoever_has_no_key_is_not_parsed(keyed, body):
    with keyed.client() as client:
        for path in ("/v1/captures", "/v1/environments", "/v1/jobs"):
            assert client.post(path, content=body, headers=JSON).status_code == 401


def test_whoever_has_no_key_is_answered_before_the_body_has_come(keyed):
    with socket.create_connection(("127.0.0.1", int(keyed.url.rpartition(":")[2])), timeout=20) as connection:
        connection.sendall(b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n{")
        assert connection.recv(4096).startswith(b"HTTP/1.1 401")


@pytest.mark.parametrize("path", ["/v1/captures", "/v1/jobs"])
@pytest.mark.parametrize(("body", "sentence"), [
    (MANY, f"an object of the body has 60000 fields, {MAX_FIELDS} are allowed"),
    (b'{"name": ' * 200 + b"1" + b"}" * 200, f"the body is nested more than {MAX_DEPTH} levels deep"),
    (b"[" * 500_000 + b"]" * 500_000, f"the body is nested more than {MAX_DEPTH} levels deep"),
    (b'{"name": "\xff"}', "the body is not UTF-8 text"),
], ids=["many", "deep object", "deep list", "not text"])
def test_what_is_too_much_is_one_fault(client, path, body, sentence):
    answer = client.post(path, content=body, headers=JSON)
    assert answer.status_code in (400, 422) and answer.json()["detail"] == sentence and answer.json()["errors"] == []


@pytest.mark.parametrize("body", [
    b"", b"{", b"\x00", b"null", b"[]", b'{"name": 1e999}', b'\xff\xfe{"name": "x"}', b'{"name": ' + b"9" * 100_000 + b"}",
    b'{"name": "\\ud800"}', b'{"name": "x", "\\ud800": 1}', b'{"name": NaN}',
], ids=["empty", "cut", "nul", "null", "list", "infinity", "utf-16", "long number", "surrogate", "surrogate key", "nan"])
def test_a_body_that_is_no_proper_request_is_refused(client, body):
    answer = client.post("/v1/captures", content=body, headers=JSON)
    assert answer.status_code in (400, 422), answer.text
    assert answer.json()["detail"] and answer.json()["status"] == answer.status_code


def test_bodies_are_json_and_no_larger_than_json_has_to_be(client):
    good = json.dumps({"kind": "solve", "capture": new_id("cap")})
    assert client.post("/v1/jobs", content=good, headers={"Content-Type": "application/json; charset=utf-8"}).status_code == 404
    refused(client.post("/v1/jobs", content=good, headers={"Content-Type": "text/plain"}), 415, "send Content-Type: application/json")
    refused(client.post("/v1/jobs", content=good), 415, "send Content-Type: application/json")
    large = " " * (1 << 20) + good
    for path in ("/v1/jobs", "/v1/captures"):
        refused(client.post(path, content=large, headers=JSON), 413, "larger than 1048576 bytes")
        pieces = (large[at : at + 65536].encode() for at in range(0, len(large), 65536))  # sent without a length
        refused(client.post(path, content=pieces, headers=JSON), 413, "larger than 1048576 bytes")


def test_a_list_of_wrong_values_is_given_up_at_the_first(client):
    """Faults of all values of a list would cost more than anybody reads."""
    wrong = {f"wrong{number}": 0 for number in range(MAX_FIELDS)}
    tracks = [{"name": "key", "keys": [wrong] * 5}] * 80
    body = {"kind": "relight", "capture": f"cap_{'0' * 20}", "keys": {"schema": "relit.keys/1", "lights": tracks}}
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
    answered, seen = threading.Event(), []

    def slow(body: bytes) -> object:
        seen.append(answered.wait(20))
        return parse(body)

    monkeypatch.setattr(json_body, "parse", slow)

    async def follow(app) -> int:
        body = b'{"name": "x"}'
        headers = {"Content-Type": "application/json", "Content-Length": str(len(body))}
        creating = asyncio.create_task(Call(app, "/v1/captures", method="POST", headers=headers, sent=body).run())
        await asyncio.sleep(0.1)
        assert (await Call(app, "/healthz").run()).status == 200
        answered.set()
        return (await creating).status

    with app_of(Settings(data=tmp_path, anonymous=True, min_free_bytes=0)) as app:
        assert asyncio.run(follow(app)) == 201 and seen == [True]


def test_a_body_that_does_not_come_is_given_up(monkeypatch, tmp_path):
    monkeypatch.setattr(json_body, "BODY_S", 0.2)
    with app_of(Settings(data=tmp_path, anonymous=True, min_free_bytes=0)) as app:
        call = Call(app, "/v1/captures", method="POST", headers={**JSON, "Content-Length": "9"}, sent=None)
        asyncio.run(asyncio.wait_for(call.run(), 20))
    assert call.status == 400 and b"did not come within" in call.body


@pytest.mark.usefixtures("worker_lives")
def test_bad_requests_are_refused_by_name_and_logged_once(server, client, registered):
    (registered / "out").symlink_to(SAMPLES.parent)
    (registered / "circle").symlink_to(registered / "circle")
    (registered / "file").write_text("no folder")
    bad = [
        ("/v1/captures", {"name": "x", "colour": "red"}, "colour"),
        ("/v1/captures", {}, "name"),
        ("/v1/captures", {"name": ""}, "name"),
        ("/v1/captures", {"name": "a\0b"}, "name"),
        ("/v1/captures", {"name": "half \ud800"}, ""),
        ("/v1/captures", {"name": "x" * 201}, "name"),
        ("/v1/captures", {"name": 5}, "name"),
        ("/v1/captures", {"name": "x", "folder": "relative"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": ""}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/../data"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/a\0b"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/\ud800"}, ""),
        ("/v1/captures", {"name": "x", "folder": "/etc"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": str(server.data)}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/out/tests"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/circle"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/nothing"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/file"}, "folder"),
        ("/v1/captures", {"name": "x", "folder": f"{registered}/{'x' * 5000}"}, "folder"),
        ("/v1/environments", {"name": "x", "file": str(registered)}, "file"),
        ("/v1/jobs", {"kind": "depth", "capture": "cap_0123456789abcdefghjk", "tof_calibration": "a\0b"}, "tof_calibration"),
        ("/v1/jobs", {"kind": "relight", "capture": "cap_0123456789abcdefghjk", "options": {"frames": "1\0"}}, "frames"),
        ("/v1/environments", {"name": "x", "file": "/etc/passwd"}, "file"),
        ("/v1/environments", {"name": "x", "folder": "/etc"}, "folder"),
    ]
    count = len(client.get("/v1/captures", params={"limit": 500}).json()["items"])
    refused = []
    for path, body, field in bad:
        answer = client.post(path, content=json.dumps(body), headers={"Content-Type": "application/json"})
        assert answer.status_code in (400, 422), (body, answer.text)
        problem = answer.json()
        assert problem["status"] == answer.status_code and field in problem["detail"], (body, problem)
        assert "passwd" not in problem["detail"]
        refused.append(problem["request_id"])
    assert [len(lines_of(server, request)) for request in refused] == [1] * len(bad)
    assert len(client.get("/v1/captures", params={"limit": 500}).json()["items"]) == count


def lines_of(server, request_id: str) -> list[dict]:
    """What was logged of a request; the last line of it may come after its answer."""
    return until(lambda: [line for line in server.lines() if line.get("request") == request_id])


@pytest.mark.usefixtures("worker_lives")
@pytest.mark.parametrize("path", [
    "../capture.json", "a/../../b", "/etc/passwd", "C:/x", "\\\\server\\share", "a\\b", "nul\0", "new\nline", "\u202egnp.exe",
    "zero\u200bwidth", "e\u0301.exr", ".hidden", "a/.part", "CON", "aux.exr", "end.", "end ", "x" * 256, "/".join("abcdefghi"), ""])
def test_names_that_are_not_safe_are_refused_and_leave_nothing(server, client, tus, capture, path):
    def parts() -> set:
        return set((server.data / "uploads").glob("*"))

    before = parts()
    answer = tus.create(capture, 4, encoded(path=path))
    problem = json.loads(answer.body)
    assert (answer.status, problem["detail"].startswith("path ")) == (422, True)
    assert problem["detail"].isprintable()
    assert client.get(f"{capture}/files").json()["files"] == [] and parts() == before
    assert [line["problem"] for line in lines_of(server, problem["request_id"])] == [problem["detail"]]


@pytest.mark.usefixtures("worker_lives")
@pytest.mark.parametrize(("first", "second"), [
    ("Frame.exr", "frame.EXR"), ("straße", "STRASSE"), ("a/x", "A/y"), ("a", "a/b"), ("A", "a/b"), ("a/b", "a"), ("a/b/c", "a/B")])
def test_names_that_are_one_without_case_are_refused(client, tus, capture, first, second):
    tus.send(capture, first, b"first")
    answer = tus.create(capture, 4, encoded(path=second))
    assert (answer.status, first in json.loads(answer.body)["detail"]) == (409, True)
    assert [file["path"] for file in client.get(f"{capture}/files").json()["files"]] == [first]


@pytest.mark.usefixtures("worker_lives")
@pytest.mark.parametrize("metadata", ["", "path", "filename YQ==", "path YQ==,owner YQ==", "path YQ==,path Yg==", "path !!!", "path /w==",
                                      "path YQ==,sha256 YQ==", "sha256 YQ=="])
def test_metadata_that_is_not_known_is_refused(tus, capture, metadata):
    answer = tus.create(capture, 4, metadata)
    assert (answer.status, json.loads(answer.body)["detail"].startswith(("Upload-Metadata", "path "))) == (422, True)
