"""How a worker does a job when the database does not answer, or something goes wrong that nobody thought of."""

import pytest
from sqlalchemy.exc import OperationalError

from service.requests.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.server.jobs import workflow
from service.server.jobs.steps import Site, Step
from service.server.jobs.workflow import DONE, STOPPED, Desk
from service.server.storage.open import open_storage
from service.server.store import jobs
from service.server.store.jobs import Claim

NO_ANSWER = OperationalError("SELECT 1", {}, Exception("the server is away"))
NAMES = ["frames 1-5", "frames 6-10"]


@pytest.fixture
def desk(still_yard, monkeypatch):
    """A worker `one` that has taken a job of two steps."""
    monkeypatch.setattr(workflow, "FIRST_PAUSE_S", 0.0)
    site = Site(still_yard.database, open_storage(still_yard.settings), still_yard.settings.data / "cache", "cpu", 1, ())
    made = Desk(site, still_yard.queue, "one", alive=lambda oldest: None)
    job = still_yard.relight(new_id(CAPTURE), new_id(ENVIRONMENT), 10, chunk_frames=5)
    still_yard.take(job, "one")
    return made, Claim(job, 1, "one")


def once(error, then):
    """A function that raises at its first call."""
    errors = [error]

    def call(*arguments, **options):
        if errors:
            raise errors.pop()
        return then(*arguments, **options)

    return call


def do_nothing(monkeypatch, run=lambda progress: None):
    monkeypatch.setattr(workflow, "steps_of", lambda job, site: [Step(name, run) for name in NAMES])


def test_a_job_is_done_step_by_step(still_yard, desk, monkeypatch):
    made, claim = desk
    do_nothing(monkeypatch)
    assert made._run(claim, lambda name: made._step(claim, name)) == DONE
    row = still_yard.row(claim.job)
    assert (row["state"], row["finished_steps"]) == (jobs.SUCCEEDED, NAMES)


@pytest.mark.parametrize("function", ["begin", "find", "is_wanted", "finish_step", "end"])
def test_a_database_that_is_away_for_a_moment_is_waited_for(still_yard, desk, monkeypatch, function):
    made, claim = desk
    do_nothing(monkeypatch)
    monkeypatch.setattr(workflow.jobs, function, once(NO_ANSWER, getattr(jobs, function)))
    outcome = made._run(claim, lambda name: made._step(claim, name))
    if function == "end":  # all is done, and whoever takes it next has only to say so
        assert (outcome, still_yard.row(claim.job)["state"]) == (STOPPED, jobs.QUEUED)
    else:
        assert (outcome, still_yard.row(claim.job)["state"]) == (DONE, jobs.SUCCEEDED)
    assert still_yard.row(claim.job)["finished_steps"] == NAMES


def test_a_job_whose_step_the_queue_could_not_record_goes_back(still_yard, desk, monkeypatch):
    made, claim = desk
    do_nothing(monkeypatch)

    def step(name):
        made._step(claim, name)
        raise NO_ANSWER

    assert made._run(claim, step) == STOPPED
    row = still_yard.row(claim.job)
    assert (row["state"], row["worker"], row["finished_steps"]) == (jobs.QUEUED, None, NAMES[:1])
    assert still_yard.in_queue(claim.job) == ("ENQUEUED", "work")


def test_an_error_of_the_queue_ends_the_job_with_a_sentence(still_yard, desk, monkeypatch):
    made, claim = desk
    do_nothing(monkeypatch)

    def step(name):
        raise RuntimeError("of another's making")

    assert made._run(claim, step) == jobs.FAILED
    row = still_yard.row(claim.job)
    assert (row["state"], row["error"]) == (jobs.FAILED, "an error of relit itself (RuntimeError): its log has more")


def test_a_worker_that_was_given_up_for_dead_publishes_nothing(still_yard, desk, monkeypatch):
    made, claim = desk

    def lose(progress):
        still_yard.database.transact(lambda connection: jobs.lose_worker(connection, claim, 3, ""))

    do_nothing(monkeypatch, lose)
    monkeypatch.setattr(made._site.storage, "publish", lambda *_: pytest.fail("another may be writing there"))
    assert made._run(claim, lambda name: made._step(claim, name)) == STOPPED
    row = still_yard.row(claim.job)
    assert (row["state"], row["worker"], row["finished_steps"]) == (jobs.QUEUED, None, [])
