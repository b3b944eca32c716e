"""A data folder with a database, jobs in it, and real worker processes (`relit worker`) that do them; no API between."""

import hashlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import sqlalchemy as sa
from dbos import DBOSClient, WorkflowStatus

from service.reporting.progress import Timings
from service.reporting.provenance import places_named
from service.requests.base.base import JobRequest
from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.requests.jobs import ANY_JOB, RelightJob
from service.requests.relight import RelightOptions
from service.server.base.settings import Settings
from service.server.database import intakes, jobs, workers
from service.server.database.engine import connect
from service.server.database.jobs import Claim
from service.server.jobs.context import Job, StepFiles, WorkerContext
from service.server.jobs.queue import JobQueue, workflow_id
from service.server.jobs.steps import steps_of
from service.server.storage import layout
from service.server.storage.objects import open_storage
from tests.service.server.prepared import prepare
from tests.service.server_process import SABOTAGE, JsonLog, environment_with
from tests.service.waiting import until

PROJECT = "tests"
CAPTURES = ("capture", "registered", "undisturbed")
"""How the names of folders with captures begin."""
WAIT_S = 120.0
"""Far beyond what anything takes here, so that a slow machine fails no test."""


class Undisturbed(NamedTuple):
    """What nobody disturbed."""

    capture: Path
    environment: Path
    frames: int
    digests: dict[str, str]


class Harness:
    """Where workers work."""

    def __init__(self, folder: Path, database_url: str | None, **settings: Any) -> None:
        self.folder = folder
        beside = [str(path) for path in folder.parent.iterdir() if path.is_dir() and path.name.startswith(CAPTURES)]
        settings = {"roots": os.pathsep.join(beside)} | settings  # captures lie beside, as no root may hold the data folder
        self.settings = Settings(data=folder / "data", database_url=database_url, **settings)
        self.database = connect(self.settings.sqlalchemy_url)
        prepare(self.settings, self.database)
        self.queue = JobQueue(self.database)
        self.log = folder / "log.txt"
        self.events = JsonLog(self.log, b"{").lines
        self._environment = environment_with(**settings, **({} if database_url is None else {"database_url": database_url}))
        self.supervisors: list[subprocess.Popen[bytes]] = []

    def context(self, settings: Settings | None = None, **changed: Any) -> WorkerContext:
        """What the steps of a worker in this process get, with some settings changed."""
        settings = (settings or self.settings).model_copy(update=changed)
        return WorkerContext(settings, self.database, open_storage(settings), self.queue, "cpu", "")

    def start(self, sabotage: str | None = None, **environment: str) -> subprocess.Popen[bytes]:
        """Another `relit worker`, in a process group of its own; what it does with frames, as sabotage/ tells."""
        if sabotage is not None:
            environment |= {"PYTHONPATH": SABOTAGE, "SABOTAGE": sabotage}
        with open(self.log, "ab") as log:
            process = subprocess.Popen(
                [sys.executable, "-m", "service.cli.main", "worker", "--device", "cpu", "--data", str(self.settings.data)],
                stdout=log, stderr=log, env=self._environment | environment, start_new_session=True)
        self.supervisors.append(process)
        return process

    def close(self) -> None:
        for process in self.supervisors:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
        self.database.close()

    def register(self, path: Path, kind: str, **facts: int) -> str:
        """A capture or an environment that needs no check, of which one found these facts."""
        identifier = self.database.transact(lambda connection: intakes.insert(
            connection, project=PROJECT, kind=kind, name=path.name, folder=path.resolve()))
        intakes.accept(self.database, identifier, facts)
        return identifier

    def submit(self, request: JobRequest, *, chunk_frames: int) -> str:
        return self.database.transact(lambda connection: self.queue.submit(
            connection, project=PROJECT, request=request, chunk_frames=chunk_frames))

    def relight(self, capture: str, environment: str, frames: int, *, chunk_frames: int) -> str:
        return self.submit(RelightJob(kind="relight", capture=capture, environment=environment,
                                      options=RelightOptions(frames=f"1-{frames}", spin_degrees=360)), chunk_frames=chunk_frames)

    def begin(self, undisturbed: Undisturbed, *, chunk_frames: int = 8) -> str:
        """Submit the job that makes the frames that nobody disturbed."""
        return self.relight(self.register(undisturbed.capture, CAPTURE), self.register(undisturbed.environment, ENVIRONMENT),
                            undisturbed.frames, chunk_frames=chunk_frames)

    def made_whole(self, job: str, undisturbed: Undisturbed) -> sa.RowMapping:
        """Wait for a job that succeeds, with the frames that nobody disturbed and no file besides, hidden ones neither."""
        row = self.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None)
        assert digests(self.results(job)) == undisturbed.digests
        return row

    def two_steps(self) -> str:
        """Submit a job of two steps, of a capture that nobody looks for."""
        return self.relight(new_id(CAPTURE), new_id(ENVIRONMENT), 10, chunk_frames=5)

    def claim(self, job: str, worker: str) -> Claim:
        """Let a worker take a job and begin it."""
        self.take(job, worker)
        claim = Claim(job, 1, worker)
        assert jobs.begin(self.database, claim)
        return claim

    def request(self, job: str) -> JobRequest:
        return ANY_JOB.validate_python(self.row(job)["request"])

    def row(self, job: str) -> sa.RowMapping:
        row = jobs.find(self.database, job)
        assert row is not None
        return row

    def until(self, true: Callable[[], Any], what: str, *, within_s: float = WAIT_S, every_s: float | None = None) -> Any:
        """Wait for something, and return it."""
        try:
            return until(true, f"not {what} within {within_s:g} s", within_s=within_s, every_s=every_s)
        except AssertionError as error:
            error.add_note(self.tail())
            raise

    def ended(self, job: str, **options: float) -> sa.RowMapping:
        """The job, when it has ended."""
        self.until(lambda: self.row(job)["state"] in jobs.ENDED, f"{job} ended", **options)
        return self.row(job)

    def ready(self, count: int) -> list[sa.RowMapping]:
        """The workers, when there are so many."""
        return self.until(lambda: found if len(found := workers.seen_lately(self.database)) >= count else None, f"{count} workers ready")

    def pid_of(self, worker: str) -> int:
        """Of the process of a worker, which is part of its name."""
        return int(worker.split("-")[-2])

    def is_alive(self, worker: str) -> bool:
        """Whether the process of a worker runs."""
        return Path(f"/proc/{self.pid_of(worker)}").exists()

    def holder(self, job: str, *, other_than: str | None = None) -> str:
        """The worker that does a job."""

        def found() -> str | None:
            row = self.row(job)
            assert row["state"] in jobs.ACTIVE, f"{job} is {row['state']}: {row['error']}"
            return row["worker"] if row["worker"] != other_than else None

        return str(self.until(found, f"{job} at a worker other than {other_than}"))

    def take(self, job: str, worker: str) -> None:
        """What the queue does when a worker takes a job."""
        table = "workflow_status" if self.database.is_sqlite else "dbos.workflow_status"
        done = self.database.transact(lambda connection: connection.execute(
            sa.text(f"UPDATE {table} SET status = 'PENDING', executor_id = :worker WHERE workflow_uuid = :id AND status = 'ENQUEUED'"),
            {"worker": worker, "id": workflow_id(job, 1)}).rowcount)
        assert done == 1

    def workflow(self, job: str) -> WorkflowStatus:
        """What DBOS has recorded of the first attempt of a job."""
        return DBOSClient(system_database_engine=self.database.engine, lazy=True).retrieve_workflow(workflow_id(job, 1)).get_status()

    def in_queue(self, job: str) -> tuple[str, str | None]:
        """How the first attempt of a job is in the queue, and in which."""
        found = self.workflow(job)
        return found.status, found.queue_name

    def results(self, job: str) -> Path:
        return self.settings.data / layout.results(PROJECT, job)

    def frames_there(self, job: str) -> int:
        """How many frames others see."""
        folder = self.results(job)
        return sum(not path.name.startswith(".") for path in folder.iterdir()) if folder.is_dir() else 0

    def never_two_at_once(self, job: str) -> None:
        """By the log: when a worker begins a step, the one before it has ended its own, or was found dead."""
        at = None
        for line in self.events():
            if line["event"] == "worker died" and line["dead"] == at:
                at = None
            if line.get("job") == job and line["event"] == "step begins":
                assert at in (None, line["worker"]), f"{line['worker']} began while {at} was at work"
                at = line["worker"]
            if line.get("job") == job and line["event"] in ("step done", "step stopped"):
                at = None

    def tail(self) -> str:
        return self.log.read_text()[-6000:] if self.log.exists() else ""


