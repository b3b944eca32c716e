"""Uploads when something goes wrong: the server is killed, the disk refuses, a part is lost, nobody goes on, and what limits refuse."""

import hashlib
import os
import random
import resource
import signal
import socket
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import pytest
from fastapi.testclient import TestClient

from service.requests.keys import Scope
from service.server.api.upload_patch import UploadPatch
from service.server.base.settings import Settings
from service.server.database import tables
from service.server.storage.upload_parts import PartFileLocked, UploadParts
from tests.service.server.api.asgi import app_of
from tests.service.server.api.job_calls import refused
from tests.service.server.api.test_uploads import begun, made, part, stored
from tests.service.server.api.tus import Tus, checksum, encoded
from tests.service.server_process import new_key, revoke, serving
from tests.service.waiting import at_once

KIB, MIB = 1 << 10, 1 << 20
PATIENCE_S = 30.0


@pytest.mark.long
def test_a_killed_server_loses_nothing_that_it_told(tmp_path):
    contents = {f"{number}.bin": random.Random(number).randbytes(4 * MIB + number) for number in range(4)}
    told: dict[str, int] = {}
    place, uploads_of = "", {}
    for delay in (0.15, 0.4, None):
        with serving(tmp_path, "--anonymous", "--device", "none") as server, server.client() as client:
            tus = Tus(server.url)
            place = place or made(client, "captures")
            for name, content in contents.items():
                if name not in uploads_of:
                    uploads_of[name] = begun(tus, place, len(content), name, sha256=hashlib.sha256(content).hexdigest())

            def go_on(name: str, tus: Tus = tus) -> None:
                content, upload = contents[name], uploads_of[name]
                offset = tus.head(upload).offset
                assert offset >= told.get(name, 0)
                while offset < len(content):
                    piece = content[offset : offset + MIB // 2]
                    checked = {"Upload_Checksum": checksum("sha256", piece)} if name < "2" else {}
                    offset = told[name] = tus.patch(upload, offset, piece, **checked).offset

            with ThreadPoolExecutor(len(contents)) as pool:
                futures = [pool.submit(go_on, name) for name in contents]
                if delay is not None:
                    time.sleep(delay)
                    os.killpg(server.process.pid, signal.SIGKILL)
            broken = [error for future in futures if (error := future.exception()) is not None]
            assert all(isinstance(error, OSError) or "http" in type(error).__module__ for error in broken), broken
            if delay is None:
                assert not broken
                for name, content in contents.items():
                    assert stored(server, place, name).read_bytes() == content
                assert list((server.data / "uploads").iterdir()) == []


@pytest.mark.long
def test_postgresql_tells_the_same_paths_and_requests(tmp_path, server_postgres):
    with serving(tmp_path, "--anonymous", "--device", "none", database_url=server_postgres.new_database()) as server, \
            server.client() as client:
        place, tus = made(client, "captures"), Tus(server.url)
        answers = at_once(8, lambda number: tus.create(place, 10 + number, encoded(path="same.bin")))
        assert sorted(answer.status for answer in answers) == [201] + 7 * [409]
        answers = at_once(8, lambda _: tus.create(place, 10, encoded(path="a b/once.bin"), Idempotency_Key="once"))
        assert {answer.status for answer in answers} == {201}
        assert len({answer.headers["location"] for answer in answers}) == 1
        for path in ("A B/other", "a b", "SAME.bin/x", "sAme.bin"):
            assert tus.create(place, 1, encoded(path=path)).status == 409
        for path in ("a b/other", "a b2", "a!b/x", "ä/x"):
            tus.send(place, path, b"data")
        listed = client.get(f"{place}/files").json()["files"]
        assert [file["path"] for file in listed] == ["a b/once.bin", "a b/other", "a b2", "a!b/x", "ä/x", "same.bin"]  # ä begins with an a
        assert client.get(f"{place}/files", params={"after": "a b2"}).json()["files"] == listed[3:]
        assert client.delete(place).status_code == 204


def test_bytes_behind_what_was_counted_are_cut_off(server, tus, capture):
    """A kill leaves them like this: written, and neither synchronised nor found right."""
    upload = begun(tus, capture, 8)
    assert tus.patch(upload, 0, b"good").status == 204
    with open(part(server, upload), "ab") as file:
        file.write(b"bad and more")
    assert tus.head(upload).offset == 4
    assert tus.patch(upload, 4, b"data").status == 204
    assert stored(server, capture, "file.bin").read_bytes() == b"gooddata"


def test_a_complete_file_that_was_moved_and_not_noted_is_complete(server, client, tus, capture):
    """A kill between the two leaves the file like this."""
    upload = begun(tus, capture, 8)
    assert tus.patch(upload, 0, b"good").status == 204
    stored(server, capture, "").mkdir(parents=True)
    part(server, upload).rename(stored(server, capture, "file.bin"))
    assert tus.head(upload).offset == 0  # half of it is not all of it
    with open(stored(server, capture, "file.bin"), "ab") as file:
        file.write(b"data")
    assert tus.head(upload).offset == 8
    assert [file["done"] for file in client.get(f"{capture}/files").json()["files"]] == [True]


def test_a_part_that_is_lost_begins_again(server, tus, capture):
    upload = begun(tus, capture, 8)
    assert tus.patch(upload, 0, b"good").status == 204
    part(server, upload).unlink()
    assert tus.head(upload).offset == 0
    assert tus.patch(upload, 4, b"data").status == 409
    assert tus.patch(upload, 0, b"all of it"[:8]).status == 204
    assert stored(server, capture, "file.bin").read_bytes() == b"all of i"


@pytest.mark.long
@pytest.mark.skipif(not hasattr(resource, "prlimit"), reason="the limit of another process can be set on Linux alone")
def test_a_disk_that_refuses_is_said_and_the_part_is_cut_back(tmp_path):
    with serving(tmp_path, "--anonymous", "--device", "none") as server, server.client() as client:
        place, tus = made(client, "captures"), Tus(server.url)
        content = random.Random(5).randbytes(12 * MIB)
        upload = begun(tus, place, len(content))
        assert tus.patch(upload, 0, content[:MIB]).status == 204
        before = resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (8 * MIB, before[1]))  # files grow no further, as on a full disk
        full = tus.patch(upload, MIB, content[MIB:])
        assert (full.status, full.headers["retry-after"].isdigit()) == (507, True)
        assert tus.head(upload).offset == part(server, upload).stat().st_size == MIB
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, before)
        assert tus.patch(upload, MIB, content[MIB:]).status == 204
        assert stored(server, place, "file.bin").read_bytes() == content


