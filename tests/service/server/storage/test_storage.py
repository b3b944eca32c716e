"""What every storage does, whatever is behind it."""

import os
import time
from pathlib import Path

import pytest

from service.requests.base import identifiers
from service.server.base.settings import Settings
from service.server.storage import layout, objects
from service.server.storage.bucket import PIECE_BYTES
from service.server.storage.folder import FolderStorage
from service.server.storage.objects import SCRATCH, Storage

RESULTS = "projects/film/jobs/job_0123456789abcdefghjk"
CAPTURE = "projects/film/captures/cap_0123456789abcdefghjk"
NAMES = ("capture.json", "sub folder/ü 1.exr", "100%.png", "[a]{b}~'\"$x.exr")


def write(folder: Path, name: str, content: bytes) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_bytes(content)


def names(storage: Storage, prefix: str) -> list[str]:
    return [stored.name for stored in storage.files(prefix)]


def test_what_is_published_is_there(storage):
    before = time.time()
    folder = storage.workspace(RESULTS)
    write(folder, "maps.exr", b"maps")
    write(folder, "deep/er/report.json", b"{}")
    storage.publish(RESULTS)
    found = storage.files(RESULTS)
    assert [(stored.name, stored.size) for stored in found] == [("deep/er/report.json", 2), ("maps.exr", 4)]
    assert all(before - 5 < stored.modified_at < time.time() + 5 for stored in found)  # clocks of stores count in seconds, and differ
    assert content_of(storage, RESULTS, "maps.exr") == b"maps"
    assert (storage.local(RESULTS) / "deep/er/report.json").read_bytes() == b"{}"


def content_of(storage: Storage, prefix: str, name: str) -> bytes:
    with open(storage.open(prefix, name).descriptor, "rb") as file:
        return file.read()


def test_half_written_files_are_never_part_of_it(storage):
    folder = storage.workspace(RESULTS)
    write(folder, ".frame.0001.k3j.exr", b"half")
    write(folder, "step/.frame.0003.x2f/rows.exr", b"rows")
    write(folder, "frame.0002.exr", b"whole")
    storage.publish(RESULTS, alone=False)  # another worker may be writing the others
    assert (folder / "step/.frame.0003.x2f/rows.exr").exists()
    storage.publish(RESULTS)
    assert names(storage, RESULTS) == ["frame.0002.exr"]
    assert not (folder / ".frame.0001.k3j.exr").exists() and not list((folder / "step").iterdir())
    assert storage.open(RESULTS, ".frame.0001.k3j.exr") is None


def test_files_are_put_with_any_name_that_a_file_may_have(storage, tmp_path):
    for index, name in enumerate(NAMES):
        upload = tmp_path / f"upload{index}"
        upload.write_bytes(name.encode())
        storage.put(upload, CAPTURE, name)
        assert not upload.exists()
    assert names(storage, CAPTURE) == sorted(NAMES)
    folder = storage.local(CAPTURE)
    for name in NAMES:
        assert (folder / name).read_bytes() == name.encode()
        assert content_of(storage, CAPTURE, name) == name.encode()


def test_a_file_put_or_published_again_takes_the_place_of_the_first(storage, tmp_path):
    for content in (b"first", b"other"):  # of equal size, in the same second
        write(storage.workspace(RESULTS), "report.json", content)
        storage.publish(RESULTS)
        assert content_of(storage, RESULTS, "report.json") == content
        (tmp_path / "upload").write_bytes(content)
        storage.put(tmp_path / "upload", CAPTURE, "000.exr")
        assert (storage.local(CAPTURE) / "000.exr").read_bytes() == content
        assert content_of(storage, CAPTURE, "000.exr") == content
    assert names(storage, CAPTURE) == ["000.exr"]


