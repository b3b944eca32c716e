"""Views made from rows of the database and files of the storage; service.requests.answers declares their fields."""

from typing import Any
from urllib.parse import quote

import sqlalchemy as sa

from service.requests.answers import IntakeView, JobView, ProgressView, ResultView
from service.server.storage.folder import StoredFile


def job_view(row: sa.RowMapping | dict[str, Any]) -> JobView:
    """Return the view of a row of `jobs`."""
    progress = None
    if row["stage"] is not None:
        left = max(0, row["total"] - row["done"])
        progress = ProgressView(stage=row["stage"], done=row["done"], total=row["total"], rate=row["rate"],
                                remaining_s=left / row["rate"] if row["rate"] else None)
    return JobView.model_validate({**row, "progress": progress})


def intake_view(row: sa.RowMapping) -> IntakeView:
    """Return the view of a row of `intakes`."""
    return IntakeView.model_validate({**row, "registered": row["folder"] is not None})


def result_view(job: str, file: StoredFile) -> ResultView:
    """Return the view of a file that a job has made."""
    return ResultView.model_validate({**file._asdict(), "url": f"/v1/jobs/{job}/results/{quote(file.name)}"})
