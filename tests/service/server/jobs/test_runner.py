"""How a worker does a job when the database does not answer, or something goes wrong that nobody thought of."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy.exc import OperationalError

from service import __version__
from service.server.database import jobs
from service.server.database.jobs import Claim
from service.server.jobs import runner as runner_module
from service.server.jobs.context import JobStep, without_places
from service.server.jobs.runner import DONE, STOPPED, JobRunner
from service.server.storage import layout
from service.server.storage.objects import open_storage
from stage.errors import StorageError
from stage.files import write_text
from tests.marks import first_short
from tests.service.server.jobs.harness import PROJECT

NO_ANSWER = OperationalError("SELECT 1", {}, Exception("the server is away"))
NAMES = ["frames 1-5", "frames 6-10"]


@pytest.fixture
def runner(idle_harness, monkeypatch):
    """A worker `one` that has taken a job of two steps."""
    monkeypatch.setattr(runner_module, "FIRST_PAUSE_S", 0.0)
    made = JobRunner(idle_harness.context(), "one", alive=lambda oldest: None)
    job = idle_harness.two_steps()
    idle_harness.take(job, "one")
    return made, Claim(job, 1, "one")


def once(error, then):
    """A function that raises at its first call."""
    errors = [error]

    def call(*arguments, **options):
        if errors:
            raise errors.pop()
        return then(*arguments, **options)

    return call


def do_nothing(monkeypatch, run=lambda files: None):
    monkeypatch.setattr(runner_module, "steps_of", lambda job, context: [JobStep(name, run) for name in NAMES])


@pytest.mark.parametrize("function", [None, *(
    pytest.param(name, marks=pytest.mark.long) for name in ("begin", "find", "is_claimed", "finish_step", "end"))])
def test_a_job_is_done_step_by_step_though_the_database_is_away_for_a_moment(idle_harness, runner, monkeypatch, function):
    made, claim = runner
    do_nothing(monkeypatch)
    if function is not None:
        monkeypatch.setattr(runner_module.jobs, function, once(NO_ANSWER, getattr(jobs, function)))
    assert (made.run(claim), idle_harness.row(claim.job)["state"]) == (DONE, jobs.SUCCEEDED)
    assert idle_harness.row(claim.job)["finished_steps"] == NAMES


def test_a_job_that_was_given_back_goes_on_with_the_steps_that_are_left(idle_harness, runner, monkeypatch):
    """DBOS starts the workflow from its beginning; the list of finished steps is the job's."""
    made, claim = runner
    begun = []
    monkeypatch.setattr(runner_module, "steps_of", lambda job, context: [
        JobStep(name, lambda files, name=name: begun.append(name)) for name in NAMES])
    jobs.begin(idle_harness.database, claim)
    jobs.finish_step(idle_harness.database, claim, NAMES[:1])
    assert made.run(claim) == DONE
    assert begun == NAMES[1:]


def test_a_sentence_of_a_job_names_files_as_their_user_does(idle_harness):
    folder, other = f"{idle_harness.context().settings.data}/projects/{PROJECT}/jobs", "job_00000000000000000000"
    told = without_places(f"{folder}/job_1/maps.exr: is no EXR; {folder}/{other}/depth.exr", "job_1", idle_harness.context())
    assert told == f"maps.exr: is no EXR; {other}/depth.exr"


@pytest.mark.parametrize(("error", "told"), [
    (RuntimeError("of another's making"), "an error of relit itself (RuntimeError)"),
    (RuntimeError("Failed to allocate 4096 bytes on device 'cpu'"), "the worker has too little memory"),
    (MemoryError(), "the worker has too little memory"),
])
@first_short("when", ["before the first step", "in a step"])
def test_an_unexpected_error_ends_the_job_with_a_sentence(idle_harness, runner, monkeypatch, error, told, when):
    made, claim = runner

    def fail(*_):
        raise error

    if when == "in a step":
        do_nothing(monkeypatch, fail)
    else:
        monkeypatch.setattr(runner_module, "steps_of", fail)
    assert made.run(claim) == jobs.FAILED
    row = idle_harness.row(claim.job)
    assert row["state"] == jobs.FAILED
    assert row["error"].startswith(told if when != "in a step" else f"{NAMES[0]}: {told}")