def do_step(job: Job, context: WorkerContext, name: str | None = None) -> None:
    """Do a step of a job as its worker does; without a name, the only one."""
    step, = [step for step in steps_of(job, context) if name in (None, step.name)]
    with places_named(), StepFiles.of(job, context, Timings()) as files:
        step.run(files)


@contextmanager
def harness(folder: Path, database_url: str | None = None, **settings: Any) -> Iterator[Harness]:
    made = Harness(folder, database_url, **settings)
    try:
        yield made
    finally:
        made.close()


def begun(made: Harness, job: str) -> dict[str, list[str]]:
    """The pieces that each worker has begun, by the log."""
    found: dict[str, list[str]] = {}
    for event in made.events():
        if event["event"] == "piece begins" and event["job"] == job:
            found.setdefault(event["worker"], []).append(event["piece"])
    return found


def shared(made: Harness, job: str, count: int) -> sa.RowMapping:
    """Wait for a job that so many workers share, and that nothing is left of its pieces."""
    row = made.ended(job)
    assert (row["state"], row["error"], row["lost"]) == (jobs.SUCCEEDED, None, 0)
    shares = begun(made, job)
    assert len(shares) == count
    pieces = [piece for share in shares.values() for piece in share]
    assert len(pieces) < len(shares) * len(set(pieces))  # two that claim one at the same moment both do it, but not each of them
    no_pieces(made, job)
    return row


def no_pieces(made: Harness, job: str) -> None:
    """Wait until the pieces of a job are removed; a worker that helped may end after the job."""
    made.until(lambda: not (made.settings.data / layout.shared(PROJECT, job)).exists(), "pieces removed")


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file of a folder, hidden ones too."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def relit_relight(capture: Path, environment: Path, frames: int, out: Path) -> dict[str, str]:
    """The digests of what `relit relight` makes of the same."""
    subprocess.run([sys.executable, "-m", "service.cli.main", "relight", str(capture), "--environment", str(environment), "--device", "cpu",
                    "--out", str(out / layout.FRAMES), "--frames", f"1-{frames}", "--spin-degrees", "360"], check=True, capture_output=True)
    return digests(out)
