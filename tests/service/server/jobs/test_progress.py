"""What a step tells the store, what it does when the store does not answer or does not want it any more, and the pieces of shared jobs."""

import shutil
from contextlib import contextmanager

import pytest
import sqlalchemy as sa
from sqlalchemy.exc import OperationalError

from service.server.database import jobs
from service.server.database.engine import Database
from service.server.database.jobs import Claim
from service.server.jobs import progress
from service.server.jobs.context import Job
from service.server.jobs.pieces import JobPieces
from service.server.jobs.progress import JobProgress, Stopped
from service.server.storage import layout
from stage.errors import StorageError
from stage.files import replacing
from tests.service.server.jobs.harness import harness


@pytest.fixture
def claim(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "EVERY_S", 0.0)
    monkeypatch.setattr(progress, "UNANSWERED_S", 0.0)
    with harness(tmp_path) as made:
        job = made.two_steps()
        claim = Claim(job, 1, "one")
        jobs.begin(made.database, claim)
        yield made, claim


def told(made, claim):
    row = made.row(claim.job)
    return row["stage"], row["done"], row["total"]


def test_frames_are_counted_over_all_steps(claim):
    made, claim = claim
    step = JobProgress(made.database, claim, alive=lambda: None, frame_offset=5, frame_count=10)
    step.stage("open", 1)
    assert told(made, claim) == ("frames", 5, 10)
    step.advance(1)
    assert told(made, claim) == ("frames", 5, 10)  # of opening
    step.stage("frames", 5)
    step.advance(2)
    assert told(made, claim) == ("frames", 7, 10)
    step.stage("upload", 2)  # a chunk is not counted backwards while it is sent
    for done in (1, 2):
        step.advance(done)
        assert told(made, claim) == ("frames", 7, 10)


def test_the_first_new_frame_after_a_lost_worker_is_told_at_once(claim, monkeypatch):
    made, claim = claim
    monkeypatch.setattr(progress, "EVERY_S", 3600.0)
    step = JobProgress(made.database, claim, alive=lambda: None, frame_count=10, begun=["begin", "open", "frames"], reached=2)
    step.begin("frames")
    step.stage("frames", 10)
    step.advance(2)
    assert told(made, claim) == ("frames", 0, 10)  # two frames were there
    step.advance(3)
    assert told(made, claim) == ("frames", 3, 10)
    step.advance(4)
    assert told(made, claim) == ("frames", 3, 10)


def test_a_worker_that_takes_over_shows_no_fewer_frames(claim):
    """It opens the capture again and looks at the frames that are there: the user sees neither nought nor another stage."""
    made, claim = claim
    JobProgress(made.database, claim, alive=lambda: None, frame_count=10).stage("frames", 5)
    step = JobProgress(made.database, claim, alive=lambda: None, frame_count=10)
    step.stage("frames", 5)
    step.advance(4)
    again = JobProgress(made.database, claim, alive=lambda: None, frame_count=10, shown=made.row(claim.job)["reached"])
    again.begin("frames")
    assert told(made, claim) == ("frames", 4, 10)
    again.stage("open", 3)
    again.advance(2)
    assert told(made, claim) == ("frames", 4, 10)
    again.stage("frames", 5)
    for done, shown in ((1, 4), (4, 4), (5, 5)):
        again.advance(done)
        assert told(made, claim) == ("frames", shown, 10)


def test_a_database_that_does_not_answer_does_not_end_the_step(claim):
    made, claim = claim
    signs = []
    gone = Database(sa.create_engine(f"sqlite:///{made.folder / 'nowhere' / 'relit.sqlite'}"))
    with pytest.raises(OperationalError):
        jobs.is_claimed(gone, claim)
    step = JobProgress(gone, claim, alive=lambda: signs.append(1), frame_count=10)
    step.stage("frames", 10)
    step.advance(3)
    assert len(signs) == 2  # the deadline is renewed all the same


@pytest.mark.parametrize("end", ["cancel", "another"])
def test_a_step_that_is_not_wanted_stops_and_stays_so(claim, end):
    made, claim = claim
    step = JobProgress(made.database, claim, alive=lambda: None, frame_count=10)
    step.stage("frames", 10)
    if end == "cancel":
        made.database.transact(lambda connection: jobs.cancel(connection, claim.job))
    else:
        made.database.transact(lambda connection: jobs.record_lost_worker(connection, claim, 3))
        jobs.begin(made.database, Claim(claim.job, 1, "two"))
    before = dict(made.row(claim.job))
    for done in (1, 2):
        with pytest.raises(Stopped):
            step.advance(done)
    assert dict(made.row(claim.job)) == before


@pytest.fixture
def running(idle_harness, monkeypatch):
    """The pieces of a job that another worker does; the folder of a piece is deleted while it is written."""
    job = idle_harness.two_steps()
    idle_harness.claim(job, "one")

    @contextmanager
    def in_a_folder_that_goes(file):
        with replacing(file) as temporary:
            shutil.rmtree(file.parent)
            yield temporary

    monkeypatch.setattr("service.server.jobs.pieces.replacing", in_a_folder_that_goes)
    return JobPieces(idle_harness.context(), Job.of(dict(idle_harness.row(job)))), job


def test_a_piece_of_a_job_that_was_cancelled_meanwhile_is_no_fault(idle_harness, running):
    pieces, job = running
    idle_harness.database.transact(lambda connection: jobs.cancel(connection, job))
    with pytest.raises(Stopped):
        pieces.write("band/00001", b"content")
    assert not (idle_harness.settings.data / layout.shared(idle_harness.row(job)["project"], job)).exists()


def test_a_piece_of_a_running_job_that_cannot_be_written_is_one(running):
    with pytest.raises(StorageError, match="cannot write"):
        running[0].write("band/00001", b"content")