@pytest.mark.parametrize("headers", [{}, {"Idempotency_Key": "once"}], ids=["plain", "with a token"])
def test_an_expired_upload_is_begun_again_at_once(server, client, tus, capture, headers):
    """410 says so; it was 409 until the next housekeeping."""
    content = b"12345678"
    first = tus.create(capture, len(content), encoded(path="a.bin"), **headers).headers["location"]
    assert tus.patch(first, 0, content[:3]).offset == 3
    with server.database() as database:
        database.transact(lambda connection: connection.execute(tables.uploads.update().where(
            tables.uploads.c.id == first.rpartition("/")[2]).values(touched_at=time.time() - 49 * 3600)))
    assert tus.patch(first, 3, content[3:]).status == tus.head(first).status == 410
    again = tus.create(capture, len(content), encoded(path="a.bin"), **headers)
    assert (again.status, again.offset) == (201, 0)
    assert again.headers["location"] != first
    assert tus.patch(again.headers["location"], 0, content).offset == len(content)
    assert stored(server, capture, "a.bin").read_bytes() == content
    assert tus.head(first).status == 404


def test_a_length_that_is_said_twice_is_refused(server, capture):
    """A proxy before the service may have believed the other header, and taken the rest of the body for the next request."""
    upload = Tus(server.url).create(capture, 8, encoded(path="a.bin")).headers["location"]
    port = int(server.url.rpartition(":")[2])
    smuggled = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
    for method, path in (("PATCH", upload), ("POST", "/v1/captures"), ("GET", "/healthz")):
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as connection:
            connection.sendall((f"{method} {path} HTTP/1.1\r\nHost: localhost\r\nTus-Resumable: 1.0.0\r\nUpload-Offset: 0\r\n"
                                "Content-Type: application/offset+octet-stream\r\nContent-Length: 4\r\nTransfer-Encoding: chunked\r\n\r\n"
                                "0\r\n\r\n").encode() + smuggled)
            answer = b"".join(iter(lambda: connection.recv(4096), b""))
        assert answer.startswith(b"HTTP/1.1 400") and answer.count(b"HTTP/1.1") == 1, (path, answer)
        assert b"both Content-Length and Transfer-Encoding" in answer


def test_files_are_not_for_everybody(server, tus, capture):
    tus.send(capture, "a.bin", b"12345678")
    half = tus.create(capture, 8, encoded(path="b.bin")).headers["location"]
    tus.patch(half, 0, b"1234")
    files = [*server.data.glob("relit.sqlite*"), stored(server, capture, "a.bin"), part(server, half)]
    folders = {folder for file in files for folder in file.parents if folder.is_relative_to(server.data)}
    assert len(files) >= 3 and [path for path in (*files, *folders) if path.stat().st_mode & 0o027] == []


def test_a_part_is_locked_once(tmp_path):
    parts, upload = UploadParts(tmp_path, None), {"id": "up_1"}
    with closing(parts.open(upload)) as first, pytest.raises(PartFileLocked):
        first.append([b"da", b"", b"ta"])
        parts.open(upload)
    with closing(parts.open(upload)):
        assert parts.size(upload) == 4


@pytest.mark.parametrize("checked", [False, True], ids=["plain", "with a checksum"])
def test_a_patch_whose_key_is_revoked_meanwhile_is_refused(tmp_path, monkeypatch, checked):
    write = UploadPatch.write
    with app_of(Settings(data=tmp_path / "data", min_free_bytes=0)) as app:
        database = app.state.service.database
        key, other = (new_key(database, scope=Scope.WRITE) for _ in range(2))

        async def write_and_revoke(patch, stream) -> None:
            await write(patch, stream)
            revoke(database, key)

        monkeypatch.setattr(UploadPatch, "write", write_and_revoke)
        with TestClient(app, headers={"Authorization": f"Bearer {key}", "Tus-Resumable": "1.0.0"}) as client:
            capture = client.post("/v1/captures", json={"name": "x"}).raise_for_status().json()["id"]
            place = client.post(f"/v1/captures/{capture}/files", headers={
                "Upload-Length": "5", "Upload-Metadata": encoded(path="a.bin")}).raise_for_status().headers["Location"]
            response = client.patch(place, content=b"hello", headers={
                "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream",
                **({"Upload-Checksum": checksum("sha256", b"hello")} if checked else {})})
            refused(response, 401, "revoked")
            assert client.head(place, headers={"Authorization": f"Bearer {other}"}).headers["Upload-Offset"] == "0"
