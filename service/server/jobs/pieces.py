"""The pieces of a running job that its worker and those that help it share, as files of the storage.

Any worker does any piece: the bands and batches of a solve (service.sharing.sharing) and the chunks of frames of a relight. A claim
is a file with the name of the worker that does the piece. It holds as long as that worker is at work on the job, as DBOS has recorded it,
and was seen lately; so pieces of a worker that dies, drains or fails are done by another. Two workers that claim a piece at the same moment
both do it, and store the same. The files are deleted when the job ends, and what a worker stores after that it deletes again.
"""

import secrets
import time
from collections.abc import Callable

from service.errors import DivergedError
from service.requests.states import RUNNING
from service.server.base.log import logger
from service.server.database import jobs, workers
from service.server.database.engine import UNANSWERED
from service.server.jobs.context import Job, WorkerContext
from service.server.jobs.progress import EVERY_S, UNANSWERED_S, Stopped
from service.server.storage import layout
from stage.errors import StorageError
from stage.files import replacing

STEPS = "steps"
"""Folder of the steps that any worker may do."""
KIND = f"{STEPS}/kind"
"""File that says which workers make the same."""
CLAIM = ".claim"
"""Suffix of the files that say who does a piece."""


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


class JobPieces:
    """The pieces of one job, for one worker."""

    def __init__(self, context: WorkerContext, job: Job) -> None:
        self._context, self._job, self._prefix = context, job, layout.shared(job.project, job.id)
        self._invited = 0

    def read(self, name: str) -> bytes | None:
        """Return what a worker has stored under a name, or None."""
        opened = self._context.storage.open(self._prefix, name)
        if opened is None:
            return None
        with open(opened.descriptor, "rb") as file:
            return file.read()

    def write(self, name: str, content: bytes) -> None:
        """Store something under a name, whole or not at all; raise Stopped, and leave nothing, if the job has ended."""
        file = self._context.storage.workspace(self._prefix) / f".{secrets.token_hex(8)}"
        try:
            with replacing(file) as temporary:
                temporary.write_bytes(content)
            self._context.storage.put(file, self._prefix, name)
        except StorageError:  # the job may have ended, and its folder been deleted, between two of these lines
            if is_running(self._context, self._job):
                raise
        if not is_running(self._context, self._job):
            self.remove()
            raise Stopped

    def claim(self, name: str) -> bool:
        """Return whether this worker is to do a piece: False while another, which is still at work, has claimed it."""
        holder = self.read(name)
        if holder is not None and holder.decode() != self._context.worker and holder.decode() in self._at_work():
            return False
        self.write(name, self._context.worker.encode())
        logger.debug("piece begins", job=self._job.id, piece=name.removesuffix(CLAIM), worker=self._context.worker)
        return True

    def invite(self, pieces: int) -> None:
        """Ask workers that have no other work to help with the job, no more than there are pieces beside that of this worker."""
        if (missing := self._missing(pieces)) > 0:
            self._context.queue.ask_for_help(self._job.id, self._job.attempt, self._job.request.priority, missing, self._job.project)
            self._invited += missing

    def invite_to_steps(self, steps: int) -> None:
        """Ask workers of the same kind to help with steps that any of them may do."""
        if self._missing(steps) > 0:
            self.write(KIND, self._kind())
            self.invite(steps)

    def _missing(self, pieces: int) -> int:
        others = {row["id"] for row in workers.seen_lately(self._context.database)} - {self._context.worker}
        return min(len(others), pieces - 1) - self._invited

    def require_same_kind(self) -> None:
        """Make sure that this worker makes the same to the last bit as the worker that has the job; raise Stopped if that has not asked."""
        kind = self.read(KIND)
        if kind is None:
            raise Stopped  # no help with steps is asked for
        if kind != self._kind():
            raise DivergedError("device or versions are not those of the worker that has the job")

    def _kind(self) -> bytes:
        from service.sharing.sharing import kind_of_worker

        return kind_of_worker(self._context.device).encode()

    def finish_step(self, step: str) -> None:
        """Record that a step that any worker may do is done."""
        self.write(f"{STEPS}/{step}", b"")

    def is_finished(self, step: str) -> bool:
        """Return whether a worker has recorded that a step is done."""
        return self.read(f"{STEPS}/{step}") is not None

    def claim_step(self, step: str) -> bool:
        """Return whether this worker is to do a step that any worker may do."""
        return self.claim(f"{STEPS}/{step}{CLAIM}")

    @property
    def are_shared(self) -> bool:
        """Return whether other workers have been asked to help."""
        return self._invited > 0

    @property
    def results(self) -> str:
        """Return the prefix of the results of the job."""
        return layout.results(self._job.project, self._job.id)

    def remove(self) -> None:
        """Delete all pieces."""
        self._context.storage.remove(self._prefix)

    def _at_work(self) -> set[str]:
        seen = {row["id"] for row in workers.seen_lately(self._context.database)}
        return seen & self._context.queue.workers_on(self._job.id)


def is_running(context: WorkerContext, job: Job) -> bool:
    """Return whether some worker has the job in the same attempt."""
    row = jobs.find(context.database, job.id)
    return row is not None and row["state"] == RUNNING and row["attempt"] == job.attempt
