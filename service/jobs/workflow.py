"""The workflow of a job: its steps one after the other, each recorded when it is done."""

import threading
import time
import traceback
from collections.abc import Callable

from dbos import DBOS

from service.errors import USER_ERRORS, sentence
from service.job_requests import CheckJob
from service.jobs.progress import JobProgress, Stopped
from service.jobs.queue import WORKFLOW
from service.jobs.steps import Job, Site, steps_of
from service.log import logger
from service.storage import layout
from service.store import intakes, jobs

DONE, STOPPED = "done", "stopped"


class Desk:
    """Where a worker does its jobs, one step at a time on each queue."""

    def __init__(self, site: Site, worker: str, *, alive: Callable[[float], None]) -> None:
        """Prepare.

        Args:
            site: where it works.
            worker: its name.
            alive: told, at every sign of progress, the oldest last sign of the running steps (monotonic seconds); 0: none runs.
        """
        self._site, self._worker, self._alive = site, worker, alive
        self._draining = threading.Event()
        self._signs: dict[str, float] = {}
        self._changed = threading.Condition()

    def register(self) -> None:
        """Make the workflow known to the queue; before it is launched."""
        @DBOS.step()
        def step(job: str, attempt: int, name: str) -> str:
            return self._step(job, attempt, name)

        @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=None)
        def run(job: str, attempt: int) -> str:
            if not jobs.begin(self._site.database, job, attempt, self._worker):
                return STOPPED
            row = jobs.find(self._site.database, job)
            assert row is not None, "it has just begun"
            for name in [step.name for step in steps_of(Job.of(dict(row)), self._site)]:
                outcome = step(job, attempt, name)
                if outcome != DONE:
                    return outcome
            jobs.end(self._site.database, job, attempt, jobs.SUCCEEDED)
            logger.info("job succeeded", job=job, project=row["project"])
            return DONE

    def drain(self, within_s: float) -> bool:
        """Begin no further step, and wait for the one that is running.

        Returns:
            Whether all are done in time.
        """
        self._draining.set()
        with self._changed:
            return self._changed.wait_for(lambda: not self._signs, timeout=within_s)

    def _step(self, job: str, attempt: int, name: str) -> str:
        if self._draining.is_set():
            threading.Event().wait()  # the process ends, and another goes on from here
        self._sign(job)
        try:
            return self._perform(job, attempt, name)
        finally:
            with self._changed:
                del self._signs[job]
                self._alive(min(self._signs.values(), default=0.0))
                self._changed.notify_all()

    def _sign(self, job: str) -> None:
        with self._changed:
            self._signs[job] = time.monotonic()
            self._alive(min(self._signs.values()))

    def _perform(self, identifier: str, attempt: int, name: str) -> str:
        database = self._site.database
        row = jobs.find(database, identifier)
        if row is None or not jobs.is_wanted(database, identifier, attempt):
            return STOPPED
        if name in row["finished_steps"]:  # of an attempt before
            return DONE
        job = Job.of(dict(row))
        step = next(step for step in steps_of(job, self._site) if step.name == name)
        progress = JobProgress(database, job.id, attempt, alive=lambda: self._sign(identifier), before=step.before, of=step.of)
        log = logger.bind(job=job.id, project=job.project, step=name, attempt=attempt)
        log.info("step begins")
        try:
            progress.stage(name.partition(" ")[0], 1)
            step.run(progress)
            if not isinstance(job.request, CheckJob):
                self._site.storage.publish(layout.results(job.project, job.id))
        except Stopped:
            log.info("step stopped")
            return STOPPED
        except USER_ERRORS as error:
            return self._fail(job, attempt, sentence(error))
        except Exception as error:
            log.error("step failed", error=repr(error), trace=traceback.format_exc())
            return self._fail(job, attempt, f"{name}: an error of relit itself ({type(error).__name__}): its log has more")
        jobs.finish_step(database, job.id, attempt, [*row["finished_steps"], name])
        log.info("step done")
        return DONE

    def _fail(self, job: Job, attempt: int, error: str) -> str:
        logger.info("job failed", job=job.id, project=job.project, error=error)
        if isinstance(job.request, CheckJob):
            intakes.refuse(self._site.database, job.request.intake, error)
        jobs.end(self._site.database, job.id, attempt, jobs.FAILED, error)
        return jobs.FAILED
