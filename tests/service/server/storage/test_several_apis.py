"""Several API processes with folders of their own, one database and one object store: whichever a client asks, it goes on where it was."""

import hashlib
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import NamedTuple

import httpx2
import numpy as np
import pytest

from service.server.base.settings import Settings
from service.server.database import uploads
from service.server.database.engine import Database, connect
from service.server.storage import upload_parts
from service.server.storage.objects import open_storage
from service.server.storage.upload_parts import UploadParts, open_upload_parts
from tests.service.server.api.test_watch import queue
from tests.service.server.api.tus import Tus, encoded
from tests.service.server_process import Server, serving
from tests.service.waiting import at_once, until

pytestmark = pytest.mark.long

MIB = 1 << 20
CONTENT = np.random.default_rng(5).bytes(3 * MIB)


class Site(NamedTuple):
    first: Server
    second: Server
    store: Path
    settings: dict[str, str]


@pytest.fixture(scope="module")
def site(tmp_path_factory, server_postgres) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("apis")
    settings = {"database_url": server_postgres.new_database(), "storage_url": (folder / "store").as_uri()}
    options = ("--anonymous", "--device", "none")
    with serving(folder / "one", *options, **settings) as first, serving(folder / "two", *options, **settings) as second:
        yield Site(first, second, folder / "store", settings)


@contextmanager
def third(site: Site) -> Iterator[tuple[Database, UploadParts]]:
    """The database and the part files of another process on the machine of the first."""
    settings = Settings(data=site.first.data, **site.settings)
    with closing(connect(settings.sqlalchemy_url)) as database:
        yield database, open_upload_parts(settings, database, open_storage(settings))


def begun(site: Site, content: bytes, **words: str) -> tuple[str, str]:
    """A capture and an upload of it."""
    with site.first.client() as client:
        capture = client.post("/v1/captures", json={"name": "x"}).raise_for_status().json()["id"]
    answer = Tus(site.first.url).create(f"/v1/captures/{capture}", len(content), encoded(path="a.bin", **words))
    assert answer.status == 201, answer.body
    return capture, answer.headers["location"]


def stored(site: Site, capture: str) -> Path:
    return site.store / "projects/default/captures" / capture / "a.bin"


@pytest.mark.parametrize("checked", [False, True], ids=["plain", "sha256"])
def test_an_upload_goes_on_at_the_other_api(site, checked):
    """Its bytes lay on the first machine, and the second answered 409 for ever."""
    capture, upload = begun(site, CONTENT, **({"sha256": hashlib.sha256(CONTENT).hexdigest()} if checked else {}))
    one, two = Tus(site.first.url), Tus(site.second.url)
    assert one.patch(upload, 0, CONTENT[:MIB]).offset == MIB
    assert two.head(upload).offset == one.head(upload).offset == MIB
    assert two.patch(upload, MIB, CONTENT[MIB : 2 * MIB]).offset == 2 * MIB
    assert one.patch(upload, MIB, CONTENT[MIB:]).status == 409
    assert one.patch(upload, 2 * MIB, CONTENT[2 * MIB :]).offset == 3 * MIB
    assert stored(site, capture).read_bytes() == CONTENT
    assert not any((site.store / "uploads").glob("*/*"))  # the pieces are gone
    for server in (site.first, site.second):
        assert list((server.data / "uploads").glob("*")) == []


def test_of_two_requests_for_one_upload_one_is_refused(site):
    """Both got 204, and the file had the bytes of either."""
    capture, upload = begun(site, CONTENT)
    for at in range(0, len(CONTENT), MIB):
        found = sorted(at_once(2, lambda number, at=at: Tus(site[number].url).patch(upload, at, bytes([number]) * MIB).status))
        assert found[0] == 204 and found[1] in (409, 423)
    content = stored(site, capture).read_bytes()
    assert len(content) == len(CONTENT) and all(len(set(content[at : at + MIB])) == 1 for at in range(0, len(content), MIB))


def test_a_wrong_checksum_of_the_whole_drops_the_pieces_of_all(site):
    capture, upload = begun(site, CONTENT, sha256=hashlib.sha256(CONTENT).hexdigest())
    one, two = Tus(site.first.url), Tus(site.second.url)
    assert one.patch(upload, 0, b"x" * MIB).offset == MIB
    assert two.patch(upload, MIB, CONTENT[MIB:]).status == 460
    assert one.head(upload).offset == two.head(upload).offset == 0
    assert two.patch(upload, 0, CONTENT[:MIB]).offset == MIB
    assert one.patch(upload, MIB, CONTENT[MIB:]).offset == 3 * MIB
    assert stored(site, capture).read_bytes() == CONTENT


def test_what_came_before_a_connection_broke_goes_on_at_the_other_api(site):
    capture, upload = begun(site, CONTENT)

    def cut() -> Iterator[bytes]:
        yield CONTENT[: 2 * MIB]
        raise ConnectionError

    with pytest.raises(ConnectionError):
        httpx2.patch(f"{site.first.url}{upload}", content=cut(), headers={
            "Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"})
    two = Tus(site.second.url)
    offset = until(lambda: two.head(upload).offset)
    assert offset <= 2 * MIB
    assert two.patch(upload, offset, CONTENT[offset:]).offset == len(CONTENT)
    assert stored(site, capture).read_bytes() == CONTENT


