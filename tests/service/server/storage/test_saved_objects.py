"""Backups of services with an object store: they name its objects or have copies of them, and a restore looks whether they are there."""

import json
from pathlib import Path

import pytest

from service.server.base.settings import Settings
from service.server.database import jobs
from service.server.process.backup import CONTENTS, backup, restore, save
from service.server.storage import layout
from service.server.storage.bucket import Bucket
from stage.errors import StorageError
from tests.service.server.jobs.conftest import undisturbed  # noqa: F401  (a fixture)
from tests.service.server.jobs.harness import PROJECT, digests, harness

MAPS, FRAME = (f"projects/larch/jobs/job_{'0' * 20}/{name}" for name in ("maps.exr", "frame.0001.exr"))
PIECE = "uploads/up_x/0"
HIDDEN = "projects/larch/jobs/job_x/.maps.exr", "projects/larch/shared/job_x/piece", "projects/larch/captures/cap_gone/000.exr"


@pytest.fixture
def store(url, tmp_path):
    """Results, a piece of an upload, and what no backup needs: half a file, pieces of a solve, and a capture that is being deleted."""
    bucket = Bucket(url)
    for path in (MAPS, FRAME, PIECE, *HIDDEN):
        put(bucket, tmp_path, path, path.encode())
    bucket.mark("removed/projects/larch/captures/cap_gone")
    return bucket


def put(bucket: Bucket, tmp_path: Path, path: str, content: bytes) -> None:
    (tmp_path / "content").write_bytes(content)
    bucket.send(tmp_path / "content", path, lambda: None)


def read(bucket: Bucket, tmp_path: Path, path: str) -> bytes:
    bucket.fetch(bucket.find(path), tmp_path / "fetched", lambda: None)
    return (tmp_path / "fetched").read_bytes()


@pytest.fixture
def service(url, store, tmp_path):
    with harness(tmp_path / "first", storage_url=url) as made:
        yield made.settings


def second(tmp_path: Path, url: str | None) -> Settings:
    return Settings(data=tmp_path / "second", storage_url=url)


def test_a_backup_names_the_objects_and_a_restore_looks_for_them(service, store, url, tmp_path):
    made = backup(service, tmp_path / "saved")
    stored = json.loads((tmp_path / "saved" / CONTENTS).read_text())["storage"]
    assert (stored["url"], stored["copied"], set(stored["objects"]), made.objects) == (url, False, {MAPS, FRAME}, 2)
    assert stored["objects"][MAPS] == {"size": len(MAPS), "version": store.find(MAPS).version}
    put(store, tmp_path, "projects/larch/jobs/job_new/maps.exr", b"newer")  # does no harm
    restored = restore(second(tmp_path, url), tmp_path / "saved")
    assert (restored.objects, restored.differing) == (2, 0) and (tmp_path / "second" / "relit.sqlite").is_file()


@pytest.mark.parametrize(("change", "words"), [
    ("delete", "is not in the store (1 objects of the backup are missing and"),
    ("replace", "is not what it was (0 objects of the backup are missing and")])
def test_objects_that_are_not_there_as_they_were(relit, service, store, url, tmp_path, change, words):
    outcome = relit("backup", "--out", tmp_path / "saved", "--config", config(tmp_path, service.data, url))
    assert outcome.code == 0 and f"objects  2 of {url}, named and not copied" in outcome.out
    if change == "delete":
        store.delete([FRAME])
    else:
        put(store, tmp_path, FRAME, b"x" * len(FRAME))
    given = "restore", tmp_path / "saved", "--config", config(tmp_path, tmp_path / "second", url)
    relit(*given).refused(f"{url}/{FRAME}: {words}")
    assert not (tmp_path / "second").exists()
    assert f"objects  2 in {url}, 1 missing or changed" in relit(*given, "--accept-differences").well()


def config(tmp_path: Path, data: Path, url: str) -> Path:
    (tmp_path / "relit.toml").write_text(f"data = {json.dumps(str(data))}\nstorage_url = {json.dumps(url)}\n")
    return tmp_path / "relit.toml"


