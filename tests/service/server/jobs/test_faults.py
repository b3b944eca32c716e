"""What may happen to workers: they are killed, the database restarts, a step hangs, a job kills whoever takes it, they are asked to end,
the disk is full. benchmarks/service_faults.py does the same at full size."""

import errno
import os
import random
import signal
import subprocess
from pathlib import Path

import pytest

from service.server.database import jobs, workers
from tests.service.server.jobs.harness import PROJECT, digests, harness

pytestmark = pytest.mark.long


def frames_there(made, job, count):
    made.until(lambda: made.frames_there(job) >= count, f"{count} frames", every_s=0.002)


def test_restarts_of_postgresql_cost_nothing(tmp_path, server_postgres, on_postgres, undisturbed):
    with harness(tmp_path, on_postgres, takeover_s=0.5) as made:
        for _ in range(2):
            made.start("slow")
        there = {row["id"] for row in made.ready(2)}
        job = made.begin(undisturbed, chunk_frames=6)
        for frames, mode, away_s in ((4, "fast", 0.0), (13, "immediate", 0.0), (22, "fast", 3.0)):
            frames_there(made, job, frames)
            server_postgres.restart(mode, away_s=away_s)
        assert made.made_whole(job, undisturbed)["lost"] == 0
        made.never_two_at_once(job)
        assert {row["id"] for row in made.ready(2)} == there
        assert [event for event in made.events() if event["event"] in ("worker died", "worker is gone")] == []


@pytest.mark.parametrize("how", ["stopped", "in a step"])
def test_a_worker_that_hangs_is_killed_and_its_job_taken_over(tmp_path, undisturbed, how):
    with harness(tmp_path, stall_s=10, takeover_s=0.5) as made:  # a worker on a loaded machine takes some seconds to begin
        made.start(None if how == "stopped" else "hang")
        made.ready(1)
        job = made.begin(undisturbed)
        victim = made.holder(job)
        if how == "stopped":
            frames_there(made, job, 1)
            victim = made.holder(job)  # on a slow machine the first may have been taken for a worker that hangs
            os.kill(made.pid_of(victim), signal.SIGSTOP)  # the worker in its place will be a good one
        else:
            made.start()
        assert made.made_whole(job, undisturbed)["worker"] != victim
        assert any(event["event"] == "worker hangs: it is killed" for event in made.events())


def test_a_worker_that_is_asked_to_end_finishes_its_step_and_hands_the_job_back(tmp_path, on_postgres, undisturbed):
    with harness(tmp_path, on_postgres) as made:
        worker = made.start("slow")
        made.ready(1)
        job = made.begin(undisturbed, chunk_frames=12)
        frames_there(made, job, 14)  # in the second step, a second before its end
        worker.send_signal(signal.SIGTERM)
        assert worker.wait(60) == 0
        row = made.row(job)
        assert (row["state"], row["worker"], row["lost"]) == (jobs.QUEUED, None, 0)
        assert row["finished_steps"] == ["frames 1-12", "frames 13-24"]
        assert len(digests(made.results(job))) == 24
        assert workers.seen_lately(made.database) == []
        made.start()
        made.made_whole(job, undisturbed)


def test_a_job_that_kills_its_workers_fails_with_a_sentence(tmp_path, undisturbed):
    with harness(tmp_path, max_lost=1, takeover_s=0.2) as made:
        made.start("kill")
        job = made.begin(undisturbed)
        row = made.ended(job)
        assert (row["state"], row["lost"]) == (jobs.FAILED, 2)
        assert row["error"].startswith("lost 2 workers without progress (frames): ")
        assert [event["again_in_s"] for event in made.events() if event["event"] == "worker is gone"] == [0.0, 0.0]  # they had been ready


@pytest.fixture
def small_disk(tmp_path):
    """A file system of some megabytes."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode != 0:
        pytest.skip("a small file system is mounted by root alone")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", folder], check=True)


def fill(folder: Path, *, leave: int) -> Path:
    """Take the space of a file system but for some bytes; with none left, what others free or take meanwhile does not matter."""
    ballast = folder / "ballast"
    free = os.statvfs(folder)
    with ballast.open("wb", buffering=0) as file:
        try:
            file.write(bytes(free.f_bavail * free.f_frsize - leave))
            while leave == 0:
                file.write(bytes(4096))
        except OSError as error:  # others write to it, so that less is free than was said
            if leave or error.errno != errno.ENOSPC:
                raise
    return ballast


def test_a_job_on_a_full_disk_fails_with_a_sentence_and_goes_on_when_there_is_space(small_disk, tmp_path, on_postgres, undisturbed):
    with harness(small_disk, on_postgres, roots=str(undisturbed.capture.parent), min_free_bytes="0") as made:
        made.log = tmp_path / "log.txt"
        made.start()
        made.ready(1)
        ballast = fill(small_disk, leave=3_500_000)  # the stack of images, and some frames
        job = made.begin(undisturbed)
        row = made.ended(job)
        assert row["state"] == jobs.FAILED
        assert row["error"].startswith("cannot write ") and "no space left" in row["error"].lower()
        there = digests(made.results(job))
        assert 0 < len(there) < undisturbed.frames
        assert there.items() <= undisturbed.digests.items()  # nothing half-written, hidden neither
        ballast.unlink()
        attempt = made.database.transact(lambda connection: jobs.queue_again(connection, job, jobs.FAILED))
        assert attempt == 2
        request = made.request(job)
        made.database.transact(lambda connection: made.queue.enqueue(connection, job, attempt, request, request.priority, PROJECT))
        made.made_whole(job, undisturbed)


WORKERS = 2


@pytest.mark.parametrize(("database_url", "kills"), [
    ("sqlite", 1), pytest.param("postgresql", 3, marks=pytest.mark.long),
], indirect=["database_url"])
def test_every_frame_is_there_once_and_as_undisturbed(tmp_path, database_url, kills, undisturbed):
    seed = random.randrange(2**32)
    print(f"seed {seed}")
    chance = random.Random(seed)
    with harness(tmp_path, database_url, takeover_s=0.5) as made:
        for _ in range(WORKERS):
            made.start()
        made.ready(WORKERS)
        job = made.begin(undisturbed)
        kill_at = sorted(chance.sample(range(undisturbed.frames // 2), kills))  # frames that are there
        victim = None
        for kill, frames in enumerate(kill_at):
            frames_there(made, job, frames)
            victim = made.holder(job, other_than=victim)
            pid = made.pid_of(victim)
            if kill % 2:  # with the process that looks after it, as a machine dies
                supervisor = next(process for process in made.supervisors if os.getpgid(pid) == process.pid)
                os.killpg(supervisor.pid, signal.SIGKILL)
                supervisor.wait()
                made.start()
            else:
                os.kill(pid, signal.SIGKILL)
        assert made.made_whole(job, undisturbed)["worker"] != victim
        made.never_two_at_once(job)