def test_results_have_the_same_etag_at_every_api(site):
    """They were of the copy, so that an interrupted download could not be continued at the other."""
    with site.first.client() as one, site.second.client() as two:
        with site.first.database() as database:
            job = queue(database, "default")
        folder = site.store / "projects/default/jobs" / job
        folder.mkdir(parents=True)
        (folder / "maps.exr").write_bytes(CONTENT)
        found = [client.get(f"/v1/jobs/{job}/results/maps.exr") for client in (one, two)]
        assert found[0].content == found[1].content == CONTENT
        assert all(found[0].headers[name] == found[1].headers[name] for name in ("ETag", "Last-Modified"))
        part = two.get(f"/v1/jobs/{job}/results/maps.exr", headers={"Range": "bytes=5-9", "If-Range": found[0].headers["ETag"]})
        assert (part.status_code, part.content) == (206, CONTENT[5:10])
        (folder / "maps.exr").write_bytes(CONTENT[::-1])
        assert one.get(f"/v1/jobs/{job}/results/maps.exr").headers["ETag"] != found[0].headers["ETag"]


def test_deleted_and_expired_uploads_leave_no_pieces(site):
    one = Tus(site.first.url)
    _, deleted = begun(site, CONTENT)
    capture, dropped = begun(site, CONTENT)
    _, expired = begun(site, CONTENT)
    _, busy = begun(site, CONTENT)
    for upload in (deleted, dropped, expired, busy):
        assert one.patch(upload, 0, CONTENT[:MIB]).offset == MIB

    def pieces(upload: str) -> list[Path]:
        return list((site.store / "uploads" / upload.rpartition("/")[2]).glob("*"))

    assert len(pieces(expired)) == 1
    assert Tus(site.second.url).ask("DELETE", deleted).status == 204
    with site.second.client() as client:
        client.delete(f"/v1/captures/{capture}").raise_for_status()
    assert pieces(deleted) == pieces(dropped) == []
    with third(site) as (database, parts):
        (site.store / "uploads" / "up_orphan").mkdir()
        (site.store / "uploads" / "up_orphan" / "0").write_bytes(b"x")
        sent = (site.first.data / "uploads") / "up_orphan-0.part.piece"  # as an API that was killed while it sent this leaves it
        sent.write_bytes(b"x")
        row = uploads.find(database, busy.rpartition("/")[2], "default")
        with closing(parts.open(row)):  # a request adds to it
            assert one.patch(busy, MIB, CONTENT[MIB:]).status == 423
            assert parts.expire(time.time() + 60) >= 1
            assert pieces(expired) == [] and len(pieces(busy)) == 1 and not any((site.store / "uploads" / "up_orphan").glob("*"))
            assert not sent.exists()
        assert one.head(expired).status == 404


def test_a_writer_that_was_thought_dead_counts_nothing(site, monkeypatch):
    monkeypatch.setattr(upload_parts, "LEASE_S", -1.0)
    capture, upload = begun(site, CONTENT)
    with third(site) as (database, parts):
        identifier = upload.rpartition("/")[2]
        row = uploads.find(database, identifier, "default")
        with closing(parts.open(row)) as slow:
            slow.append([b"x" * MIB])
            assert Tus(site.second.url).patch(upload, 0, CONTENT[:MIB]).offset == MIB  # its lease is over
            assert not slow.save(MIB) and not slow.finish()
        assert Tus(site.first.url).patch(upload, MIB, CONTENT[MIB:]).offset == len(CONTENT)
        assert stored(site, capture).read_bytes() == CONTENT


def test_the_upload_of_an_api_that_was_killed_goes_on_at_another(site, tmp_path):
    with serving(tmp_path / "three", "--anonymous", "--device", "none", **site.settings) as third:
        capture, upload = begun(site, CONTENT)
        assert Tus(third.url).patch(upload, 0, CONTENT[:MIB]).offset == MIB
        begun_to_send = threading.Event()

        def slow() -> Iterator[bytes]:
            yield CONTENT[MIB : 2 * MIB]
            begun_to_send.set()
            time.sleep(60)

        def send() -> None:
            with pytest.raises(httpx2.TransportError):
                httpx2.patch(f"{third.url}{upload}", content=slow(), headers={
                    "Tus-Resumable": "1.0.0", "Upload-Offset": str(MIB), "Content-Type": "application/offset+octet-stream"})

        sending = threading.Thread(target=send, daemon=True)
        sending.start()
        begun_to_send.wait(30)
        time.sleep(0.5)
        one = Tus(site.first.url)
        assert one.patch(upload, MIB, CONTENT[MIB:]).status == 423
        os.killpg(third.process.pid, signal.SIGKILL)
        answer = until(lambda: (found := one.patch(upload, MIB, CONTENT[MIB:])).status != 423 and found, "still locked",
                       within_s=3 * upload_parts.LEASE_S, every_s=1)
        assert answer.offset == len(CONTENT)
        assert stored(site, capture).read_bytes() == CONTENT
