"""What a running step tells the store, and how it learns that it is to stop."""

import threading
import time
from collections.abc import Callable

from service.server.database import jobs
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.jobs import FRAMES, Claim
from service.server.log import logger

EVERY_S = 0.5
"""How often the store is told and asked."""
UNTOLD_S = 5.0
"""Until it is told again after it did not answer: each try may take long, and the step waits for it."""


class Stopped(Exception):
    """The job was cancelled, or is another worker's now."""


class JobProgress:
    """A Progress of one step: tells the store, renews the deadline, and stops the step where the job is not wanted any more.

    While the database does not answer nothing is told, and the step goes on.
    """

    def __init__(self, database: Database, claim: Claim, *, alive: Callable[[], None], before: int = 0, of: int | None = None) -> None:
        """Prepare.

        Args:
            database: the store's.
            claim: what is worked on.
            alive: called at every sign of progress.
            before: frames of steps before this one.
            of: frames of the whole job; None: it makes none.
        """
        self._database, self._claim = database, claim
        self._alive, self._before, self._of = alive, before, of
        self._lock = threading.Lock()  # several threads of a pipeline may report
        self._tell_at = 0.0
        self._stage, self._offset, self._total, self._began = "begin", 0, 0, time.monotonic()
        self._counted = 0
        self._opening = self._stopped = False

    def stage(self, name: str, total: int) -> None:
        """Begin a stage."""
        with self._lock:
            self._began, self._tell_at = time.monotonic(), 0.0
            if self._stage == FRAMES and name != FRAMES:  # the frames of this step are made
                self._before += self._counted
            self._opening = self._of is not None and name != FRAMES and self._before > 0
            if self._of is not None and (name == FRAMES or self._before > 0):  # so that frames are never counted backwards
                self._stage, self._offset, self._total = FRAMES, self._before, self._of
            else:
                self._stage, self._offset, self._total = name, 0, total
        self.advance(0)

    def advance(self, done: int) -> None:
        """Tell the store, at most twice a second.

        Raises:
            Stopped: the job is not wanted any more.
        """
        self._alive()
        with self._lock:
            if self._stopped:
                raise Stopped
            self._counted = 0 if self._opening else done
            now = time.monotonic()
            if now < self._tell_at:
                return
            spent = now - self._began
            counted = self._counted
            progress = jobs.Progress(self._stage, self._offset + counted, self._total, counted / spent if counted and spent > 0 else None)
            try:
                self._stopped = not jobs.advance(self._database, self._claim, progress)
                self._tell_at = time.monotonic() + EVERY_S
            except UNANSWERED as error:
                logger.warning("progress is not told", job=self._claim.job, error=message_of(error))
                self._tell_at = time.monotonic() + UNTOLD_S
            if self._stopped:
                raise Stopped
