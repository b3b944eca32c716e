"""Views of jobs and of the files that jobs make."""

from service.requests.base.identifiers import JobId
from service.requests.jobs import AnyJob
from service.requests.views import Time, View
from service.requests.views.states import JobState


class ProgressView(View):
    """The progress of a running job."""

    stage: str
    """ingest, normals, frames …"""
    done: int
    total: int
    rate: float | None
    """Units of `done` per second, since the stage began."""
    remaining_s: float | None
    """Seconds until this stage ends, at that rate."""


class JobView(View):
    """A job."""

    id: JobId
    state: JobState
    attempt: int
    """1, and one more each time the job is retried or resumed."""
    revision: int
    """Grows with every change."""
    priority: int
    request: AnyJob
    created_at: Time
    started_at: Time | None
    finished_at: Time | None
    progress: ProgressView | None
    error: str | None
    """The reason why the job failed, in one sentence."""


class LogEntry(View):
    """Something that happened to a job."""

    at: Time
    attempt: int
    text: str


class JobLog(View):
    """The events of a job, the oldest first; of a long log, the first thousand entries."""

    entries: list[LogEntry]


class JobPage(View):
    """Jobs, the newest first."""

    jobs: list[JobView]
    next: JobId | None
    """Give it as `before` for the page after this one; null: this is the last page."""


class ResultView(View):
    """A file that a job has made."""

    name: str
    """Path below the job's results, with / between folders."""
    size: int
    """Bytes."""
    modified_at: Time
    url: str
    """Path of its download on this server."""


class ResultPage(View):
    """Files that a job has made, by name."""

    results: list[ResultView]
    next: str | None
    """Give it as `after` for the page after this one; null: this is the last page."""
