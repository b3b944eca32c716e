"""SIGKILL of workers during a relight; benchmarks/service_faults.py does the same at full size."""

import os
import random
import signal

import pytest

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT
from service.server.database import jobs
from tests.service.server.jobs.harness import digests, harness

pytestmark = pytest.mark.long

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
        job = made.relight(made.register(undisturbed.capture, CAPTURE), made.register(undisturbed.environment, ENVIRONMENT),
                           undisturbed.frames, chunk_frames=8)
        kill_at = sorted(chance.sample(range(undisturbed.frames * 3 // 4), kills))  # frames that are there
        victim = None
        for kill, frames in enumerate(kill_at):
            made.until(lambda at=frames: made.frames_there(job) >= at, f"{frames} frames", every_s=0.002)
            victim = made.holder(job, other_than=victim)
            pid = made.pid_of(victim)
            if kill % 2:  # with the process that looks after it, as a machine dies
                supervisor = next(process for process in made.supervisors if os.getpgid(pid) == process.pid)
                os.killpg(supervisor.pid, signal.SIGKILL)
                supervisor.wait()
                made.start()
            else:
                os.kill(pid, signal.SIGKILL)
        row = made.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
        assert row["worker"] != victim
        assert digests(made.results(job)) == undisturbed.digests  # and no file besides, hidden ones neither
        made.never_two_at_once(job)
