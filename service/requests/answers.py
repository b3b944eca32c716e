"""The models of the answers of the service, views for short, shared by the API and its client."""

from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from service.requests.base.identifiers import HookId, JobId, UploadId
from service.requests.hooks import HookEvent
from service.requests.jobs import StoredJob
from service.requests.keys import Scope
from service.requests.states import IntakeState, JobState

Time = Annotated[datetime, Field(description="UTC.")]


class View(BaseModel):
    """Base of every answer; the docstring of a field is its description in the OpenAPI document."""

    model_config = ConfigDict(use_attribute_docstrings=True)


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
    request: StoredJob
    created_at: Time
    started_at: Time | None
    finished_at: Time | None
    progress: ProgressView | None
    error: str | None
    """The reason why the job failed, in one sentence."""

    @classmethod
    def of(cls, row: Mapping[Any, Any]) -> Self:
        """Return the view of a row of the service's table of jobs."""
        progress = None
        if row["stage"] is not None:
            left = max(0, row["total"] - row["done"])
            progress = ProgressView(stage=row["stage"], done=row["done"], total=row["total"], rate=row["rate"],
                                    remaining_s=left / row["rate"] if row["rate"] else None)
        return cls.model_validate({**row, "progress": progress})


WARNING = "warning: "
"""The beginning of the entry of a log that is a warning about what a job has made."""


class LogEntry(View):
    """Something that happened to a job."""

    at: Time
    attempt: int
    text: str


class JobLog(View):
    """The events of a job, the oldest first; of a long log, the first thousand entries."""

    entries: list[LogEntry]

    @property
    def warnings(self) -> list[str]:
        """The warnings about what the job has made."""
        return [entry.text.removeprefix(WARNING) for entry in self.entries if entry.text.startswith(WARNING)]


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


class IntakeView(View):
    """A capture or an environment."""

    id: str
    name: str
    state: IntakeState
    """receiving: takes files; checking: is being looked at; ready: jobs may use it; refused: `problem` says why."""
    registered: bool
    """True if it lies in a folder of the server, and was not uploaded."""
    problem: str | None
    facts: dict[str, Any] | None
    """The findings of the check: captures, frames, resolution …; before an import `proposal`, what the files seem to be."""
    view: JobId | None = None
    """The newest job of the kind view that has prepared the capture, whose results have its pictures; null: none has."""
    created_at: Time


class IntakePage(View):
    """Captures or environments, the newest first."""

    items: list[IntakeView]
    next: str | None
    """Give it as `before` for the page after this one; null: this is the last page."""


class FileView(View):
    """A file of a capture or environment."""

    upload: UploadId
    """Its bytes are sent to, and it is deleted at, /v1/uploads/ and this."""
    path: str
    length: int
    received: int
    """Bytes that are safe."""
    done: bool
    sha256: str | None
    """As the client said it; where the file is done, also as it was found."""


class FilePage(View):
    """Files, in the order of their paths; upper and lower case count as the same."""

    files: list[FileView]
    next: str | None
    """Give it as `after` for the page after this one; null: this is the last page."""


class NeededFile(View):
    """A file of a folder that is needed for a capture."""

    path: str
    """Below the folder that was listed."""
    name: str
    """Its path in the capture."""
    length: int


class CaptureFiles(View):
    """The files of one capture."""

    folder: str
    """The folder of the capture below the one that was listed; empty: that folder."""
    files: list[NeededFile]


class NeededFiles(View):
    """The captures that a folder may hold."""

    captures: list[CaptureFiles]


class DeliveryView(View):
    """An event that a hook is told of."""

    id: str
    """The `webhook-id` of every try."""
    event: HookEvent | Literal["test"]
    job: JobId | None
    """The job that ended; None: a test."""
    state: Literal["waiting", "delivered", "given_up"]
    tries: int
    made_at: Time
    tried_at: Time | None
    answer: str | None
    """The status of the answer to the last try, or why there was none; None: it was not tried yet, or is being tried."""


class HookView(View):
    """A URL that is told how the jobs of the project have ended."""

    id: HookId
    url: str
    events: list[HookEvent]
    created_at: Time
    due_at: Time
    """Nothing is tried before this time: a pause after a refusal, or the time within which the try under way ends."""
    waiting: int
    """Deliveries that the receiver has not accepted yet."""
    last_delivery: DeliveryView | None
    """The delivery that was tried last."""


class NewHookView(HookView):
    """A new hook."""

    secret: str
    """The secret that signs, in the form of Standard Webhooks; it is not shown again."""


class HookList(View):
    """The hooks of a project, the oldest first."""

    hooks: list[HookView]


class WorkerView(View):
    """A worker that was seen lately."""

    id: str
    host: str
    pid: int
    device: str
    """cpu, cuda:0 …"""
    state: Literal["ready", "draining"]
    """draining: it finishes what it has, and takes no more."""
    started_at: Time
    seen_at: Time
    busy: bool
    """True if it does a job or helps with one, of whatever project."""
    job: JobView | None
    """The job that it does or helps with; null: it has none, or one of another project."""
    asked: Literal["drain", "kill"] | None = None
    """What an operator has asked of it, which it does within seconds; null: nothing."""


class DiskView(View):
    """The file system of the data folder."""

    free: int
    """Bytes."""
    total: int
    """Bytes."""
    least_free: int
    """Bytes below which the service takes neither uploads nor jobs."""


class ProjectView(View):
    """The project of the key that asks, and what the key may do there."""

    name: str
    scope: Scope


class MachinesView(View):
    """Workers, the queue and the space of the service."""

    workers: list[WorkerView]
    """The oldest first."""
    jobs: dict[JobState, int]
    """Jobs of all projects in each state."""
    queued_since: Time | None
    """Time at which the job was queued that has waited longest; null: none waits."""
    disk: DiskView
    faults: list[str]
    """Reasons why the service is not ready for work, as /readyz gives them."""


class AuditEntry(View):
    """A line of the audit log: who did what to which object."""

    id: int
    at: Time
    actor: str
    """Identifier of a key, a user of an identity provider, anonymous, or an operator of the server."""
    action: str
    """job.cancel, intake.create …"""
    object: str
    request: str | None
    """The identifier of the request; null: the command line of the server."""


class AuditPage(View):
    """Lines of the audit log, the newest first."""

    entries: list[AuditEntry]
    next: int | None
    """Give it as `before` for the page after this one; null: this is the last page."""
