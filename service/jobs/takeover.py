"""Taking over: what a dead worker had begun goes back to the queue.

The queue itself gives a worker's jobs back to a worker of the same name alone. So each worker holds a lock named after it (presence), and
each looks every few seconds whether one that has jobs has lost its lock.
"""

import threading
from collections.abc import Callable

from sqlalchemy.exc import DBAPIError

from service.job_requests import ANY_JOB
from service.jobs.presence import Presence
from service.jobs.queue import JobQueue, job_of
from service.log import logger
from service.store import jobs, workers
from service.store.database import Database

GRACE_ROUNDS = 2
"""Rounds after the lock was taken anew in which nobody is given up for dead: after a restart of the database others, too, take theirs."""


class Takeover:
    """Looks after dead workers, and keeps the own lock."""

    def __init__(self, database: Database, queue: JobQueue, presence: Presence, worker: str, *, every_s: float, max_lost: int,
                 deposed: Callable[[], None]) -> None:
        """Prepare.

        Args:
            database, queue: of the service.
            presence: the own lock, held.
            worker: who we are.
            every_s: between two looks.
            max_lost: workers that a job may lose in one step.
            deposed: called when the own lock is lost to another: what we do is done by others now.
        """
        self._database, self._queue, self._presence, self._worker = database, queue, presence, worker
        self._every_s, self._max_lost, self._deposed = every_s, max_lost, deposed
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relit-takeover", daemon=True)
        self._grace = 0

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def stop(self) -> None:
        """Look no more."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        refused = 0
        while not self._ended.wait(self._every_s):
            try:
                held = self._presence.hold()
                refused = 0 if held else refused + 1
                if refused > GRACE_ROUNDS:  # another only tries it for a moment, unless it is taken for good
                    self._deposed()
                    return
                if held:
                    workers.see(self._database, self._worker)
                    self._look()
            except DBAPIError as error:
                logger.warning("database does not answer", error=str(error.orig))
                self._grace = GRACE_ROUNDS

    def _look(self) -> None:
        if self._grace > 0:
            self._grace -= 1
            return
        for worker, workflows in self._queue.taken_by().items():
            if worker != self._worker and self._presence.is_dead(worker):
                logger.warning("worker died", dead=worker, jobs=[job_of(workflow)[0] for workflow in workflows])
                for workflow in workflows:
                    self.take(workflow)
                workers.leave(self._database, worker)

    def take(self, workflow: str) -> None:
        """Put a workflow of a dead worker back into the queue, or end its job where it has cost too many workers."""
        job, attempt = job_of(workflow)
        row = jobs.find(self._database, job)
        sentence = "" if row is None else f"lost {self._max_lost + 1} workers in one step ({row['stage'] or 'begin'}): " \
                                          "it may need more memory than they have"
        again = self._database.transact(lambda connection: jobs.lose_worker(connection, job, attempt, self._max_lost, sentence))
        if again and row is not None:
            self._queue.put_back(workflow, ANY_JOB.validate_python(row["request"]))
        else:
            self._queue.call_off(job, attempt)
