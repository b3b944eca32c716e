"""Quotas: what one project may have, whichever API process is asked.

What a project has is counted in the transaction that adds to it, under a lock of the project, so that two requests at once cannot both take
the last place.
"""

from collections.abc import Callable
from typing import Any

import sqlalchemy as sa

from service.errors import RequestError
from service.requests.states import ACTIVE, READY
from service.server.base.settings import QUOTAS, Settings
from service.server.database.engine import lock_project
from service.server.database.tables import hooks, intakes, jobs, uploads

BYTES, CAPTURES, JOBS, PIXELS, HOOKS = QUOTAS


class QuotaExceeded(RequestError):
    """The project has as much as it may; the message names the quota."""

    def __init__(self, quota: str, project: str, limit: int, used: int, more: int) -> None:
        super().__init__(f"quota {quota}: the project {project} has {used} of {limit} {UNITS[quota]}, and this needs {more} more")
        self.quota = quota


def require(connection: sa.Connection, settings: Settings, quota: str, project: str, more: int) -> None:
    """Check a quota before `more` of its unit is added in the caller's transaction; other requests of the project wait for its end."""
    limit = settings.quota_of(project, quota)
    if limit is None:
        return
    lock_project(connection, project)
    used = USED[quota](connection, project)
    if used + more > limit:
        raise QuotaExceeded(quota, project, limit, used, more)


def pixels_of(facts: dict[str, Any] | None) -> int:
    """Return the pixels of all images of a capture or environment, from the facts that its check found."""
    if not facts or "resolution" not in facts:
        return 0
    width, height = facts["resolution"]
    return int(width) * int(height) * int(facts.get("frames", 1))


def _bytes(connection: sa.Connection, project: str) -> int:
    files = sa.select(sa.func.coalesce(sa.func.sum(uploads.c.length), 0)).where(uploads.c.project == project)
    results = sa.select(sa.func.coalesce(sa.func.sum(jobs.c.result_bytes), 0)).where(jobs.c.project == project)
    return int(connection.execute(files).scalar_one()) + int(connection.execute(results).scalar_one())


def _rows_of(table: sa.Table, *counted: "sa.ColumnElement[bool]") -> Callable[[sa.Connection, str], int]:
    """Return the function that counts the rows of a project for which all of some conditions hold."""
    return lambda connection, project: connection.execute(
        sa.select(sa.func.count()).where(table.c.project == project, *counted)).scalar_one()


def _pixels(connection: sa.Connection, project: str) -> int:
    rows = connection.execute(sa.select(intakes.c.facts).where(intakes.c.project == project, intakes.c.state == READY)).scalars()
    return sum(pixels_of(facts) for facts in rows)


USED: dict[str, Callable[[sa.Connection, str], int]] = {
    BYTES: _bytes, PIXELS: _pixels, CAPTURES: _rows_of(intakes), HOOKS: _rows_of(hooks),
    JOBS: _rows_of(jobs, jobs.c.state.in_(ACTIVE), jobs.c.request["kind"].as_string() != "check")}
UNITS = {BYTES: "bytes", CAPTURES: "captures and environments", JOBS: "jobs", PIXELS: "pixels", HOOKS: "hooks"}