def test_a_job_that_another_version_began_is_made_anew(idle_harness, runner, monkeypatch):
    """So that its frames are all those of one version."""
    made, claim = runner
    with monkeypatch.context() as before:
        before.setattr(jobs, "__version__", "0.0.1")
        jobs.begin(idle_harness.database, claim)
        jobs.finish_step(idle_harness.database, claim, NAMES[:1])
    assert idle_harness.row(claim.job)["version"] == "0.0.1"
    done = []
    do_nothing(monkeypatch, done.append)
    assert made.run(claim) == DONE
    assert len(done) == 2
    row = idle_harness.row(claim.job)
    assert (row["finished_steps"], row["version"]) == (NAMES, __version__)
    assert any("another version" in entry["text"] for entry in jobs.log_of(idle_harness.database, claim.job))


def test_a_worker_that_was_given_up_for_dead_publishes_nothing(idle_harness, runner, monkeypatch):
    made, claim = runner

    def lose(files):
        idle_harness.database.transact(lambda connection: jobs.record_lost_worker(connection, claim, 3))

    do_nothing(monkeypatch, lose)
    monkeypatch.setattr(made._context.storage, "publish", lambda *_: pytest.fail("another may be writing there"))
    assert made.run(claim) == STOPPED
    row = idle_harness.row(claim.job)
    assert (row["state"], row["worker"], row["finished_steps"]) == (jobs.QUEUED, None, [])


@pytest.mark.long
@pytest.mark.parametrize("end", ["stopped", "done", "failed"])
def test_what_a_step_wrote_after_its_job_was_deleted_is_removed(idle_harness, runner, monkeypatch, end):
    """A writer that is under way makes the folder of the results again, as `stage.files.replacing` makes missing folders."""
    made, claim = runner
    folder = idle_harness.results(claim.job)

    def run(files):
        write_text(folder / "frame.0001.exr", "before")
        idle_harness.database.transact(lambda connection: jobs.cancel(connection, claim.job))
        idle_harness.database.transact(lambda connection: jobs.remove(connection, claim.job))
        open_storage(idle_harness.settings).remove(layout.results(PROJECT, claim.job))
        assert not folder.exists()
        write_text(folder / "frame.0002.exr", "after")
        if end == "stopped":
            monkeypatch.setattr(files.progress, "_record_at", 0.0)
            files.progress.advance(2)
        if end == "failed":
            raise StorageError("the disk is full")

    do_nothing(monkeypatch, run)
    assert made.run(claim) in (STOPPED, jobs.FAILED)
    assert not folder.exists()


def test_a_cancelled_step_ends_before_the_next_job_works_on_the_device(idle_harness, runner, monkeypatch):
    """The queue gives a worker the next job as soon as one is cancelled; two that capture graphs on one GPU would end the process."""
    made, first = runner
    second = Claim(idle_harness.two_steps(), 1, "one")
    idle_harness.take(second.job, "one")
    begun, cancelled, order = threading.Event(), threading.Event(), []

    def run(files):
        if not begun.is_set():
            begun.set()
            assert cancelled.wait(30)
            time.sleep(0.2)  # in which the other would begin
            order.append("first ends")
        else:
            order.append("second works")

    do_nothing(monkeypatch, run)
    with ThreadPoolExecutor(2) as pool:
        stopped = pool.submit(made.run, first)
        assert begun.wait(30)
        idle_harness.database.transact(lambda connection: jobs.cancel(connection, first.job))
        done = pool.submit(made.run, second)
        while idle_harness.row(second.job)["state"] != jobs.RUNNING:
            time.sleep(0.01)
        cancelled.set()
        assert (stopped.result(30), done.result(30)) == (STOPPED, DONE)
    assert order == ["first ends", "second works", "second works"]


def test_a_step_that_would_fill_the_disk_fails_with_a_sentence(runner, idle_harness, monkeypatch):
    """At its beginning, and while it goes on."""
    made, claim = runner
    settings = idle_harness.settings.model_copy(update={"min_free_bytes": 1 << 60})
    made._context = made._context._replace(settings=settings)
    do_nothing(monkeypatch, lambda files: pytest.fail("there is no space"))
    assert made.run(claim) == "failed"
    assert "no space left for this job (min_free_bytes)" in idle_harness.row(claim.job)["error"]
