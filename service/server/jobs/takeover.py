"""Takeover: the jobs of a worker that died go back to the queue.

DBOS gives a worker's jobs back only to a worker of the same name. So each worker holds a lock that is named after it (worker_lock), and
looks every few seconds whether a worker that has jobs has lost its lock. The worker that finds one holds that lock meanwhile, so that no
two take over the same jobs.
"""

import threading
from collections import Counter
from collections.abc import Callable

from service.requests.states import QUEUED
from service.server.base.log import logger
from service.server.database import jobs, workers
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.jobs import Claim
from service.server.jobs.queue import JobQueue, is_help, job_and_attempt
from service.server.jobs.worker_lock import LockState, WorkerLock

GRACE_ROUNDS = 2
"""Rounds without a takeover after this worker had to take its lock again: a restart of the database released the locks of all other workers
as well, and they need time to take them again."""
FORGOTTEN_ROUNDS = 3
"""Rounds after which a workflow is put back that DBOS assigns to this worker but that does not run here. This happens when the database
stops after it has assigned the workflow and before this worker receives the answer."""


class Takeover:
    """A thread that keeps the worker's own lock and takes over from workers that died."""

    def __init__(self, database: Database, queue: JobQueue, lock: WorkerLock, worker: str, *, every_s: float, max_lost: int,
                 running: Callable[[], frozenset[str]], beat: Callable[[], None], lock_lost: Callable[[], None],
                 asked: Callable[[str], None]) -> None:
        """Create the thread of the worker that holds `lock`; `start` starts it.

        Every `every_s` seconds it calls `beat`. `running` returns the workflows that run in this process, `max_lost` is the number of
        workers that a job may lose without progress, and `lock_lost` is called when another process has this worker's lock for good;
        `asked` is called with what an operator asks of this worker, each round.
        """
        self._database, self._queue, self._lock, self._worker = database, queue, lock, worker
        self._every_s, self._max_lost = every_s, max_lost
        self._running, self._beat, self._lock_lost, self._asked = running, beat, lock_lost, asked
        self.state = workers.READY
        """State of this worker for the table of workers."""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relit-takeover", daemon=True)
        self._grace = self._refused = 0
        self._unknown: Counter[str] = Counter()

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread and wait for it."""
        self._ended.set()
        self._thread.join()

    def round(self) -> None:
        """Renew the lock, then look at the other workers once."""
        held = self._lock.hold()
        self._refused = self._refused + 1 if held is LockState.REFUSED else 0
        if self._refused > GRACE_ROUNDS:  # a worker that takes over from this one holds the lock for a moment only
            self._lock_lost()
        if held is LockState.REFUSED:
            return
        if held is LockState.TAKEN:
            self._grace = GRACE_ROUNDS
        workers.record_alive(self._database, self._worker, self.state)
        if (what := workers.asked_of(self._database, self._worker)) is not None:
            self._asked(what)
        taken = self._queue.taken_by()
        self._return_forgotten(taken.pop(self._worker, []))
        if self._grace > 0:
            self._grace -= 1
            return
        for worker in taken:
            with self._lock.dead(worker) as dead:
                if dead:
                    self._take_over(worker)

    def _run(self) -> None:
        while True:
            self._beat()
            try:
                self.round()
            except UNANSWERED as error:
                logger.warning("database does not answer", error=message_of(error))
            except Exception as error:  # the next round may succeed; a worker without rounds would seem dead
                logger.error("takeover failed", exc_info=error)
            if self._ended.wait(self._every_s):
                return

    def _take_over(self, worker: str) -> None:
        workflows = self._queue.taken_by().get(worker, [])  # read again under the worker's lock: another may have been faster
        if workflows:
            logger.warning("worker died", dead=worker, jobs=[job_and_attempt(workflow)[0] for workflow in workflows])
        for workflow in workflows:
            self._take(workflow, worker)
        workers.remove(self._database, worker)

    def _take(self, workflow: str, worker: str) -> None:
        """Queue a workflow of a dead worker again, or end its job if it has lost too many workers."""
        claim = Claim(*job_and_attempt(workflow), worker)
        if not is_help(workflow) and self._database.transact(
                lambda connection: jobs.record_lost_worker(connection, claim, self._max_lost)) == QUEUED:
            self._queue.requeue(workflow)
        else:  # also of help, as the worker that has the job does what is left
            self._queue.cancel(workflow)

    def _return_forgotten(self, workflows: list[str]) -> None:
        unknown = set(workflows) - self._running()
        self._unknown = Counter({workflow: self._unknown[workflow] + 1 for workflow in unknown})
        for workflow, rounds in self._unknown.items():
            if rounds >= FORGOTTEN_ROUNDS:
                logger.warning("job is put back: this worker had it and did not begin", job=job_and_attempt(workflow)[0])
                self._queue.return_job(workflow, self._worker)
