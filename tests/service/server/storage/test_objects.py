"""The copies that machines keep of an object store: fetched once, fetched anew when changed, bounded, and never half there."""

import math
import os
import sys
import threading
import time

import pytest

from service.errors import RequestError
from service.server.base.settings import Settings
from service.server.storage import bucket as buckets
from service.server.storage.bucket import Bucket
from service.server.storage.folder import FolderStorage
from service.server.storage.objects import IN_USE_S, ObjectStorage, open_storage
from stage.errors import StorageError
from tests.service.recording import Recording
from tests.service.server.tcp_proxy import tcp_proxy

RESULTS = "projects/film/jobs/job_0123456789abcdefghjk"
CAPTURE = "projects/film/captures/cap_0123456789abcdefghjk"
LIMIT = 1 << 30


@pytest.fixture
def fetched(monkeypatch):
    """Names that were fetched, in order."""
    return names_of(monkeypatch, "fetch", lambda found, *_: found.path)


@pytest.fixture
def sent(monkeypatch):
    """Names that were sent, in order."""
    return names_of(monkeypatch, "send", lambda _, path, *__: path)


def names_of(monkeypatch, method, path_of):
    """A list that gets the name in each call of a method of the bucket."""
    names, whole = [], getattr(Bucket, method)
    monkeypatch.setattr(Bucket, method, lambda self, *given: (names.append(path_of(*given).rpartition("/")[2]), whole(self, *given))[1])
    return names


def put(storage, tmp_path, name, content, prefix=CAPTURE):
    (tmp_path / "upload").write_bytes(content)
    storage.put(tmp_path / "upload", prefix, name)


def test_what_is_unchanged_is_fetched_once(machine, tmp_path, fetched):
    put(machine("a"), tmp_path, "000.exr", b"zero")
    put(machine("a"), tmp_path, "001.exr", b"one")
    for _ in range(2):
        folder = machine("b").local(CAPTURE)  # also by a worker that is started anew
        assert {path.name: path.read_bytes() for path in folder.iterdir()} == {"000.exr": b"zero", "001.exr": b"one"}
    assert sorted(fetched) == ["000.exr", "001.exr"]
    put(machine("a"), tmp_path, "001.exr", b"two")
    assert (machine("b").local(CAPTURE) / "001.exr").read_bytes() == b"two"
    assert fetched[2:] == ["001.exr"]
    (folder / "000.exr").write_bytes(b"harm")  # somebody wrote into the copy
    assert (machine("b").local(CAPTURE) / "000.exr").read_bytes() == b"zero"
    machine("a").delete(CAPTURE, "000.exr")
    assert [path.name for path in machine("b").local(CAPTURE).iterdir()] == ["001.exr"]  # a copy loses what the store has lost


def test_another_machine_takes_over(machine, fetched, sent):
    """It finds what later steps read, fetches no frames that it does not need, and sends what it made alone."""
    first, second = machine("a"), machine("b")
    (first.workspace(RESULTS) / "maps.exr").write_bytes(b"maps")
    first.publish(RESULTS)
    (first.workspace(RESULTS) / "frame.0001.exr").write_bytes(b"one")
    for name in ("a", "a"):  # published files are sent once, also where the worker is started anew
        machine(name).publish(RESULTS)
    (first.workspace(RESULTS) / "frame.0002.exr").write_bytes(b"two")  # and dies
    folder = second.workspace(RESULTS)
    assert second.local(RESULTS, ("maps.exr", "depth.exr")) == folder
    assert [path.name for path in folder.iterdir()] == ["maps.exr"] and fetched == ["maps.exr"]
    (folder / "frame.0002.exr").write_bytes(b"two")
    second.publish(RESULTS)
    assert sent == ["maps.exr", "frame.0001.exr", "frame.0002.exr"]
    assert [stored.name for stored in machine("c").files(RESULTS)] == ["frame.0001.exr", "frame.0002.exr", "maps.exr"]


