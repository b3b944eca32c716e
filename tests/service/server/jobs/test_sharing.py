"""One job by several workers: the same files as those of one, whoever is killed, and nothing left behind."""

import os
import signal
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT
from service.requests.jobs import SolveJob
from service.requests.solve import SolveOptions, SolveRequest
from service.server.database import jobs, workers
from service.server.jobs.queue import workflow_id
from service.server.storage import layout
from service.solve.base import batches
from service.solve.solve import solve
from stage.stack import stack
from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.service.server.jobs.harness import PROJECT, begun, digests, harness, no_pieces, relit_relight, shared
from tests.service.server_process import SABOTAGE

pytestmark = pytest.mark.long

WORKERS = 2
FRAMES = 12
PIECE_S = 0.1
"""Seconds that each piece takes more, so that neither worker does all that is left when both have begun."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    return write_capture(tmp_path_factory.mktemp("registered") / "capture", make_scene(size=32, lights=9))


@pytest.fixture(scope="module")
def alone(capture, tmp_path_factory) -> Callable[[str], bytes]:
    """What `relit solve` makes of the same pieces, by the method."""

    @cache
    def maps(method: str) -> bytes:
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(stack, "BAND_BYTES", 1 << 14)
            patched.setattr(batches, "BATCH_BYTES", 1 << 15)
            out = tmp_path_factory.mktemp("alone")
            return solve(SolveRequest(capture=capture, method=method, out=out, device="cpu")).maps_path.read_bytes()

    return maps


@pytest.fixture(scope="module")
def pair(capture, tmp_path_factory):
    """A service with two workers, which serve one test after the other."""
    with harness(tmp_path_factory.mktemp("service"), log_level="debug", takeover_s=0.5, roots=str(capture.parent)) as made:
        start(made)
        yield made


@pytest.fixture
def both(pair):
    """The two workers at the beginning of a test; the first piece of each job waits for both."""
    pair.until(lambda: sum(pair.is_alive(row["id"]) for row in workers.seen_lately(pair.database)) == WORKERS, "two workers there")
    return pair


def start(made) -> None:
    for _ in range(WORKERS):
        made.start(PYTHONPATH=SABOTAGE, PIECES=str(PIECE_S), TOGETHER=str(together(made)))
    made.ready(WORKERS)


def together(made) -> Path:
    """The folder in which each worker leaves a file, in a folder of the job, when it has begun a piece."""
    return made.folder / "together"


def begin(made, capture: Path, method: str) -> str:
    return made.submit(SolveJob(kind="solve", capture=made.register(capture, CAPTURE), options=SolveOptions(method=method)), chunk_frames=8)


def both_at_work(made, job: str) -> tuple[str, str]:
    """The worker that has the job, and the one that helps, when each has begun a piece and neither waits for the other any more."""
    made.until(lambda: len(begun(made, job)) == WORKERS == len(list((together(made) / job).glob("*"))), "shared", every_s=0.05)
    holder = made.holder(job)
    return holder, next(worker for worker in begun(made, job) if worker != holder)


def events_of(made, job: str, *names: str) -> list[str]:
    """Those of some events of a job that have been, in their order."""
    return [event["event"] for event in made.events() if event.get("job") == job and event["event"] in names]


def made_by_both(made, job: str, expected: bytes) -> None:
    """Wait for a solve that two workers share."""
    row = shared(made, job, WORKERS)
    assert row["done"] == row["total"] and (made.results(job) / layout.MAPS).read_bytes() == expected
    made.until(lambda: events_of(made, job, "help done", "help stopped"), "helped")


def test_two_workers_make_the_same_maps_as_one(both, capture, alone):
    made_by_both(both, begin(both, capture, "lambert"), alone("lambert"))


def test_two_workers_make_the_same_maps_as_one_on_postgresql(tmp_path, on_postgres, capture, alone):
    with harness(tmp_path, on_postgres, log_level="debug", roots=str(capture.parent)) as made:
        start(made)
        made_by_both(made, begin(made, capture, "lambert"), alone("lambert"))


@pytest.mark.parametrize("whom", ["who helps", "who has the job"])
def test_the_pieces_of_a_killed_worker_are_done_by_another(both, capture, alone, whom):
    job = begin(both, capture, "svbrdf")
    holder, helper = both_at_work(both, job)
    victim = holder if whom == "who has the job" else helper
    done = {path.name for path in (both.settings.data / layout.shared(PROJECT, job)).rglob("*") if path.is_file()}
    os.kill(both.pid_of(victim), signal.SIGKILL)
    row = both.ended(job)
    assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
    assert (row["worker"] == holder) == (whom == "who helps")
    assert done and (both.results(job) / layout.MAPS).read_bytes() == alone("svbrdf")
    no_pieces(both, job)
    later = [event["worker"] for event in both.events() if event["event"] == "piece begins" and event["job"] == job]
    assert later[-1] != victim


def test_a_cancelled_solve_ends_at_both_workers_and_leaves_nothing(both, capture):
    job = begin(both, capture, "svbrdf")
    both_at_work(both, job)
    assert both.database.transact(lambda connection: jobs.cancel(connection, job))
    both.queue.cancel(workflow_id(job, 1))
    both.until(lambda: {"step stopped", "help stopped"} <= set(events_of(both, job, "step stopped", "help stopped")), "stopped")
    no_pieces(both, job)
    assert both.row(job)["state"] == jobs.CANCELLED
    other = begin(both, capture, "lambert")  # both are free again
    assert both.ended(other)["state"] == jobs.SUCCEEDED
    both.until(lambda: len(begun(both, other)) == WORKERS, "shared")


def test_a_small_solve_is_not_shared(both, capture):
    """It has one piece a pass."""
    small = write_capture(capture.parent / "small", make_scene(size=4, lights=9))
    job = begin(both, small, "svbrdf")
    assert both.ended(job)["state"] == jobs.SUCCEEDED
    assert begun(both, job) == {} and events_of(both, job, "help begins") == []


def test_frames_are_made_by_both_workers(both, capture, tmp_path):
    sky = write_exr(capture.parent / "sky.exr", np.random.default_rng(7).random((16, 32, 3)))
    expected = relit_relight(capture, sky, FRAMES, tmp_path / "expected")
    job = both.relight(both.register(capture, CAPTURE), both.register(sky, ENVIRONMENT), FRAMES, chunk_frames=2)
    row = shared(both, job, WORKERS)
    assert (row["done"], row["total"]) == (FRAMES, FRAMES)
    assert sorted(row["finished_steps"]) == sorted(f"frames {first}-{first + 1}" for first in range(1, FRAMES, 2))
    pieces = {piece for share in begun(both, job).values() for piece in share}  # one that a worker is long at is begun by the other too
    assert pieces == {f"steps/{step}" for step in row["finished_steps"]}
    assert digests(both.results(job)) == expected
