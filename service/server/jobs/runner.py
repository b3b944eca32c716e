"""The workflow of a job: its steps, one after the other.

DBOS starts the workflow, and starts it again from its beginning when the job goes to another worker. Steps that the same version of relit
has finished are then skipped: `finished_steps` in service.server.database.tables says why that list is ours.
"""

import re
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import Any, TypeVar

from dbos import DBOS

from service import __version__
from service.errors import USER_ERRORS, DivergedError, sentence
from service.reporting.provenance import places_named
from service.requests.jobs import CheckJob
from service.requests.states import ENDED, FAILED, SUCCEEDED
from service.server.base import telemetry
from service.server.base.log import logger
from service.server.database import intakes, jobs
from service.server.database.engine import FIRST_PAUSE_S, LONGEST_PAUSE_S, UNANSWERED, message_of
from service.server.database.jobs import Claim
from service.server.jobs.context import Job, JobStep, StepFiles, WorkerContext, without_places
from service.server.jobs.pieces import HelpProgress, JobPieces
from service.server.jobs.progress import JobProgress, Stopped
from service.server.jobs.queue import HELP, WORKFLOW, job_and_attempt, workflow_id
from service.server.jobs.steps import help_with, steps_of
from service.server.storage import layout
from stage.errors import StorageError

T = TypeVar("T")
DONE, STOPPED, LATER = "done", "stopped", "later"
"""Outcomes of a job or a step: it is done; this worker has the job no longer; another worker does the step."""
LOOK_S = 0.5
"""Seconds between two looks for a step that another worker does."""

NO_MEMORY = re.compile("failed to allocate|out of memory|insufficient memory|bad_alloc", re.IGNORECASE)
"""Messages with which Warp, CUDA, OpenCV and the C++ library report a lack of memory, for which Python has MemoryError."""


