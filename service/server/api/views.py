"""Views made from rows of the database and files of the storage; service.requests.answers declares their fields."""

from urllib.parse import quote

import sqlalchemy as sa

from service.requests.answers import IntakeView, ResultView
from service.server.storage.folder import StoredFile


def intake_view(row: sa.RowMapping) -> IntakeView:
    """Return the view of a row of `intakes`."""
    return IntakeView.model_validate({**row, "registered": row["folder"] is not None})


def result_view(job: str, file: StoredFile) -> ResultView:
    """Return the view of a file that a job has made."""
    return ResultView.model_validate({**file._asdict(), "url": f"/v1/jobs/{job}/results/{quote(file.name)}"})
