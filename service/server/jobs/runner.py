"""The workflow of a job: its steps one after the other, each recorded when it is done."""

import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from dbos import DBOS

from service.errors import USER_ERRORS, sentence
from service.requests.jobs import CheckJob
from service.server import telemetry
from service.server.database import intakes, jobs
from service.server.database.engine import FIRST_PAUSE_S, LONGEST_PAUSE_S, UNANSWERED, message_of
from service.server.database.jobs import Claim
from service.server.jobs.progress import JobProgress, Stopped
from service.server.jobs.queue import WORKFLOW, JobQueue, workflow_id
from service.server.jobs.steps import Job, WorkerContext, steps_of
from service.server.log import logger
from service.server.storage import layout
from service.views.states import FAILED, SUCCEEDED

T = TypeVar("T")
DONE, STOPPED = "done", "stopped"


class JobRunner:
    """Where a worker does its jobs, one step at a time on each queue."""

    def __init__(self, context: WorkerContext, queue: JobQueue, worker: str, *, alive: Callable[[float], None]) -> None:
        """Prepare.

        Args:
            context: where it works.
            queue: that it gives back to what it cannot go on with.
            worker: its name.
            alive: told, at every sign of progress, the oldest last sign of the running steps (monotonic seconds); 0: none runs.
        """
        self._context, self._queue, self._worker, self._alive = context, queue, worker, alive
        self._draining = threading.Event()
        self._changed = threading.Condition()
        self._signs: dict[str, float] = {}  # by job
        self._running: set[str] = set()

    @property
    def running(self) -> frozenset[str]:
        """Workflows that this process goes on with."""
        with self._changed:
            return frozenset(self._running)

    def register(self) -> None:
        """Make the workflow known to the queue; before it is launched."""
        @DBOS.step()
        def step(job: str, attempt: int, name: str) -> str:
            return self._step(Claim(job, attempt, self._worker), name)

        @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=None)
        def run(job: str, attempt: int) -> str:
            with self._runs(workflow_id(job, attempt)):
                return self._run(Claim(job, attempt, self._worker), lambda name: step(job, attempt, name))

    def drain(self, within_s: float) -> bool:
        """Begin no further step, and wait for the one that is running.

        Returns:
            Whether all are done in time.
        """
        self._draining.set()
        with self._changed:
            return self._changed.wait_for(lambda: not self._signs, timeout=within_s)

    def _run(self, claim: Claim, step: Callable[[str], str]) -> str:
        if self._draining.is_set():
            _wait_for_the_end()
        log = logger.bind(job=claim.job, attempt=claim.attempt)
        try:
            names = self._patiently(claim, lambda: self._begin(claim))
            if names is None:
                return STOPPED
            for name in names:
                outcome = step(name)
                if outcome != DONE:
                    return outcome
            if jobs.end(self._context.database, claim, SUCCEEDED):
                log.info("job succeeded")
            return DONE
        except UNANSWERED as error:  # the queue could not record a step: the steps are to be gone through again, from the first
            log.warning("job goes back to the queue: the database does not answer", error=message_of(error))
            self._patiently(claim, lambda: self._queue.return_job(workflow_id(claim.job, claim.attempt), self._worker))
            return STOPPED
        except USER_ERRORS as error:
            why = sentence(error)
        except Exception as error:
            log.error("job failed", error=repr(error), trace=traceback.format_exc())
            why = f"an error of relit itself ({type(error).__name__}): its log has more"
        return self._patiently(claim, lambda: self._fail(claim, why))

    def _begin(self, claim: Claim) -> list[str] | None:
        """The steps of a job that is begun; None: it is not to be done any more, or another does it."""
        if not jobs.begin(self._context.database, claim):
            return None
        row = jobs.find(self._context.database, claim.job)
        return None if row is None else [step.name for step in steps_of(Job.of(dict(row)), self._context)]

    def _step(self, claim: Claim, name: str) -> str:
        if self._draining.is_set():
            _wait_for_the_end()
        self._sign(claim.job)
        try:
            return self._patiently(claim, lambda: self._perform(claim, name))
        finally:
            with self._changed:
                del self._signs[claim.job]
                self._alive(min(self._signs.values(), default=0.0))
                self._changed.notify_all()

    def _perform(self, claim: Claim, name: str) -> str:
        database = self._context.database
        row = jobs.find(database, claim.job)
        if row is None or not jobs.is_claimed(database, claim):
            return STOPPED
        if name in row["finished_steps"]:  # of an attempt before
            return DONE
        job = Job.of(dict(row))
        step = next(step for step in steps_of(job, self._context) if step.name == name)
        progress = JobProgress(database, claim, alive=lambda: self._sign(claim.job), before=step.before, of=step.of)
        log = logger.bind(job=job.id, project=job.project, step=name, attempt=claim.attempt, worker=self._worker)
        log.info("step begins")
        try:
            progress.stage(name.partition(" ")[0], 1)
            with telemetry.span(step.name, row["trace"], job=job.id, attempt=claim.attempt, worker=self._worker):
                step.run(progress)
            if not self._patiently(claim, lambda: jobs.is_claimed(database, claim)):  # another may be writing there
                raise Stopped
            if not isinstance(job.request, CheckJob):
                self._context.storage.publish(layout.results(job.project, job.id), progress)
        except Stopped:
            log.info("step stopped")
            return STOPPED
        except UNANSWERED:
            raise
        except USER_ERRORS as error:
            return self._fail(claim, sentence(error), job)
        except Exception as error:
            log.error("step failed", error=repr(error), trace=traceback.format_exc())
            return self._fail(claim, f"{name}: an error of relit itself ({type(error).__name__}): its log has more", job)
        if not jobs.finish_step(database, claim, [*row["finished_steps"], name]):
            return STOPPED
        log.info("step done")
        return DONE

    def _fail(self, claim: Claim, error: str, job: Job | None = None) -> str:
        logger.info("job failed", job=claim.job, attempt=claim.attempt, error=error)
        error = self._context.without_folder(error)
        if job is not None and isinstance(job.request, CheckJob):
            intakes.refuse(self._context.database, job.request.intake, error)
        jobs.end(self._context.database, claim, FAILED, error)
        return FAILED

    def _patiently(self, claim: Claim, work: Callable[[], T]) -> T:
        """Do something, and again while the database does not answer: what is done stays done, and waiting is no hanging."""
        pause = FIRST_PAUSE_S
        while True:
            try:
                return work()
            except UNANSWERED as error:
                logger.warning("waiting for the database", job=claim.job, error=message_of(error))
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)
            with self._changed:
                if claim.job in self._signs:
                    self._sign(claim.job)

    def _sign(self, job: str) -> None:
        with self._changed:
            self._signs[job] = time.monotonic()
            self._alive(min(self._signs.values()))

    @contextmanager
    def _runs(self, workflow: str) -> Iterator[None]:
        with self._changed:
            self._running.add(workflow)
        try:
            yield
        finally:
            with self._changed:
                self._running.discard(workflow)


def _wait_for_the_end() -> None:
    """The process ends, and another goes on from here."""
    threading.Event().wait()