class JobRunner:
    """Run the jobs that the queues give to a worker."""

    def __init__(self, context: WorkerContext, worker: str, *, alive: Callable[[float], None]) -> None:
        """Create a runner; `alive` gets the oldest of the last signs of the running steps, or 0 without a step, at every sign."""
        self._context, self._worker, self._alive = context, worker, alive
        self._draining = threading.Event()
        self._changed = threading.Condition()
        self._signs: dict[Claim, float] = {}  # last sign of progress of each running step; two attempts of a job may overlap
        self._running: set[str] = set()
        self._pieces: dict[Claim, JobPieces] = {}
        self._device = threading.Lock()
        """Held by what works on the device: a step that was cancelled works until its next sign, while the queue gives the next job."""

    @property
    def running(self) -> frozenset[str]:
        """The workflows that run in this process."""
        with self._changed:
            return frozenset(self._running)

    def register(self) -> None:
        """Register the workflows with DBOS; call this before DBOS is launched."""
        @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=None)
        def run(job: str, attempt: int) -> str:
            return self.run(Claim(job, attempt, self._worker))

        @DBOS.workflow(name=HELP, max_recovery_attempts=None)
        def help_job(workflow: str) -> None:
            self.help(workflow)

    def run(self, claim: Claim) -> str:
        """Do a job and return its outcome: DONE, STOPPED, or the state in which it ended."""
        if self._draining.is_set():
            _wait_for_the_end()
        with self._runs(workflow_id(claim.job, claim.attempt)):
            try:
                return self._run(claim)
            finally:
                self._forget(claim)

    def help(self, workflow: str) -> None:
        """Help the worker that has a job until nothing is left to help with; what goes wrong here is of no concern to the job."""
        claim = Claim(*job_and_attempt(workflow), self._worker)
        log = logger.bind(job=claim.job, attempt=claim.attempt, worker=self._worker)
        with self._runs(workflow), self._signs_of(claim):
            try:
                row = jobs.find(self._context.database, claim.job)
                if row is not None and row["attempt"] == claim.attempt and row["worker"] != self._worker:
                    self._help(Job.of(row), claim, log)
            except Exception as error:
                log.warning("help failed", error=repr(error), trace=traceback.format_exc())

    def _help(self, job: Job, claim: Claim, log: Any) -> None:
        log.info("help begins")
        progress = HelpProgress(self._context, job, alive=lambda: self._sign(claim), ending=self._draining.is_set)
        try:
            with places_named(), self._device:
                help_with(job, self._context, progress)
            log.info("help done")
        except Stopped:
            log.info("help stopped")
            self._clear_if_deleted(job)
        except DivergedError as error:
            log.warning("help diverged", error=str(error))

    def drain(self, within_s: float) -> bool:
        """Start no further step and wait for the running ones; return whether they ended in time."""
        self._draining.set()
        with self._changed:
            return self._changed.wait_for(lambda: not self._signs, timeout=within_s)

    def _run(self, claim: Claim) -> str:
        log = logger.bind(job=claim.job, attempt=claim.attempt)
        try:
            names = self._patiently(claim, lambda: self._begin(claim))
            if names is None:
                return STOPPED
            while names:
                left = []
                for name in names:
                    outcome = self._step(claim, name)
                    if outcome == LATER:
                        left.append(name)
                    elif outcome != DONE:
                        return outcome
                if left == names:
                    time.sleep(LOOK_S)
                names = left
            if self._patiently(claim, lambda: self._succeed(claim)):
                log.info("job succeeded")
            return DONE
        except USER_ERRORS as error:
            why = sentence(error)
        except Exception as error:
            log.error("job failed", error=repr(error), trace=traceback.format_exc())
            why = _unexpected(error)
        return self._patiently(claim, lambda: self._fail(claim, why))

    def _begin(self, claim: Claim) -> list[str] | None:
        """Return the names of the job's steps; None if the job was cancelled or another worker has it."""
        if not jobs.begin(self._context.database, claim):
            return None
        row = jobs.find(self._context.database, claim.job)
        if row is None:
            return None
        job = Job.of(row)
        if row["version"] != __version__:
            JobPieces(self._context, job).remove()
            if not jobs.begin_anew(self._context.database, claim):
                return None
        return [step.name for step in steps_of(job, self._context)]

    def _step(self, claim: Claim, name: str) -> str:
        if self._draining.is_set():
            _wait_for_the_end()
        with self._signs_of(claim):
            return self._patiently(claim, lambda: self._perform(claim, name))

    def _perform(self, claim: Claim, name: str) -> str:
        database = self._context.database
        row = jobs.find(database, claim.job)
        if row is None or not jobs.is_claimed(database, claim):
            return STOPPED
        if name in row["finished_steps"]:
            return DONE
        job = Job.of(row)
        steps = steps_of(job, self._context)
        step = next(step for step in steps if step.name == name)
        if step.frames or step.help is not None:
            self._pieces.setdefault(claim, JobPieces(self._context, job))
        finished_frames = sum(other.frames for other in steps if other.name in row["finished_steps"])
        reached = None
        if job.is_resumed:  # the worker that died may have told of frames that were only half written
            reached = finished_frames + step.made()
            jobs.correct_reached(database, claim, reached)
        progress = JobProgress(database, claim, alive=lambda: self._sign(claim), frame_offset=finished_frames,
                               frame_count=sum(other.frames for other in steps) if step.frames else None, begun=row["stages_begun"],
                               reached=reached, shown=max(row["reached"], row["done"] or 0 if row["stage"] == jobs.FRAMES else 0))
        log = logger.bind(job=job.id, project=job.project, step=name, attempt=claim.attempt, worker=self._worker)
        try:
            if step.frames and (outcome := self._leave_to_others(claim, step, steps, row["finished_steps"])) is not None:
                return outcome
            log.info("step begins")
            size = None
            if not isinstance(job.request, CheckJob):
                progress.guard = self._context.require_space
            with (telemetry.span(step.name, row["trace"], job=job.id, attempt=claim.attempt, worker=self._worker), places_named(),
                  nullcontext() if isinstance(job.request, CheckJob) else self._device,  # checks need no device
                  StepFiles.of(job, self._context, progress) as files):
                progress.begin(name.partition(" ")[0])
                step.run(files)
            if not self._patiently(claim, lambda: jobs.is_claimed(database, claim)):  # another worker may be writing the same files
                raise Stopped
            if not isinstance(job.request, CheckJob):
                self._publish(claim, job, step, progress)
                size = sum(file.size for file in self._context.storage.files(layout.results(job.project, job.id)))
        except Stopped:
            log.info("step stopped")
            self._clear_if_deleted(job)
            return STOPPED
        except UNANSWERED:
            raise
        except USER_ERRORS as error:
            return self._fail(claim, sentence(error), job)
        except Exception as error:
            log.error("step failed", error=repr(error), trace=traceback.format_exc())
            return self._fail(claim, f"{name}: {_unexpected(error)}", job)
        if not jobs.finish_step(database, claim, [*row["finished_steps"], name], size):
            self._clear_if_deleted(job)
            return STOPPED
        log.info("step done")
        return DONE

    def _leave_to_others(self, claim: Claim, step: JobStep, steps: list[JobStep], finished: list[str]) -> str | None:
        """Ask others to help with the frames of a job; return None if this worker is to make those of this step."""
        pieces = self._pieces[claim]
        pieces.invite_to_steps(sum(other.frames > 0 and other.name not in finished for other in steps))
        if pieces.is_finished(step.name):
            return DONE if jobs.finish_step(self._context.database, claim, [*finished, step.name]) else STOPPED
        return LATER if pieces.are_shared and not pieces.claim_step(step.name) else None

    def _publish(self, claim: Claim, job: Job, step: JobStep, progress: JobProgress) -> None:
        shared = step.frames > 0 and self._pieces[claim].are_shared
        self._context.storage.publish(layout.results(job.project, job.id), progress, alone=not shared)
        if shared:
            self._pieces[claim].finish_step(step.name)

    def _succeed(self, claim: Claim) -> bool:
        """End a job whose steps are finished; return False if it was cancelled or another worker has it."""
        if not jobs.is_claimed(self._context.database, claim):
            return False
        pieces = self._pieces.get(claim)
        if pieces is not None:
            if pieces.are_shared:
                self._context.storage.publish(pieces.results)
            pieces.remove()
        return jobs.end(self._context.database, claim, SUCCEEDED)

    def _forget(self, claim: Claim) -> None:
        """Delete the pieces of a job that has ended; those of one that goes on elsewhere are needed there."""
        pieces = self._pieces.pop(claim, None)
        if pieces is None:
            return
        try:
            row = jobs.find(self._context.database, claim.job)
            if row is None or (row["attempt"] == claim.attempt and row["state"] in ENDED):
                pieces.remove()
        except (*UNANSWERED, StorageError) as error:  # they are deleted with the job
            logger.warning("pieces stay", job=claim.job, error=message_of(error))

    def _fail(self, claim: Claim, error: str, job: Job | None = None) -> str:
        logger.info("job failed", job=claim.job, attempt=claim.attempt, error=error)
        error = without_places(error, claim.job, self._context)
        if job is not None and isinstance(job.request, CheckJob):
            intakes.refuse(self._context.database, job.request.intake, error)
        if not jobs.end(self._context.database, claim, FAILED, error) and job is not None:
            self._clear_if_deleted(job)
        return FAILED

    def _clear_if_deleted(self, job: Job) -> None:
        """Delete the files that a step wrote while its job was cancelled and deleted; housekeeping does so where the worker is killed."""
        if jobs.find(self._context.database, job.id) is None:
            self._context.storage.remove(layout.results(job.project, job.id))

    def _patiently(self, claim: Claim, work: Callable[[], T]) -> T:
        """Call `work` again and again until the database answers; meanwhile give signs of life, so that the worker is not killed."""
        pause = FIRST_PAUSE_S
        while True:
            try:
                return work()
            except UNANSWERED as error:
                logger.warning("waiting for the database", job=claim.job, error=message_of(error))
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)
            with self._changed:
                if claim in self._signs:
                    self._sign(claim)

    @contextmanager
    def _runs(self, workflow: str) -> Iterator[None]:
        """Let a workflow count as one that runs in this process."""
        with self._changed:
            self._running.add(workflow)
        try:
            yield
        finally:
            with self._changed:
                self._running.discard(workflow)

    @contextmanager
    def _signs_of(self, claim: Claim) -> Iterator[None]:
        """Give a sign of a step that runs, and at its end that of the other steps."""
        self._sign(claim)
        try:
            yield
        finally:
            with self._changed:
                del self._signs[claim]
                self._alive(min(self._signs.values(), default=0.0))
                self._changed.notify_all()

    def _sign(self, claim: Claim) -> None:
        with self._changed:
            self._signs[claim] = time.monotonic()
            self._alive(min(self._signs.values()))


def _unexpected(error: Exception) -> str:
    """Return the sentence for a person whose job ended by an error that is no fault of its request."""
    if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
        return "the worker has too little memory for this job: retry it where more is free, or with smaller images"
    return f"an error of relit itself ({type(error).__name__}): its log has more"


def _wait_for_the_end() -> None:
    """Block this thread: the process ends soon, and another worker continues from here."""
    threading.Event().wait()
