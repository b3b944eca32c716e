"""Views made from rows of the database and files of the storage; service.requests.answers declares their fields."""

from collections.abc import Sequence
from urllib.parse import quote

import sqlalchemy as sa

from service.requests.answers import IntakeView, ResultView
from service.server.database import jobs
from service.server.database.engine import Database
from service.server.storage.folder import StoredFile


def intake_views(database: Database, rows: Sequence[sa.RowMapping]) -> list[IntakeView]:
    """Return the views of rows of `intakes`."""
    views = jobs.views_of(database, [row["id"] for row in rows])
    return [IntakeView.model_validate({**row, "registered": row["folder"] is not None, "view": views.get(row["id"])}) for row in rows]


def result_view(job: str, file: StoredFile) -> ResultView:
    """Return the view of a file that a job has made."""
    return ResultView.model_validate({**file._asdict(), "url": f"/v1/jobs/{job}/results/{quote(file.name)}"})