@pytest.mark.long
@pytest.mark.parametrize("size", [0, 1, PIECE_BYTES, PIECE_BYTES + 1, 3 * PIECE_BYTES])
def test_files_of_every_size(storage, tmp_path, size):
    content = bytes(range(256)) * (size // 256) + bytes(size % 256)
    (tmp_path / "upload").write_bytes(content)
    storage.put(tmp_path / "upload", CAPTURE, "000.exr")
    assert [stored.size for stored in storage.files(CAPTURE)] == [size]
    assert (storage.local(CAPTURE) / "000.exr").read_bytes() == content


@pytest.mark.parametrize("name", ["../maps.exr", "/etc/passwd", "", ".", "..", "a//b", "none.exr", "maps.exr/x", "a\0b", ".hidden", "deep"])
def test_names_that_are_none(storage, name):
    write(storage.workspace(RESULTS), "maps.exr", b"maps")
    write(storage.workspace(RESULTS), "deep/file", b"file")
    storage.publish(RESULTS)
    assert storage.open(RESULTS, name) is None


def test_what_is_removed_is_gone_and_nothing_else(storage):
    other = RESULTS[:-1]  # the beginning of the name
    for prefix in (RESULTS, other):
        write(storage.workspace(prefix), "maps.exr", prefix.encode())
        write(storage.workspace(prefix), "deep/file", b"file")
        storage.publish(prefix)
    assert names(storage, other) == ["deep/file", "maps.exr"]
    for _ in range(2):  # once more is no fault
        storage.remove(other)
        assert storage.files(other) == [] and storage.open(other, "maps.exr") is None
        storage.tidy()
    assert names(storage, RESULTS) == ["deep/file", "maps.exr"]
    assert (storage.local(RESULTS) / "maps.exr").read_bytes() == RESULTS.encode()


def test_a_half_removed_folder_is_finished(tmp_path):
    half = tmp_path / "projects/film/jobs/.job_0123456789abcdefghjk.removed"
    write(half, "maps.exr", b"maps")
    FolderStorage(tmp_path).tidy()
    assert not half.exists()


def test_one_file_is_deleted_and_a_storage_that_can_be_written_is_sound(storage, tmp_path):
    for name in ("deep/er/000.exr", "001.exr"):
        (tmp_path / "upload").write_bytes(b"image")
        storage.put(tmp_path / "upload", CAPTURE, name)
    storage.local(CAPTURE)
    for _ in range(2):  # once more is no fault
        storage.delete(CAPTURE, "deep/er/000.exr")
        assert names(storage, CAPTURE) == ["001.exr"] and storage.open(CAPTURE, "deep/er/000.exr") is None
    assert not (storage.local(CAPTURE) / "deep/er/000.exr").exists()
    before = sorted(tmp_path.rglob("*"))
    storage.check()
    assert sorted(tmp_path.rglob("*")) == before


TEXT = (Path(__file__).parents[4] / "docs" / "service_storage.md").read_text(encoding="utf-8")


def test_every_name_is_in_the_docs(tmp_path):
    settings = Settings(data=tmp_path)
    for kind in (identifiers.CAPTURE, identifiers.ENVIRONMENT):
        assert f"{os.path.dirname(layout.intake('PROJECT', identifiers.new_id(kind)))}/ID/…" in TEXT and f"`{kind}_…`" in TEXT
    assert f"{os.path.dirname(layout.results('PROJECT', identifiers.new_id(identifiers.JOB)))}/ID/…" in TEXT
    for name in (*layout.SOLVED, layout.FRAMES.replace("####", "0001"), layout.PICTURE, f"{layout.ASSET}.usdz", "keys.json",
                 f"{settings.part_files.name}/", f"{settings.cache.name}/", f"{SCRATCH}/", f"{objects.REMOVED}/",
                 objects.PROBE, "storage_url", "scratch_bytes", "chunk_frames", "database_url"):
        assert name in TEXT, name
    assert {"storage_url", "scratch_bytes", "chunk_frames", "database_url"} <= Settings.model_fields.keys()
    assert objects.IN_USE_S == 6 * 3600 and "the last six hours" in TEXT
