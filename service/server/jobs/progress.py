"""The progress of a running step: recorded in the database, which also tells whether the step is to stop."""

import threading
import time
from collections.abc import Callable, Sequence

from service.server.base.log import logger
from service.server.database import jobs
from service.server.database.engine import UNANSWERED, Database, message_of
from service.server.database.jobs import FRAMES, Claim

BEGIN = "begin"
"""The stage of a step before its product begins one."""
EVERY_S = 0.5
"""Seconds between two records of the progress."""
UNANSWERED_S = 5.0
"""Seconds until the next record after the database did not answer: each try may take long, and the step waits for it."""


class Stopped(Exception):
    """The job was cancelled, or another worker has it now."""


class JobProgress:
    """A Progress of one step, which stops if the worker no longer has the job; while the database does not answer, it continues."""

    def __init__(self, database: Database, claim: Claim, *, alive: Callable[[], None], frame_offset: int = 0,
                 frame_count: int | None = None, begun: Sequence[str] = (), reached: int | None = None, shown: int = 0) -> None:
        """Create the progress of a step, after `frame_offset` frames of a job of `frame_count`; None: it makes no frames.

        `begun` are the stages that the step came to with workers that died; `reached` are the frames that the job has had, if workers died
        since: one more is recorded at once. No fewer than `shown` are told while a worker that took over looks at them again.
        """
        self._database, self._claim = database, claim
        self._alive, self._frame_offset, self._frame_count, self._shown = alive, frame_offset, frame_count, shown
        self._lock = threading.Lock()  # several threads of a step may report
        self._record_at = 0.0
        self._stage, self._offset, self._total, self._began = BEGIN, 0, 0, time.monotonic()
        self._counted = 0
        self._opening = self._stopped = False
        self._begun, self._new_stage, self._repeating = list(begun), False, bool(begun)
        self._reached = reached
        self._logged: str | None = None
        self.guard: Callable[[], None] = lambda: None
        """Called before each record of the progress; what it raises ends the step."""

    def begin(self, kind: str) -> None:
        """Begin the step, which is shown as a stage of this name; no product has begun."""
        self._begin(BEGIN, kind, 1)

    def stage(self, name: str, total: int) -> None:
        """Begin a stage of the step."""
        self._begin(name, name, total)

    def _begin(self, stage: str, name: str, total: int) -> None:
        with self._lock:
            if stage not in self._begun:
                self._begun.append(stage)
                self._new_stage = True
            self._repeating = stage != self._begun[-1]
            self._began, self._record_at = time.monotonic(), 0.0
            if self._stage == FRAMES and name != FRAMES:  # the frames of this step are made
                self._frame_offset += self._counted
            begun = self._frame_offset > 0 or self._shown > 0
            self._opening = self._frame_count is not None and name != FRAMES and begun
            if self._frame_count is not None and (name == FRAMES or begun):  # so that frames are never counted backwards
                self._stage, self._offset, self._total = FRAMES, self._frame_offset, self._frame_count
            else:
                self._stage, self._offset, self._total = name, 0, total
        self.advance(0)

    def advance(self, done: int) -> None:
        """Record the progress, at most every EVERY_S; raise Stopped if the job was cancelled or another worker has it."""
        self._alive()
        with self._lock:
            if self._stopped:
                raise Stopped
            self._counted = 0 if self._opening else done
            made, now = self._offset + self._counted, time.monotonic()
            further = self._stage == FRAMES and self._reached is not None and made > self._reached
            if now < self._record_at and not further:
                return
            self.guard()
            rate = self._counted / (now - self._began) if self._counted and now > self._began else None
            shown = max(made, self._shown) if self._stage == FRAMES else made
            try:
                self._stopped = not jobs.advance(
                    self._database, self._claim, self._stage, shown, self._total, rate, frames=made, repeating=self._repeating,
                    begun=self._begun if self._new_stage else None, entered=self._stage != self._logged)
                self._logged = self._stage
                self._record_at = time.monotonic() + EVERY_S
                self._new_stage = False
                self._reached = None if further else self._reached
            except UNANSWERED as error:
                logger.warning("progress is not told", job=self._claim.job, error=message_of(error))
                self._record_at = time.monotonic() + UNANSWERED_S
            if self._stopped:
                raise Stopped
