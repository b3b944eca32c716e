"""One job by several workers: the same files as those of one, whoever is killed, and nothing left behind."""

import os
import shutil
import signal
from pathlib import Path

import pytest

from service.requests.identifiers import CAPTURE, ENVIRONMENT
from service.requests.jobs import SolveJob
from service.requests.solve import SolveOptions, SolveRequest
from service.server.database import jobs
from service.server.storage import layout
from service.solve import batches
from service.solve.solve import solve
from stage import stack
from tests.scenes.captures import make_scene, write_capture
from tests.service.server.jobs.harness import PROJECT, digests, harness
from tests.service.server.jobs.test_faults import SABOTAGE

WORKERS = 2
PIECE_S = {"lambert": 0.1, "svbrdf": 0.05}
"""Seconds that each piece takes more, so that neither worker does all that is left when both have begun."""


@pytest.fixture
def capture(tmp_path) -> Path:
    """A capture beside the folder of the service, as no root of captures may hold that."""
    return write_capture(tmp_path / "capture", make_scene(size=32, lights=9))


def maps_alone(capture: Path, method: str, out: Path, monkeypatch) -> bytes:
    """What `relit solve` makes of the same pieces."""
    monkeypatch.setattr(stack, "BAND_BYTES", 1 << 14)
    monkeypatch.setattr(batches, "BATCH_BYTES", 1 << 15)
    return solve(SolveRequest(capture=capture, method=method, out=out, device="cpu")).maps_path.read_bytes()


def start(made, method: str) -> None:
    for _ in range(WORKERS):
        made.start(PYTHONPATH=SABOTAGE, PIECES=str(PIECE_S[method]), TOGETHER=str(made.folder / "together"))
    made.ready(WORKERS)


def begin(made, capture: Path, method: str) -> str:
    return made.submit(SolveJob(kind="solve", capture=made.register(capture, CAPTURE), options=SolveOptions(method=method)), chunk_frames=8)


def pieces_folder(made, job: str) -> Path:
    return made.settings.data / layout.shared(PROJECT, job)


def begun(made, job: str) -> dict[str, list[str]]:
    """The pieces that each worker has begun, by the log."""
    found: dict[str, list[str]] = {}
    for event in made.events():
        if event["event"] == "piece begins" and event["job"] == job:
            found.setdefault(event["worker"], []).append(event["piece"])
    return found


def both_at_work(made, job: str) -> tuple[str, str]:
    """The worker that has the job, and the one that helps, when each has begun a piece."""
    made.until(lambda: len(begun(made, job)) == WORKERS, "shared")
    holder = made.holder(job)
    return holder, next(worker for worker in begun(made, job) if worker != holder)


@pytest.mark.parametrize(("method", "database_url"), [("lambert", "sqlite"), pytest.param("svbrdf", "postgresql", marks=pytest.mark.long)],
                         indirect=["database_url"])
def test_two_workers_make_the_same_maps_as_one(tmp_path, database_url, capture, monkeypatch, method):
    alone = maps_alone(capture, method, tmp_path / "alone", monkeypatch)
    with harness(tmp_path / "service", database_url, log_level="debug") as made:
        start(made, method)
        job = begin(made, capture, method)
        row = made.ended(job)
        assert (row["state"], row["error"], row["lost"]) == (jobs.SUCCEEDED, None, 0)
        assert row["done"] == row["total"]
        shares = begun(made, job)
        assert len(shares) == WORKERS
        pieces = [piece for share in shares.values() for piece in share]
        assert len(pieces) - len(set(pieces)) <= len(set(pieces)) // 4  # two that claim one at the same moment both do it
        assert (made.results(job) / layout.MAPS).read_bytes() == alone
        assert not pieces_folder(made, job).exists()
        made.until(lambda: any(event["event"] in ("help done", "help stopped") for event in made.events()), "helped")


@pytest.mark.long
@pytest.mark.parametrize("whom", ["who helps", "who has the job"])
def test_the_pieces_of_a_killed_worker_are_done_by_another(tmp_path, capture, monkeypatch, whom):
    alone = maps_alone(capture, "svbrdf", tmp_path / "alone", monkeypatch)
    with harness(tmp_path / "service", log_level="debug", takeover_s=0.5) as made:
        start(made, "svbrdf")
        job = begin(made, capture, "svbrdf")
        holder, helper = both_at_work(made, job)
        victim = holder if whom == "who has the job" else helper
        done = {path.name for path in pieces_folder(made, job).rglob("*") if path.is_file()}
        os.kill(made.pid_of(victim), signal.SIGKILL)
        row = made.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
        assert (row["worker"] == holder) == (whom == "who helps")
        assert done and (made.results(job) / layout.MAPS).read_bytes() == alone
        assert not pieces_folder(made, job).exists()
        later = [event["worker"] for event in made.events() if event["event"] == "piece begins" and event["job"] == job]
        assert later[-1] != victim


@pytest.mark.long
def test_a_cancelled_solve_ends_at_both_workers_and_leaves_nothing(tmp_path, capture):
    with harness(tmp_path / "service", log_level="debug") as made:
        start(made, "svbrdf")
        job = begin(made, capture, "svbrdf")
        both_at_work(made, job)
        assert made.database.transact(lambda connection: jobs.cancel(connection, job))
        made.queue.cancel(job, 1)
        made.until(lambda: {"step stopped", "help stopped"} <= {event["event"] for event in made.events()}, "stopped")
        made.until(lambda: not pieces_folder(made, job).exists(), "removed")
        assert made.row(job)["state"] == jobs.CANCELLED
        shutil.rmtree(made.folder / "together")  # the first piece waits for both once more
        other = begin(made, capture, "lambert")  # both are free again
        assert made.ended(other)["state"] == jobs.SUCCEEDED
        made.until(lambda: len(begun(made, other)) == WORKERS, "shared")


def test_a_small_solve_is_not_shared(tmp_path, capture):
    """It has one piece a pass."""
    with harness(tmp_path / "service", log_level="debug") as made:
        for _ in range(WORKERS):
            made.start()
        made.ready(WORKERS)
        job = begin(made, capture, "svbrdf")
        assert made.ended(job)["state"] == jobs.SUCCEEDED
        assert begun(made, job) == {} and "help begins" not in {event["event"] for event in made.events()}


def test_frames_are_made_by_both_workers(tmp_path, undisturbed):
    with harness(tmp_path, log_level="debug") as made:
        for _ in range(WORKERS):
            made.start(PYTHONPATH=SABOTAGE, SABOTAGE="slow")
        made.ready(WORKERS)
        job = made.relight(made.register(undisturbed.capture, CAPTURE), made.register(undisturbed.environment, ENVIRONMENT),
                           undisturbed.frames, chunk_frames=6)
        row = made.ended(job)
        assert (row["state"], row["error"], row["done"], row["total"]) == (jobs.SUCCEEDED, None, undisturbed.frames, undisturbed.frames)
        assert sorted(row["finished_steps"]) == sorted(f"frames {first}-{first + 5}" for first in range(1, undisturbed.frames, 6))
        shares = begun(made, job)
        assert len(shares) == WORKERS
        assert sorted(piece for share in shares.values() for piece in share) == sorted(f"steps/{step}" for step in row["finished_steps"])
        assert digests(made.results(job)) == undisturbed.digests
        assert not pieces_folder(made, job).exists()
