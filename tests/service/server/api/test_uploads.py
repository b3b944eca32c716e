"""Resumable uploads, as a client sees them that knows the tus protocol alone (tests/service/server/api/tus.py)."""

import hashlib
import random
import socket
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import refused
from tests.service.server.api.tus import VERSION, Tus, checksum, encoded
from tests.service.server_process import Server
from tests.service.waiting import at_once, until

KIB, MIB = 1 << 10, 1 << 20


def made(client, kind: str) -> str:
    return f"/v1/{kind}/{client.post(f'/v1/{kind}', json={'name': 'test'}).raise_for_status().json()['id']}"


def begun(tus: Tus, place: str, length: int, path: str = "file.bin", **words: str) -> str:
    answer = tus.create(place, length, encoded(path=path, **words))
    assert answer.status == 201, answer.body
    return answer.headers["location"]


def stored(server: Server, place: str, path: str) -> Path:
    return server.data / "projects/default" / place.removeprefix("/v1/") / path


def part(server: Server, upload: str) -> Path:
    return server.data / "uploads" / f"{upload.rpartition('/')[2]}.part"


def half_sent(tus: Tus, upload: str, offset: int, body: bytes, sent: int, *more: str) -> socket.socket:
    """A PATCH of which only the first bytes are sent."""
    connection = socket.create_connection((tus.host, tus.port))
    lines = [f"PATCH {upload} HTTP/1.1", f"Host: {tus.host}", f"Tus-Resumable: {VERSION}", f"Upload-Offset: {offset}",
             "Content-Type: application/offset+octet-stream", f"Content-Length: {len(body)}", *more]
    connection.sendall("\r\n".join([*lines, "", ""]).encode() + body[:sent])
    return connection


def test_the_server_says_what_it_speaks_and_refuses_another_version(tus, capture):
    answer = tus.ask("OPTIONS", "/v1/uploads", version=None)
    assert answer.status == 204
    assert answer.headers["tus-version"] == VERSION
    assert set(answer.headers["tus-extension"].split(",")) == {"creation", "checksum", "termination", "expiration"}
    assert set(answer.headers["tus-checksum-algorithm"].split(",")) == {"sha1", "sha256"}
    assert int(answer.headers["tus-max-size"]) > 0
    upload = begun(tus, capture, 4)
    other = tus.ask("PATCH", upload, b"data", version="0.2.2", Upload_Offset="0", Content_Type="application/offset+octet-stream")
    assert (other.status, other.headers["tus-version"]) == (412, VERSION)
    assert tus.ask("HEAD", upload, version=None).status == 422
    for answer in (other, tus.head(upload), tus.head("/v1/uploads/up_00000000000000000000"), tus.head("/v1/uploads/nonsense"),
                   tus.create(capture, 1, "nonsense"), tus.ask("PUT", upload)):
        assert answer.headers["tus-resumable"] == VERSION


@pytest.mark.parametrize("length", [0, 1, 3 * MIB + 17])
def test_a_file_comes_in_pieces(server, client, tus, capture, length):
    content = random.Random(length).randbytes(length)
    upload = tus.send(capture, "step 1/görl.bin", content)
    head = tus.head(upload)
    assert (head.status, head.offset, int(head.headers["upload-length"])) == (200, length, length)
    assert head.headers["cache-control"] == "no-store"
    assert head.headers["upload-metadata"] == encoded(path="step 1/görl.bin")
    assert stored(server, capture, "step 1/görl.bin").read_bytes() == content
    assert not part(server, upload).exists()
    listed = client.get(f"{capture}/files").raise_for_status().json()
    assert listed == {"files": [{"upload": upload.rpartition("/")[2], "path": "step 1/görl.bin", "length": length, "received": length,
                                 "done": True, "sha256": None}], "next": None}


def test_a_wrong_offset_length_or_type_changes_nothing(tus, capture):
    upload = begun(tus, capture, 10)
    assert tus.patch(upload, 0, b"01234").offset == 5
    away = tus.patch(upload, 0, b"01234")
    assert (away.status, away.offset) == (409, 5)
    assert tus.patch(upload, 6, b"6").status == 409
    assert tus.patch(upload, 5, b"567890").status == 413
    assert tus.ask("PATCH", upload, b"5", Upload_Offset="5", Content_Type="application/octet-stream").status == 415
    assert tus.ask("PATCH", upload, b"5", Upload_Offset="-5", Content_Type="application/offset+octet-stream").status == 422
    assert tus.head(upload).offset == 5


