"""Let a worker without other work help with a job that another worker has: pieces of its solve, or chunks of its frames."""

import time
from collections.abc import Callable

from service.reporting.progress import Progress
from service.server.base.log import logger
from service.server.database import jobs
from service.server.database.engine import UNANSWERED
from service.server.jobs.context import Job, JobStep, WorkerContext
from service.server.jobs.pieces import JobPieces, is_running
from service.server.jobs.progress import EVERY_S, UNANSWERED_S, Stopped
from service.server.jobs.steps import steps_of
from service.server.storage import layout


class HelpProgress:
    """A Progress that ends the help when the job is not running any more or this worker is asked to end; nothing is recorded."""

    def __init__(self, context: WorkerContext, job: Job, *, alive: Callable[[], None], ending: Callable[[], bool]) -> None:
        self._context, self._job, self._alive, self._ending = context, job, alive, ending
        self._look_at = 0.0

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        self.advance(0)

    def advance(self, done: int) -> None:
        """Look whether the help is still wanted, at most every EVERY_S; raise Stopped if it is not."""
        self._alive()
        now = time.monotonic()
        if now < self._look_at:
            return
        try:
            wanted = is_running(self._context, self._job) and not self._ending()
            self._look_at = now + EVERY_S
        except UNANSWERED:
            wanted, self._look_at = True, now + UNANSWERED_S
        if not wanted:
            raise Stopped


def help_with(job: Job, context: WorkerContext, progress: Progress) -> None:
    """Do what can be done beside the worker that has a job, until nothing is left to take."""
    progress.advance(0)
    steps, pieces = steps_of(job, context), JobPieces(context, job)
    finished = _finished(job, context)
    divided = next((step for step in steps if step.name not in finished and not step.frames), None)
    if divided is not None:
        if divided.help is not None:
            divided.help(progress)
        return  # for the steps after it help is asked for again
    pieces.require_same_kind()
    for step in steps:
        if step.frames:
            _make_frames(step, pieces, job, context, progress)


def _make_frames(step: JobStep, pieces: JobPieces, job: Job, context: WorkerContext, progress: Progress) -> None:
    if step.name in _finished(job, context) or pieces.is_finished(step.name) or not pieces.claim_step(step.name):
        return
    logger.info("help with step", job=job.id, step=step.name, worker=context.worker)
    step.run(progress)
    context.storage.publish(layout.results(job.project, job.id), progress, alone=False)
    pieces.finish_step(step.name)


def _finished(job: Job, context: WorkerContext) -> list[str]:
    row = jobs.find(context.database, job.id)
    return [] if row is None else row["finished_steps"]
