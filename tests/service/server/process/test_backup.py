"""Backups that are made while a job runs, and services that are made from them."""

import json
import shutil

import pytest

from service.server.base.settings import Settings
from service.server.database import jobs
from service.server.process.backup import CONTENTS, backup, restore
from tests.service.recording import Recording, Stage
from tests.service.server.jobs.conftest import undisturbed  # noqa: F401  (a fixture)
from tests.service.server.jobs.harness import harness


@pytest.mark.long
@pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)
def test_a_job_that_ran_is_finished_by_the_restored_service(tmp_path, database_url, undisturbed, request):  # noqa: F811
    if database_url is not None and shutil.which("pg_dump") is None:
        pytest.skip("the client programs of PostgreSQL are not on the path")
    roots = str(undisturbed.capture.parent)
    with harness(tmp_path / "first", database_url, roots=roots) as made:
        made.start("slow", GATE=str(tmp_path / "gate"))  # so that the job runs as long as the backup
        job = made.begin(undisturbed, chunk_frames=6)
        made.until(lambda: made.frames_there(job) >= 8, "8 frames")
        saved = backup(made.settings, tmp_path / "saved")
        assert made.row(job)["state"] == jobs.RUNNING
        contents = json.loads((tmp_path / "saved" / CONTENTS).read_text())["files"]
        frames = [name for name in contents if name.endswith(".exr")]
        assert saved.files == len(contents) and 8 <= len(frames) < undisturbed.frames
        (tmp_path / "gate").touch()
        made.made_whole(job, undisturbed)  # the backup did not disturb it
    second = None if database_url is None else request.getfixturevalue("server_postgres").new_database()
    restore(Settings(data=tmp_path / "second" / "data", database_url=second), tmp_path / "saved")
    with harness(tmp_path / "second", second, takeover_s=0.5, roots=roots) as again:
        row = again.row(job)
        assert row["state"] == jobs.RUNNING and row["finished_steps"][:1] == ["frames 1-6"]
        kept = {path.name: path.stat().st_mtime_ns for path in again.results(job).iterdir()}
        assert len(kept) == len(frames)
        again.start()
        again.made_whole(job, undisturbed)
        assert {name: (again.results(job) / name).stat().st_mtime_ns for name in kept} == kept  # frames that were there stay


@pytest.fixture
def saved(tmp_path):
    """A backup of a service with one result."""
    with harness(tmp_path / "first") as made:
        folder = made.settings.data / "projects" / "larch" / "jobs" / "job_x"
        folder.mkdir(parents=True)
        (folder / "maps.exr").write_bytes(b"maps")
        (folder / ".maps.exr.part").write_bytes(b"ma")
        told = Recording()
        backup(made.settings, tmp_path / "saved", progress=told)
        assert Stage("projects", 1, [1]) in told.stages and not told.faults
    return tmp_path / "saved"


@pytest.mark.parametrize(("name", "content", "words"), [
    ("projects/larch/jobs/job_x/maps.exr", "mops", "maps.exr: is missing or differs from its checksum"),
    ("projects/larch/jobs/job_x/maps.exr", "map", "maps.exr: is missing or differs from its checksum"),
    ("projects/larch/jobs/job_x/maps.exr", None, "maps.exr: is missing or differs from its checksum"),
    (CONTENTS, None, "is no whole backup"),
    (CONTENTS, '{"schema": "relit.backup/1", "files": {"../x": {}}}', "../x leads out of the backup"),
], ids=["flip", "cut", "remove", "no contents", "contents"])
def test_a_damaged_backup_is_refused_and_nothing_is_made(relit, saved, tmp_path, name, content, words):
    (saved / name).unlink()
    if content is not None:
        (saved / name).write_text(content)
    relit("restore", saved, "--data", tmp_path / "second").refused(words)
    assert not (tmp_path / "second").exists()


def test_the_commands_say_what_they_did_and_neither_overwrite_nor_save_into_a_service(relit, saved, tmp_path):
    """What is being written is left out."""
    assert sorted(path.name for path in saved.rglob("*") if path.is_file()) == ["backup.json", "maps.exr", "relit.sqlite"]
    out = relit("restore", saved, "--data", tmp_path / "second").well()
    assert out.splitlines()[0] == f"data     {tmp_path / 'second'}"
    assert (tmp_path / "second/projects/larch/jobs/job_x/maps.exr").read_bytes() == b"maps"
    out = relit("backup", "--data", tmp_path / "second", "--out", tmp_path / "again").well()
    assert out.splitlines()[0] == f"backup   {tmp_path / 'again'}"
    data = tmp_path / "first" / "data"
    assert "there is a service in this folder already" in relit("restore", saved, "--data", data).err
    assert "is not empty: give a new folder" in relit("backup", "--out", saved, "--data", data).err
    assert "lies in the data folder" in relit("backup", "--out", data / "saved", "--data", data).err
    assert "there is no service in this folder" in relit("backup", "--out", tmp_path / "x", "--data", tmp_path / "nowhere").err
    assert not (tmp_path / "x").exists() and not (tmp_path / "nowhere").exists()