def test_a_body_of_unknown_length_may_not_go_beyond_the_end(server, tus, capture):
    upload = begun(tus, capture, 2 * MIB)
    for size, status in ((2 * MIB + 1, 413), (2 * MIB, 204)):
        content = bytes(size)
        answer = tus.ask("PATCH", upload, iter([content[:MIB], content[MIB:]]), Upload_Offset="0",  # type: ignore[arg-type]
                         Content_Type="application/offset+octet-stream")
        assert answer.status == status
    assert stored(server, capture, "file.bin").stat().st_size == 2 * MIB


@pytest.mark.parametrize("algorithm", ["sha1", "sha256"])
def test_a_piece_with_a_wrong_checksum_is_dropped(server, tus, capture, algorithm):
    content = random.Random(1).randbytes(3 * MIB)
    upload = begun(tus, capture, len(content))
    assert tus.patch(upload, 0, content[:MIB], Upload_Checksum=checksum(algorithm, content[:MIB])).status == 204
    wrong = tus.patch(upload, MIB, content[MIB:], Upload_Checksum=checksum(algorithm, content))
    assert (wrong.status, wrong.body.count(b"checksum-mismatch")) == (460, 1)
    assert tus.head(upload).offset == MIB
    assert part(server, upload).stat().st_size == MIB
    assert tus.patch(upload, MIB, content[MIB:], Upload_Checksum=checksum(algorithm, content[MIB:])).status == 204
    assert stored(server, capture, "file.bin").read_bytes() == content


@pytest.mark.parametrize("header", ["md5 1B2M2Y8AsgTpgAmY7PhCfg==", "sha1", "sha1 AAAA", "sha256 ###", ""])
def test_a_checksum_that_is_none_is_refused(tus, capture, header):
    upload = begun(tus, capture, 4)
    answer = tus.patch(upload, 0, b"data", Upload_Checksum=header)
    assert (answer.status, b"Upload-Checksum" in answer.body) == (400, True)
    assert tus.head(upload).offset == 0


def test_a_whole_file_with_a_wrong_checksum_is_dropped(server, client, tus, capture):
    content = random.Random(2).randbytes(2 * MIB)
    upload = begun(tus, capture, len(content), sha256=hashlib.sha256(content).hexdigest())
    assert tus.patch(upload, 0, content[:MIB]).status == 204
    wrong = tus.patch(upload, MIB, bytes(MIB))
    assert (wrong.status, b'file.bin' in wrong.body) == (460, True)
    assert (tus.head(upload).offset, part(server, upload).stat().st_size) == (0, 0)
    assert not stored(server, capture, "file.bin").exists()
    assert tus.patch(upload, 0, content).status == 204
    assert stored(server, capture, "file.bin").read_bytes() == content


@pytest.mark.parametrize("checked", [False, True])
def test_a_broken_connection_keeps_what_needs_no_check(server, tus, capture, checked):
    content = random.Random(3).randbytes(3 * MIB)
    upload = begun(tus, capture, len(content))
    connection = half_sent(tus, upload, 0, content, MIB + 5, *([f"Upload-Checksum: {checksum('sha1', content)}"] if checked else []))
    until(lambda: part(server, upload).exists() and part(server, upload).stat().st_size >= MIB)  # a block of it is written
    connection.close()
    until(lambda: tus.patch(upload, len(content), b"").status == 409)  # until it is noticed the upload is locked
    kept = tus.head(upload).offset
    assert kept == part(server, upload).stat().st_size == (0 if checked else MIB + 5)
    assert tus.patch(upload, kept, content[kept:]).status == 204
    assert stored(server, capture, "file.bin").read_bytes() == content


@pytest.mark.long
def test_an_upload_is_written_by_one_request_at_a_time(server, tus, capture):
    content = random.Random(4).randbytes(2 * MIB)
    upload = begun(tus, capture, len(content))
    with half_sent(tus, upload, 0, content, MIB) as first:
        until(lambda: part(server, upload).exists())
        until(lambda: tus.patch(upload, 0, content).status == 423)
        assert tus.ask("DELETE", upload).status == 423
        assert tus.head(upload).offset == 0
        first.sendall(content[MIB:])
        assert first.recv(KIB).startswith(b"HTTP/1.1 204")
    assert stored(server, capture, "file.bin").read_bytes() == content


