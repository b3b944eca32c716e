"""What the API shows: models of its answers."""

from datetime import UTC, datetime
from typing import Annotated, Any, Literal
from urllib.parse import quote

import sqlalchemy as sa
from pydantic import BaseModel, ConfigDict, Field

from service.requests.identifiers import JobId
from service.requests.jobs import AnyJob
from service.server.storage.folder import Stored

Time = Annotated[datetime, Field(description="UTC.")]
JobState = Literal["queued", "running", "succeeded", "failed", "cancelled"]
IntakeState = Literal["receiving", "checking", "ready", "refused"]


class View(BaseModel):
    """Base of every answer: what is said beside a field is in the OpenAPI document too."""

    model_config = ConfigDict(use_attribute_docstrings=True)


class ProgressView(View):
    """Where a running job is."""

    stage: str
    """ingest, normals, frames …"""
    done: int
    total: int
    rate: float | None
    """Steps a second, since the stage began."""
    remaining_s: float | None
    """Of this stage, at that rate."""


class JobView(View):
    """A job."""

    id: JobId
    state: JobState
    attempt: int
    """1, and one more with every retry."""
    revision: int
    """Grows with every change."""
    priority: int
    request: AnyJob
    created_at: Time
    started_at: Time | None
    finished_at: Time | None
    progress: ProgressView | None
    error: str | None
    """Why it failed, in one sentence."""

    @classmethod
    def of(cls, row: sa.RowMapping) -> "JobView":
        """From its row."""
        progress = None
        if row["stage"] is not None:
            left = max(0, row["total"] - row["done"])
            progress = ProgressView(stage=row["stage"], done=row["done"], total=row["total"], rate=row["rate"],
                                    remaining_s=left / row["rate"] if row["rate"] else None)
        return cls(id=row["id"], state=row["state"], attempt=row["attempt"], revision=row["revision"], priority=row["priority"],
                   request=row["request"], created_at=moment(row["created_at"]), started_at=moment_or_none(row["started_at"]),
                   finished_at=moment_or_none(row["finished_at"]), progress=progress, error=row["error"])


class JobPage(View):
    """Jobs, the newest first."""

    jobs: list[JobView]
    next: JobId | None
    """Give it as `before` for the page after this one; null: there is none."""


class IntakeView(View):
    """A capture or an environment."""

    id: str
    name: str
    state: IntakeState
    """receiving: takes files; checking: is being looked at; ready: jobs may use it; refused: `problem` says why."""
    registered: bool
    """Whether it lies in a folder of the server, and was not uploaded."""
    problem: str | None
    facts: dict[str, Any] | None
    """What the check found: captures, frames, resolution …"""
    created_at: Time

    @classmethod
    def of(cls, row: sa.RowMapping) -> "IntakeView":
        """From its row."""
        return cls(id=row["id"], name=row["name"], state=row["state"], registered=row["folder"] is not None, problem=row["problem"],
                   facts=row["facts"], created_at=moment(row["created_at"]))


class IntakePage(View):
    """Captures or environments, the newest first."""

    items: list[IntakeView]
    next: str | None
    """Give it as `before` for the page after this one; null: there is none."""


class ResultView(View):
    """A file that a job has made."""

    name: str
    """Below the job, / between folders."""
    size: int
    """Bytes."""
    modified_at: Time
    url: str
    """Where it is downloaded, on this server."""

    @classmethod
    def of(cls, job: str, file: Stored) -> "ResultView":
        """From what the storage lists."""
        return cls(name=file.name, size=file.size, modified_at=moment(file.modified_at), url=f"/v1/jobs/{job}/results/{quote(file.name)}")


class ResultPage(View):
    """What a job has made, by name."""

    results: list[ResultView]
    next: str | None
    """Give it as `after` for the page after this one; null: there is none."""


def moment(seconds: float) -> datetime:
    """Seconds since 1970 as a time in UTC."""
    return datetime.fromtimestamp(seconds, UTC)


def moment_or_none(seconds: float | None) -> datetime | None:
    """The same, of what may not have happened."""
    return None if seconds is None else moment(seconds)
