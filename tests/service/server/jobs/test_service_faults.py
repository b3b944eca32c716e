"""`relit serve` with a worker: killed, asked to end, without space; and what its processes are."""

import os
import signal
from pathlib import Path

import pytest

from service.server.database import jobs
from tests.service.server.api.job_calls import admitted, submit
from tests.service.server.jobs.harness import digests
from tests.service.server.jobs.test_faults import fill, small_disk  # noqa: F401  (a fixture)
from tests.service.server_process import Server, children_of, serving
from tests.service.waiting import until

pytestmark = pytest.mark.long

OPTIONS = ("--anonymous", "--device", "cpu")
SETTINGS = {"chunk_frames": "12"}


def begin(server: Server, client, undisturbed, *, frames: int | None = None) -> str:
    """A relight of the undisturbed capture: of so many frames, or of all."""
    capture = admitted(server, client, undisturbed.capture)["id"]
    sky = admitted(server, client, undisturbed.environment, kind="environments")["id"]
    return submit(client, kind="relight", capture=capture, environment=sky,
                  options={"frames": f"1-{frames or undisturbed.frames}", "spin_degrees": 360})["id"]


def results(server: Server, job: str) -> Path:
    return server.data / "projects" / "default" / "jobs" / job


def frames_there(server: Server, job: str, count: int) -> None:
    until(lambda: results(server, job).is_dir() and len(list(results(server, job).glob("frame.*"))) >= count, f"{count} frames")


def assert_workers_are_spawned(server: Server) -> None:
    """Check that the API has no Warp, and that its worker, which has done a job, is no fork of it."""
    commands = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode() for pid in children_of(server.process.pid)}
    for command in commands.values():  # a forked child would have its parent's
        assert "multiprocessing.spawn" in command or "multiprocessing.resource_tracker" in command
    [worker] = [pid for pid, command in commands.items() if "multiprocessing.spawn" in command]
    assert "/warp/" in Path(f"/proc/{worker}/maps").read_text()  # so that it would be seen
    assert "/warp/" not in Path(f"/proc/{server.process.pid}/maps").read_text()


def test_jobs_go_on_after_the_api_was_killed(tmp_path, undisturbed):
    """A worker ends after its step with the process that looks after it, and gives its job back."""
    settings = SETTINGS | {"roots": str(undisturbed.capture.parent)}
    with serving(tmp_path, *OPTIONS, sabotage="slow", **settings) as server, server.client() as client:
        job = begin(server, client, undisturbed)
        frames_there(server, job, 14)
        os.kill(server.process.pid, signal.SIGKILL)
        server.process.wait()
        until(lambda: "worker ended" in server.log.read_text(), "ended")  # after its step
        with server.database() as database:
            row = jobs.find(database, job)
        assert (row["state"], row["lost"], row["finished_steps"]) == (jobs.QUEUED, 0, ["frames 1-12", "frames 13-24"])
    with serving(tmp_path, *OPTIONS, sabotage="slow", **settings) as server, server.client() as client:
        assert server.wait(client, f"/v1/jobs/{job}", jobs.ENDED)["state"] == jobs.SUCCEEDED
        assert digests(results(server, job)) == undisturbed.digests
        assert_workers_are_spawned(server)


def test_the_service_stays_when_its_database_has_no_space(small_disk, undisturbed):  # noqa: F811
    (small_disk.parent / "data").symlink_to(small_disk)
    with (serving(small_disk.parent, *OPTIONS, **SETTINGS, roots=str(undisturbed.capture.parent)) as server, server.client() as client):
        job = begin(server, client, undisturbed, frames=2)
        assert server.wait(client, f"/v1/jobs/{job}", jobs.ENDED)["state"] == jobs.SUCCEEDED
        request = {"name": "x" * 200, "folder": str(undisturbed.capture)}
        ballast = fill(small_disk, leave=0)
        statuses = [client.post("/v1/captures", json=request).status_code for _ in range(20)]
        assert set(statuses) <= {201, 202, 503, 507}  # the journal may have had room for some
        assert statuses[-1] in (503, 507)
        assert client.get(f"/v1/jobs/{job}").json()["state"] == jobs.SUCCEEDED
        ballast.unlink()
        until(lambda: client.post("/v1/captures", json=request).is_success, "taken again")
        job = begin(server, client, undisturbed, frames=2)
        assert server.wait(client, f"/v1/jobs/{job}", jobs.ENDED)["state"] == jobs.SUCCEEDED
