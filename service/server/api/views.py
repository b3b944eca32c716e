"""Views made from rows of the database and files of the storage; service.requests.views declares their fields."""

from collections.abc import Sequence
from datetime import UTC, datetime
from urllib.parse import quote

import sqlalchemy as sa

from service.requests.views.intakes import IntakeView
from service.requests.views.jobs import JobLog, JobView, LogEntry, ProgressView, ResultView
from service.server.storage.folder import StoredFile


def job_view(row: sa.RowMapping) -> JobView:
    """Return the view of a row of `jobs`."""
    progress = None
    if row["stage"] is not None:
        left = max(0, row["total"] - row["done"])
        progress = ProgressView(stage=row["stage"], done=row["done"], total=row["total"], rate=row["rate"],
                                remaining_s=left / row["rate"] if row["rate"] else None)
    return JobView(id=row["id"], state=row["state"], attempt=row["attempt"], revision=row["revision"], priority=row["priority"],
                   request=row["request"], created_at=_time(row["created_at"]), started_at=_time_or_none(row["started_at"]),
                   finished_at=_time_or_none(row["finished_at"]), progress=progress, error=row["error"])


def log_view(rows: Sequence[sa.RowMapping]) -> JobLog:
    """Return the view of rows of `job_log`."""
    return JobLog(entries=[LogEntry(at=_time(row["at"]), attempt=row["attempt"], text=row["text"]) for row in rows])


def intake_view(row: sa.RowMapping) -> IntakeView:
    """Return the view of a row of `intakes`."""
    return IntakeView(id=row["id"], name=row["name"], state=row["state"], registered=row["folder"] is not None, problem=row["problem"],
                      facts=row["facts"], created_at=_time(row["created_at"]))


def result_view(job: str, file: StoredFile) -> ResultView:
    """Return the view of a file that a job has made."""
    return ResultView(name=file.name, size=file.size, modified_at=_time(file.modified_at), url=f"/v1/jobs/{job}/results/{quote(file.name)}")


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


def _time_or_none(seconds: float | None) -> datetime | None:
    return None if seconds is None else _time(seconds)