def test_requests_at_once_are_one_upload(client, tus, capture):
    answers = at_once(8, lambda number: tus.create(capture, 10 + number, encoded(path="path.bin")))
    assert sorted(answer.status for answer in answers) == [201] + 7 * [409]
    token = f"once-{capture}"
    answers = at_once(8, lambda _: tus.create(capture, 10, encoded(path="token.bin"), Idempotency_Key=token))
    assert {answer.status for answer in answers} == {201}
    first, = {answer.headers["location"] for answer in answers}
    assert len(client.get(f"{capture}/files").json()["files"]) == 2
    assert tus.create(capture, 11, encoded(path="token.bin"), Idempotency_Key=token).status == 422
    assert tus.ask("DELETE", first).status == 204
    again = tus.create(capture, 10, encoded(path="token.bin"), Idempotency_Key=token).headers["location"]
    assert again != first and tus.patch(again, 0, b"0123456789").status == 204


def test_many_files_come_at_once(server, tus, capture):
    contents = {f"{number:02}.bin": random.Random(number).randbytes(700 * KIB) for number in range(12)}
    with ThreadPoolExecutor(6) as pool:
        list(pool.map(lambda item: tus.send(capture, *item, piece=256 * KIB), contents.items()))
    for name, content in contents.items():
        assert stored(server, capture, name).read_bytes() == content


def test_a_deleted_upload_leaves_nothing_and_files_are_listed_in_pages(server, client, tus, capture):
    halfway, whole = begun(tus, capture, 8, "half/way"), tus.send(capture, "whole/file", b"whole")
    assert tus.patch(halfway, 0, b"data").status == 204
    for upload in (halfway, whole):
        assert tus.ask("DELETE", upload).status == 204
        assert tus.head(upload).status == 404
        assert not part(server, upload).exists()
    assert client.get(f"{capture}/files").json()["files"] == []
    assert not stored(server, capture, "whole").exists()
    for name in ("b", "a", "C"):
        begun(tus, capture, 1, name)
    first = client.get(f"{capture}/files", params={"limit": 2}).json()
    second = client.get(f"{capture}/files", params={"limit": 2, "after": first["next"]}).json()
    assert [file["path"] for file in first["files"] + second["files"]] == ["a", "b", "C"]
    assert second["next"] is None


def test_a_deleted_capture_takes_its_uploads_along(server, client, tus, capture):
    halfway = begun(tus, capture, 8)
    answer = tus.ask("POST", halfway, b"data", Upload_Offset="0", Content_Type="application/offset+octet-stream",
                     X_HTTP_Method_Override="PATCH")  # the method may come in a header
    assert (answer.status, answer.offset) == (204, 4)
    tus.send(capture, "whole", b"whole")
    with half_sent(tus, begun(tus, capture, 2 * MIB, "late"), 0, bytes(2 * MIB), MIB) as late:
        client.delete(capture).raise_for_status()
        late.sendall(bytes(MIB))
        assert late.recv(KIB).startswith(b"HTTP/1.1 404")
    assert tus.head(halfway).status == 404
    assert not part(server, halfway).exists()
    assert not stored(server, capture, "").exists()


@pytest.mark.long
def test_a_capture_that_was_refused_is_mended(server, client, tus, capture):
    sample = SAMPLES / "lambert"
    for path in sample.iterdir():
        if path.is_file() and path.name != "capture.json":
            tus.send(capture, path.name, path.read_bytes())
    begun(tus, capture, 5, "capture.json")
    refused(client.post(f"{capture}/validate"), 409, "capture.json")
    listed = {file["path"]: file["upload"] for file in client.get(f"{capture}/files").json()["files"]}
    assert tus.patch(f"/v1/uploads/{listed['capture.json']}", 0, b"{bad}").status == 204
    client.post(f"{capture}/validate").raise_for_status()
    assert "capture.json" in server.wait(client, capture, ("refused",))["problem"]
    tus.send(capture, "capture.json", (sample / "capture.json").read_bytes())
    assert client.get(capture).json()["state"] == "receiving"
    client.post(f"{capture}/validate").raise_for_status()
    assert server.wait(client, capture, ("ready",))["problem"] is None
    closed = tus.create(capture, 1, encoded(path="more"))
    assert (closed.status, b"ready" in closed.body) == (409, True)
    assert tus.ask("DELETE", f"/v1/uploads/{listed['000.exr']}").status == 409


def test_an_environment_is_one_file_and_a_registered_capture_takes_none(client, tus, dome):
    environment = made(client, "environments")
    for content in (b"a sky", b"another"):  # in place of the first
        tus.send(environment, "sky.exr", content)
        assert tus.create(environment, 1, encoded(path="other.exr")).status == 409
    answer = tus.create(f"/v1/captures/{dome}", 1, encoded(path="a"))
    assert (answer.status, b"registered" in answer.body) == (409, True)
