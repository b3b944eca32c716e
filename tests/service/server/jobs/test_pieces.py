"""Pieces that a worker stores while their job ends and its files are deleted."""

import shutil
from contextlib import contextmanager

import pytest

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.server.database import jobs
from service.server.database.jobs import Claim
from service.server.jobs.context import Job, WorkerContext
from service.server.jobs.pieces import JobPieces
from service.server.jobs.progress import Stopped
from service.server.storage import layout
from service.server.storage.objects import open_storage
from stage.errors import StorageError
from stage.files import replacing


@pytest.fixture
def running(idle_harness, monkeypatch):
    """The pieces of a job that another worker does; the folder of a piece is deleted while it is written."""
    job = idle_harness.relight(new_id(CAPTURE), new_id(ENVIRONMENT), 10, chunk_frames=5)
    idle_harness.take(job, "one")
    jobs.begin(idle_harness.database, Claim(job, 1, "one"))
    context = WorkerContext(idle_harness.database, open_storage(idle_harness.settings), idle_harness.settings.data / "cache", "cpu", 1,
                            idle_harness.settings.roots_of)

    @contextmanager
    def in_a_folder_that_goes(file):
        with replacing(file) as temporary:
            shutil.rmtree(file.parent)
            yield temporary

    monkeypatch.setattr("service.server.jobs.pieces.replacing", in_a_folder_that_goes)
    return JobPieces(context, Job.of(dict(idle_harness.row(job)))), job


def test_a_piece_of_a_job_that_was_cancelled_meanwhile_is_no_fault(idle_harness, running):
    pieces, job = running
    idle_harness.database.transact(lambda connection: jobs.cancel(connection, job))
    with pytest.raises(Stopped):
        pieces.write("band/00001", b"content")
    assert not (idle_harness.settings.data / layout.shared(idle_harness.row(job)["project"], job)).exists()


def test_a_piece_of_a_running_job_that_cannot_be_written_is_one(running):
    with pytest.raises(StorageError, match="cannot write"):
        running[0].write("band/00001", b"content")