def test_copies_are_sent_where_they_are_missing(service, store, url, tmp_path):
    made = backup(service, tmp_path / "saved", copy_objects=True)
    assert made.objects == 3 and made.copied  # with the piece of the upload
    assert {path.name for path in (tmp_path / "saved" / "objects").rglob("*") if path.is_file()} == {"maps.exr", "frame.0001.exr", "0"}
    store.delete([FRAME])
    put(store, tmp_path, MAPS, b"other")
    assert restore(second(tmp_path, url), tmp_path / "saved").differing == 2
    elsewhere = (tmp_path / "elsewhere").as_uri()
    assert restore(Settings(data=tmp_path / "third", storage_url=elsewhere), tmp_path / "saved").differing == 3
    for bucket in (store, Bucket(elsewhere)):
        assert [read(bucket, tmp_path, path) for path in (MAPS, FRAME, PIECE)] == [path.encode() for path in (MAPS, FRAME, PIECE)]
    (tmp_path / "saved" / "objects" / FRAME).write_bytes(b"damaged")
    with pytest.raises(ValueError, match=r"frame\.0001\.exr: is missing or differs from its checksum"):
        restore(Settings(data=tmp_path / "fourth", storage_url=elsewhere), tmp_path / "saved")


def test_a_backup_goes_where_its_files_were(service, url, tmp_path):
    backup(service, tmp_path / "saved")
    with pytest.raises(ValueError, match=r"is of a service with storage_url .*: give this one, or"):
        restore(second(tmp_path, None), tmp_path / "saved")
    with harness(tmp_path / "plain") as plain:
        result = plain.settings.data / "projects/larch/jobs/job_x/maps.exr"
        result.parent.mkdir(parents=True)
        result.write_bytes(b"maps")
        backup(plain.settings, tmp_path / "of-folder")
        with pytest.raises(ValueError, match="has no storage_url"):
            backup(plain.settings, tmp_path / "never", copy_objects=True)
    with pytest.raises(ValueError, match="lie in its data folder: leave out storage_url"):
        restore(second(tmp_path, url), tmp_path / "of-folder")
    assert not (tmp_path / "second").exists() and not (tmp_path / "never").exists()


def test_an_object_that_is_replaced_or_deleted_while_it_is_copied(store, tmp_path, monkeypatch):
    fetch, tries = Bucket.fetch, []

    def disturbed(self, found, target, moved):
        tries.append(found.path)
        if tries.count(found.path) == 1 and found.path != PIECE:
            if found.path == MAPS:
                put(self, tmp_path, MAPS, b"newer maps")
            else:
                self.delete([FRAME])
            raise StorageError("it was changed meanwhile")
        fetch(self, found, target, moved)

    monkeypatch.setattr(Bucket, "fetch", disturbed)
    saved = save(store, tmp_path / "copies")
    assert set(saved) == {MAPS, PIECE} and saved[MAPS].size == len(b"newer maps")
    assert (tmp_path / "copies" / MAPS).read_bytes() == b"newer maps" and not (tmp_path / "copies" / FRAME).exists()


@pytest.mark.long
def test_a_job_that_ran_is_finished_by_the_restored_service_in_another_store(tmp_path, undisturbed):  # noqa: F811
    roots = str(undisturbed.capture.parent)
    first, other = ((tmp_path / name).as_uri() for name in ("store", "other"))
    with harness(tmp_path / "first", roots=roots, storage_url=first) as made:
        made.start("slow", GATE=str(tmp_path / "gate"))  # so that the job runs as long as the backups
        job = made.begin(undisturbed, chunk_frames=6)
        made.until(lambda: made.row(job)["finished_steps"], "the first frames sent")
        saved = backup(made.settings, tmp_path / "saved", copy_objects=True)
        named = backup(made.settings, tmp_path / "named")
        assert made.row(job)["state"] == jobs.RUNNING and saved.objects >= 6 and named.objects >= saved.objects
        listed = json.loads((tmp_path / "named" / CONTENTS).read_text())["storage"]["objects"]
        assert all(entry.get("changes") for entry in listed.values())  # the job goes on
        (tmp_path / "gate").touch()
        assert made.ended(job)["state"] == jobs.SUCCEEDED
    assert restore(Settings(data=tmp_path / "again" / "data", storage_url=first), tmp_path / "named").differing == 0
    restore(Settings(data=tmp_path / "second" / "data", storage_url=other), tmp_path / "saved")
    with harness(tmp_path / "second", takeover_s=0.5, roots=roots, storage_url=other) as again:
        assert again.row(job)["state"] == jobs.RUNNING and again.row(job)["finished_steps"]
        again.start()
        row = again.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
    for store in ("store", "other"):
        assert digests(tmp_path / store / layout.results(PROJECT, job)) == undisturbed.digests
