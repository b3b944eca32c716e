"""Garbage of the API process: cycles are still freed, and what stays until the end is not looked at."""

import base64
import gc
import weakref
from collections.abc import Iterator

import pytest
from fastapi.testclient import TestClient

from service.requests.keys import NewKey, Scope
from service.server.api import upload_patch
from service.server.api.app import create_app
from service.server.database import jobs, keys
from service.server.database.engine import Database, connect
from service.server.garbage import YOUNG, collect_seldom
from service.server.jobs.queue import prepare
from service.server.settings import Settings


class Knot:
    """An object that refers to itself."""

    def __init__(self) -> None:
        self.itself = self


@pytest.fixture
def restored():
    before = gc.get_threshold()
    yield
    gc.unfreeze()
    gc.set_threshold(*before)


def test_cycles_made_later_are_freed(restored):
    stays = Knot()
    collect_seldom()
    assert gc.get_freeze_count() > 0 and not any(each is stays for each in gc.get_objects())
    freed = weakref.ref(Knot())
    kept = [[] for _ in range(2 * YOUNG)]  # enough for a collection of the youngest
    assert freed() is None and len(kept) == 2 * YOUNG


@pytest.fixture
def settings(tmp_path) -> Settings:
    return Settings(data=tmp_path / "data", min_free_bytes=0)


@pytest.fixture
def database(settings) -> Iterator[Database]:
    made = connect(settings.sqlalchemy_url)
    prepare(settings, made)
    yield made
    made.close()


def test_queries_of_every_request_and_stream_leave_nothing_to_collect(database):
    key = keys.create(database, NewKey(project="owls", name="tests", scope=Scope.READ))
    identifier = key.partition(".")[0]

    def ask() -> None:
        assert keys.find(database, key).project == "owls"
        assert keys.still_valid(database, {identifier, "key_0"}) == {identifier}
        assert jobs.find(database, "job_0", "owls") is None
        assert jobs.watched(database, ["job_0", "owls"]) == []
        assert jobs.revisions(database, ["job_0", "job_1"]) == {}

    ask()  # the first of each is compiled and kept
    gc.collect()
    gc.disable()
    try:
        for _ in range(10):
            ask()
        assert gc.collect() < 10  # objects, not one for each time
    finally:
        gc.enable()


def test_an_upload_is_freed_with_its_last_request(settings, database, monkeypatch):
    patches: list[weakref.ref] = []

    class Patch(upload_patch.UploadPatch):
        def __init__(self, *arguments, **options) -> None:
            super().__init__(*arguments, **options)
            patches.append(weakref.ref(self))

    monkeypatch.setattr("service.server.api.uploads.UploadPatch", Patch)
    key = keys.create(database, NewKey(project="owls", name="tests", scope=Scope.WRITE))
    with TestClient(create_app(settings, database), headers={"Authorization": f"Bearer {key}", "Tus-Resumable": "1.0.0"}) as client:
        capture = client.post("/v1/captures", json={"name": "owl"}).raise_for_status().json()["id"]
        made = client.post(f"/v1/captures/{capture}/files", headers={
            "Upload-Length": "5", "Upload-Metadata": f"path {base64.b64encode(b'note.txt').decode()}"}).raise_for_status()
        gc.disable()
        try:
            client.patch(made.headers["Location"], content=b"hello", headers={
                "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}).raise_for_status()
            assert len(patches) == 1 and patches[0]() is None
        finally:
            gc.enable()
