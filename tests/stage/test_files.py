"""Files that appear whole or not at all."""

import os
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import stage
from stage.errors import StorageError
from stage.files import folder_beside, replacing, replacing_folder, write_text
from tests.scenes.captures import files_in

ROOT = Path(stage.__file__).parents[1]


def test_the_temporary_lies_beside_the_target_and_keeps_its_suffix(tmp_path):
    target = tmp_path / "new" / "a.exr"
    with replacing(target) as temporary:
        assert temporary.parent == target.parent and temporary.suffix == ".exr"
        assert not target.exists()
        temporary.write_bytes(b"whole")
    assert target.read_bytes() == b"whole"
    assert files_in(tmp_path) == {"new/a.exr"}


def test_what_a_killed_process_left_is_removed_and_nothing_else(tmp_path):
    target = tmp_path / "0001_light.exr"
    code = f"import os, stage.files\nwith stage.files.replacing({str(target)!r}) as path:\n os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=False)
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".0001_light.")
    kept = {"0001_light.exr", ".gitignore", ".hidden.exr", ".user.settings.json", "a.b12345678.exr"}
    for name in kept:
        (tmp_path / name).touch()
    with folder_beside(tmp_path / "other") as folder:
        assert not left.exists()  # and what is in use stays, also for another process
        subprocess.run([sys.executable, "-c", f"import stage.files\nstage.files.write_text({str(target)!r}, 'x')"], cwd=ROOT,
                       env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True)
        assert folder.is_dir()
    assert {path.name for path in tmp_path.iterdir()} == kept


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, OSError])
def test_an_error_keeps_the_old_file_and_leaves_nothing(tmp_path, error):
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises((error, StorageError)), replacing(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old"
    assert files_in(tmp_path) == {"a.txt"}


@pytest.mark.parametrize("flush", [True, False])
def test_only_what_can_be_made_again_does_not_wait_for_the_disk(tmp_path, monkeypatch, flush):
    waited = []
    monkeypatch.setattr(os, "fsync", waited.append)
    with replacing(tmp_path / "a.txt", flush=flush) as temporary:
        temporary.write_text("whole")
    assert (tmp_path / "a.txt").read_text() == "whole" and len(waited) == flush


def test_a_folder_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("")
    target = tmp_path / "file" / "below.txt"
    with pytest.raises(StorageError) as caught:
        write_text(target, "x")
    assert str(caught.value) in {f"cannot write {target}: {reason}" for reason in ("not a directory", "file exists")}


def test_text_is_utf8(tmp_path):
    write_text(tmp_path / "a.txt", "ρ")
    assert (tmp_path / "a.txt").read_bytes() == "ρ".encode()


def test_threads_that_write_together_leave_the_umask_alone(tmp_path):
    before = os.umask(0o027)
    try:
        with ThreadPoolExecutor(8) as pool:
            list(pool.map(lambda number: write_text(tmp_path / f"{number}.txt", "x"), range(200)))
        after = os.umask(0o027)
    finally:
        os.umask(before)
    assert after == 0o027
    assert {stat.S_IMODE(path.stat().st_mode) for path in tmp_path.iterdir()} == {0o640}


def test_a_folder_takes_the_place_of_another_whole(tmp_path):
    target = tmp_path / "a"
    write_text(target / "old.txt", "old")
    with replacing_folder(target) as folder:
        assert folder != target and folder.is_dir() and not list(folder.iterdir())
        write_text(folder / "new.txt", "new")
        assert files_in(target) == {"old.txt"}
    assert files_in(tmp_path) == {"a/new.txt"} and stat.S_IMODE(target.stat().st_mode) & stat.S_IRWXU == stat.S_IRWXU
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, OSError])
def test_an_error_keeps_the_old_folder_and_leaves_nothing(tmp_path, monkeypatch, error):
    target = tmp_path / "a"
    write_text(target / "old.txt", "old")
    with pytest.raises((error, StorageError)), replacing_folder(target) as folder:
        write_text(folder / "half.txt", "half")
        raise error
    rename = os.rename

    def fails(source, destination):
        if destination == target and source.name == "made":
            raise error
        rename(source, destination)

    monkeypatch.setattr(os, "rename", fails)  # the older one has been moved away by then
    with pytest.raises((error, StorageError)), replacing_folder(target) as folder:
        write_text(folder / "half.txt", "half")
    assert files_in(target) == {"old.txt"} and [path.name for path in tmp_path.iterdir()] == ["a"]