def test_what_is_being_removed_is_not_shown(machine, monkeypatch):
    """The process that removes it dies after the first object."""
    storage = machine("a")
    for name in ("maps.exr", "report.json"):
        (storage.workspace(RESULTS) / name).write_bytes(b"content")
    storage.publish(RESULTS)
    whole = Bucket.delete

    def delete(self, paths):
        whole(self, paths[:1])
        raise StorageError("killed")

    with monkeypatch.context() as patch:
        patch.setattr(Bucket, "delete", delete)
        with pytest.raises(StorageError):
            storage.remove(RESULTS)
    for name in ("a", "b"):
        assert machine(name).files(RESULTS) == [] and machine(name).open(RESULTS, "report.json") is None
        assert list(machine(name).local(RESULTS).iterdir()) == []
    machine("b").tidy()
    for _ in range(2):  # once more is no fault
        assert storage._bucket.below("projects") == [] and storage._bucket.below("removed") == []
        storage.tidy()


class Stop(Exception):
    """Of a job that is not wanted any more."""


class Watching(Recording):
    """A progress that stops at an advance."""

    def __init__(self, stop_at=math.inf):
        super().__init__()
        self._stop_at = stop_at

    def advance(self, done):
        super().advance(done)
        if done >= self._stop_at:
            raise Stop


def test_progress_is_told_of_files(machine, tmp_path):
    for number in range(3):
        put(machine("a"), tmp_path, f"{number}.exr", b"image")
    progress = Recording()
    machine("b").local(CAPTURE, progress=progress)
    assert [stage[:2] for stage in progress.stages] == [("download", 3)] and progress.faults == []
    machine("b").local(CAPTURE, progress=progress)
    assert len(progress.stages) == 1  # nothing had to be fetched
    (machine("b").workspace(RESULTS) / "maps.exr").write_bytes(b"maps")
    machine("b").publish(RESULTS, progress)
    assert progress.stages[1:] == [("upload", 1, [1])]


def test_a_job_that_is_cancelled_stops_in_the_middle(machine, tmp_path, fetched, monkeypatch):
    monkeypatch.setattr(buckets, "PIECE_BYTES", 1)  # many pieces
    for number in range(30):
        put(machine("a"), tmp_path, f"{number}.exr", bytes(20))
    with pytest.raises(Stop):
        machine("b").local(CAPTURE, progress=Watching(stop_at=1))
    there = list(machine("b").workspace(CAPTURE).iterdir())
    assert 0 < len(there) < 30 and all(len(path.read_bytes()) == 20 for path in there)  # whole ones alone
    before = len(fetched)
    machine("b").local(CAPTURE)
    assert len(list(machine("b").workspace(CAPTURE).iterdir())) == 30
    assert len(fetched) - before <= 30 - 1  # what had been noted as whole is not fetched again


def test_an_object_that_changes_while_it_is_fetched_is_a_fault(machine, tmp_path, monkeypatch):
    monkeypatch.setattr(buckets, "PIECE_BYTES", 4)
    storage = machine("a")
    put(storage, tmp_path, "000.exr", b"abcdefgh")
    whole = Bucket.fetch

    def fetch(self, found, target, moved):
        def change():
            moved()
            put(storage, tmp_path, "000.exr", b"ABCDEFGH")

        whole(self, found, target, change)

    with monkeypatch.context() as patch:
        patch.setattr(Bucket, "fetch", fetch)
        with pytest.raises(StorageError, match=r"cannot fetch .*000\.exr: it was changed meanwhile"):
            machine("b").local(CAPTURE)
    assert list(machine("b").workspace(CAPTURE).iterdir()) == []
    assert (machine("b").local(CAPTURE) / "000.exr").read_bytes() == b"ABCDEFGH"


def test_an_upload_that_is_interrupted_leaves_nothing(machine, tmp_path, monkeypatch):
    part = 5 << 20  # the least that S3 takes
    monkeypatch.setattr(buckets, "PART_BYTES", part)
    (tmp_path / "upload").write_bytes(bytes(3 * part))
    storage = machine("a")

    def stop():
        raise Stop

    with pytest.raises((Stop, StorageError)):
        storage._bucket.send(tmp_path / "upload", f"{CAPTURE}/000.exr", stop)
    assert storage.files(CAPTURE) == [] and storage.open(CAPTURE, "000.exr") is None


