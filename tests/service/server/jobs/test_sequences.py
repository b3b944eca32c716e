"""Jobs of sequences: each time step is a step of the job, whichever worker does it, and the results are those of the commands."""

import os
import signal

import numpy as np
import pytest

from service.requests.base.base import SequenceOptions
from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import DepthJob, SolveJob
from service.requests.solve import SolveOptions, SolveRequest
from service.sequences import steps
from service.sequences.run import solve_sequence
from service.server.base.settings import Settings
from service.server.database import jobs
from service.server.jobs.context import Job, WorkerContext
from service.server.jobs.steps import steps_of
from stage.errors import ManifestError
from tests.scenes.captures import files_in
from tests.scenes.sequence import LIGHTS, moment, write_step
from tests.service.recording import Recording
from tests.service.server.jobs.harness import PROJECT, do_step, harness

STEPS = 4


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    """A sequence whose lights are a tenth off, so that a step needs what the first has found."""
    folder = tmp_path_factory.mktemp("registered") / "capture"
    off = np.exp(0.1 * np.random.default_rng(5).normal(size=LIGHTS))
    for step in range(STEPS):
        write_step(folder / f"step{step:02d}", moment(None, size=24), seed=step, noise=0.005, brightness=off)
    return folder


def maps_in(folder) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in files_in(folder) if name.endswith(".exr")}


@pytest.fixture(scope="module")
def undisturbed(sequence, tmp_path_factory) -> dict[str, bytes]:
    """The maps of `relit solve`."""
    out = tmp_path_factory.mktemp("undisturbed")
    solve_sequence(SolveRequest(capture=sequence, out=out, method="robust", device="cpu", cache=out / ".cache"))
    return maps_in(out)


def solve_of(harness, sequence, **options) -> Job:
    capture = harness.register(sequence, CAPTURE, captures=STEPS, steps=STEPS)
    request = SolveJob(kind="solve", capture=capture, options=SolveOptions(method="robust"), sequence=SequenceOptions(**options))
    return Job(new_id("job"), PROJECT, request, 1)


def run(job: Job, context: WorkerContext, name: str) -> None:
    """What the worker does in a step."""
    do_step(job, context, name)
    context.storage.publish(f"projects/{PROJECT}/jobs/{job.id}", Recording())


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.long
def test_machines_that_share_a_store_do_the_steps_in_turn(idle_harness, sequence, undisturbed, tmp_path, monkeypatch):
    """Each finds what the other has left in the store, and joins without solving again."""
    job = solve_of(idle_harness, sequence)
    contexts = [idle_harness.context(Settings(data=tmp_path / name, storage_url=f"file://{tmp_path}/store"), roots=(sequence.parent,))
                for name in ("one", "other")]
    names = [step.name for step in steps_of(job, contexts[0])]
    assert names == [*(f"step {number}" for number in range(1, STEPS + 1)), "sequence"]
    solved, whole = [], steps.solve
    monkeypatch.setattr(steps, "solve", lambda request, *args, **options: (solved.append(request.capture.name),
                                                                           whole(request, *args, **options)))
    for number, name in enumerate(names):
        run(job, contexts[number % 2], name)
    assert solved == [f"step{step:02d}" for step in range(STEPS)]
    store = tmp_path / "store" / "projects" / PROJECT / "jobs" / job.id
    assert maps_in(store) == undisturbed
    assert {"sequence.json", "report.json", "step03/report.json", "step03/alone/report.json"} <= files_in(store)
    assert str(tmp_path).encode() not in (store / "step03" / "alone" / "report.json").read_bytes()


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_sequence_that_has_lost_steps_is_one_sentence(idle_harness, sequence):
    capture = idle_harness.register(sequence, CAPTURE, captures=STEPS + 1, steps=STEPS + 1)
    job = Job(new_id("job"), PROJECT, DepthJob(kind="depth", capture=capture), 1)
    with pytest.raises(ManifestError, match="has 4 steps now, and had more when it was checked"):
        run(job, idle_harness.context(roots=(sequence.parent,)), f"step {STEPS + 1}")


@pytest.mark.long
def test_a_killed_worker_loses_one_time_step_at_most(tmp_path, sequence, undisturbed):
    """The next goes on with the time step that was under way, and the log names each."""
    with harness(tmp_path, takeover_s=0.5, roots=str(sequence.parent)) as made:
        made.start()
        made.ready(1)
        job = made.submit(solve_of(made, sequence).request, chunk_frames=1)
        made.until(lambda: made.row(job)["finished_steps"], "a step", every_s=0.005)
        first = (made.results(job) / "step00" / "alone" / "maps.exr").stat()
        os.kill(made.pid_of(made.holder(job)), signal.SIGKILL)
        row = made.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
        assert row["finished_steps"] == [*(f"step {number}" for number in range(1, STEPS + 1)), "sequence"]
        assert maps_in(made.results(job)) == undisturbed
        assert (made.results(job) / "step00" / "alone" / "maps.exr").stat().st_ino == first.st_ino
        begun = [event["step"] for event in made.events() if event["event"] == "step begins" and event["job"] == job]
        assert begun.count("step 1") == 1 and len(begun) <= STEPS + 2
        assert {f"{number}/{STEPS} ingest, {LIGHTS} to do" for number in range(1, STEPS + 1)} <= {
            entry["text"] for entry in jobs.log_of(made.database, job)}
