"""Content hashes, remembered by size and time."""

import os

import pytest

from stage.errors import StorageError
from stage.stack.fingerprint import Fingerprints, digest


def test_the_hash_follows_the_content_not_the_name_or_the_time(tmp_path):
    for name, content in (("a", b"same"), ("b", b"same"), ("c", b"other")):
        (tmp_path / name).write_bytes(content)
    hashes = Fingerprints(tmp_path, tmp_path / "memory.json").of(["a", "b", "c"])
    assert hashes["a"] == hashes["b"] != hashes["c"]
    os.utime(tmp_path / "a", ns=(1, 1))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"])["a"] == hashes["a"]


def test_an_unchanged_file_is_not_read_again(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"first")
    first = Fingerprints(tmp_path, tmp_path / "memory.json")
    known = first.of(["a"])
    first.remember()
    stamp = path.stat().st_mtime_ns
    path.write_bytes(b"other")  # same size; with the same time it passes for the same file: that is the bargain
    os.utime(path, ns=(stamp, stamp))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) == known
    os.utime(path, ns=(stamp, stamp + 1))
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) != known


@pytest.mark.parametrize("memory", ["", "{", "[]", "null", '{"a": 3}', '{"a": []}'])
def test_a_damaged_memory_is_only_a_slower_start(tmp_path, memory):
    (tmp_path / "a").write_bytes(b"x")
    clean = Fingerprints(tmp_path, tmp_path / "none.json").of(["a"])
    (tmp_path / "memory.json").write_text(memory)
    assert Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"]) == clean


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(StorageError, match=r"cannot read .*gone\.exr: no such file"):
        Fingerprints(tmp_path, tmp_path / "memory.json").of(["gone.exr"])


def test_the_hash_of_one_file(tmp_path):
    (tmp_path / "a").write_bytes(b"content")
    assert digest(tmp_path / "a") == Fingerprints(tmp_path, tmp_path / "memory.json").of(["a"])["a"]
    with pytest.raises(StorageError, match=r"cannot read .*gone: no such file"):
        digest(tmp_path / "gone")