def test_two_workers_of_a_machine_fetch_once(machine, tmp_path, fetched):
    for number in range(20):
        put(machine("a"), tmp_path, f"{number}.exr", b"image")
    workers = [threading.Thread(target=machine("b").local, args=(CAPTURE,)) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(fetched) == 20 and len(list(machine("b").workspace(CAPTURE).iterdir())) == 20


def test_copies_are_bounded(tmp_path):
    """Beyond the limit the one longest unused goes first; one that is in use stays, and so does what is within the limit."""
    storage = ObjectStorage(Bucket((tmp_path / "store").as_uri()), tmp_path / "b", 1000)
    prefixes = [f"projects/film/captures/cap_{number}" for number in range(4)]
    for number, prefix in enumerate(prefixes):
        put(storage, tmp_path, "000.exr", bytes(400), prefix)
        storage.local(prefix)
        past = time.time() - IN_USE_S * (10 - number)
        for name in ("lock", "files"):
            os.utime(tmp_path / "b" / prefix / name, (past, past))

    def there():
        return [number for number, prefix in enumerate(prefixes) if (tmp_path / "b" / prefix).exists()]

    assert there() == [2, 3]  # before the fourth was fetched, the third had made the first go, and the fourth the second
    storage.local(prefixes[2])  # used now
    storage.local(prefixes[0])
    assert there() == [0, 2]
    storage.local(prefixes[1])
    assert there() == [0, 1, 2]  # all of them are in use
    assert [path.name for path in storage.local(prefixes[3]).iterdir()] == ["000.exr"]  # and can be had again


@pytest.mark.parametrize("url", ["memory:///", "http://host/x", "s3://", "file://host/folder", "file:///", "/a/folder", "s3://key:secret@bucket/x",
                                 "s3://bucket/x?region=y", "gs://bucket", "ftp://store"])
def test_urls_of_no_store(url):
    with pytest.raises(RequestError, match="storage_url: give s3://bucket/prefix or file:///folder") as refused:
        Bucket(url)
    assert "secret" not in str(refused.value)


def test_a_store_in_the_clear_must_be_allowed_and_obstore_be_there(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://store:9000")
    monkeypatch.delenv("AWS_ALLOW_HTTP", raising=False)
    with pytest.raises(RequestError, match=r"AWS_ENDPOINT_URL http://store:9000: .* AWS_ALLOW_HTTP=true"):
        Bucket("s3://bucket/prefix")
    monkeypatch.setitem(sys.modules, "obstore", None)
    monkeypatch.setitem(sys.modules, "obstore.store", None)
    monkeypatch.setitem(sys.modules, "obstore.exceptions", None)
    with pytest.raises(RequestError, match="storage_url s3://bucket/prefix: needs obstore: install"):
        Bucket("s3://bucket/prefix")


def test_a_store_that_does_not_answer_is_a_sentence(monkeypatch, tmp_path):
    for name, value in {"AWS_ENDPOINT_URL": "http://127.0.0.1:9", "AWS_ALLOW_HTTP": "true", "AWS_ACCESS_KEY_ID": "a",
                        "AWS_SECRET_ACCESS_KEY": "s3cret", "AWS_REGION": "us-east-1"}.items():
        monkeypatch.setenv(name, value)
    storage = ObjectStorage(Bucket("s3://bucket/prefix"), tmp_path, LIMIT)
    with pytest.raises(StorageError, match=r"^cannot write s3://bucket/prefix/probe: .*") as told:
        storage.check()
    assert "\n" not in str(told.value) and "s3cret" not in str(told.value)


def test_the_settings_choose(tmp_path):
    assert isinstance(open_storage(Settings(data=tmp_path)), FolderStorage)
    assert isinstance(open_storage(Settings(data=tmp_path, storage_url=(tmp_path / "store").as_uri())), ObjectStorage)


@pytest.mark.long
def test_a_damaged_answer_is_asked_for_again(s3, tmp_path, monkeypatch):
    """obstore takes an answer that is no HTTP for final, whatever its number of retries."""
    with tcp_proxy(int(os.environ["AWS_ENDPOINT_URL"].rpartition(":")[2])) as damaged:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{damaged.port}")
        bucket = Bucket(s3)
        (tmp_path / "here").write_bytes(b"pixels")
        for action in (lambda: bucket.send(tmp_path / "here", "one", lambda: None), lambda: bucket.mark("two"),
                       lambda: bucket.fetch(bucket.find("one"), tmp_path / "there", lambda: None), lambda: bucket.delete(["two"])):
            damaged.cut()  # of connections that are kept open
            damaged.damage(2)
            action()
        assert (tmp_path / "there").read_bytes() == b"pixels"
        damaged.cut()
        damaged.damage(2)
        assert bucket.below("none") == []
