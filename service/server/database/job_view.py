"""The view of a job, which answers, events and deliveries to hooks have in common."""

from typing import Any

import sqlalchemy as sa

from service.requests.answers import JobView, ProgressView


def job_view(row: sa.RowMapping | dict[str, Any]) -> JobView:
    """Return the view of a row of `jobs`."""
    progress = None
    if row["stage"] is not None:
        left = max(0, row["total"] - row["done"])
        progress = ProgressView(stage=row["stage"], done=row["done"], total=row["total"], rate=row["rate"],
                                remaining_s=left / row["rate"] if row["rate"] else None)
    return JobView.model_validate({**row, "progress": progress})
