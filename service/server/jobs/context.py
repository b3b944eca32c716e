"""The arguments of the steps of a job: the worker that does them, and the job."""

import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

import sqlalchemy as sa

from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.base.base import JobRequest
from service.requests.jobs import ANY_JOB
from service.server.base.settings import Settings
from service.server.database.engine import Database
from service.server.jobs.queue import JobQueue
from service.server.storage.objects import Storage


class WorkerContext(NamedTuple):
    """Services and settings that the steps of a worker need."""

    settings: Settings
    database: Database
    storage: Storage
    queue: JobQueue
    """The queue in which other workers are asked to help."""
    device: str
    worker: str
    """Name of the worker."""
    held: ExitStack = ExitStack()
    """Closes the folders of registered captures when a step ends."""

    def require_space(self) -> None:
        """Raise RequestError if less than `min_free_bytes` are left in the data folder."""
        if shutil.disk_usage(self.settings.data).free < self.settings.min_free_bytes:
            raise RequestError("the service has no space left for this job (min_free_bytes): retry it when there is")


class Job(NamedTuple):
    """The parts of a job's row that its steps need."""

    id: str
    project: str
    request: JobRequest
    chunk_frames: int
    attempt: int = 1
    is_resumed: bool = False
    """True if the job has lost a worker since it last made progress."""

    @classmethod
    def of(cls, row: sa.RowMapping | Mapping[str, Any]) -> "Job":
        """Read a row of the jobs table."""
        return cls(row["id"], row["project"], ANY_JOB.validate_python(row["request"]), row["chunk_frames"], row["attempt"],
                   row["lost"] > 0 or row["lost_repeating"] > 0)


SEQUENCE = "sequence"
"""Name of the last step of a solve or a depth of a sequence, which joins its time steps."""


class JobStep(NamedTuple):
    """A part of a job that is done as a whole or again."""

    name: str
    run: Callable[[Progress], None]
    frames: int = 0
    """Number of frames that the step makes, at the same time as other workers make those of other steps."""
    made: Callable[[], int] = lambda: 0
    """Returns how many of these frames this machine has."""
    help: Callable[[Progress], None] | None = None
    """A function that does pieces of the step beside the worker that runs it; None: it cannot be divided."""
