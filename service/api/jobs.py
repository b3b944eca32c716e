"""Jobs: handed in, looked at, cancelled, begun again, deleted."""

from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Body, Query, Response
from pydantic import BaseModel, ConfigDict, Field

from service.api.context import Behind, IdempotencyKey, Reader, Service, Writer, once
from service.api.problems import ApiError, responses
from service.api.submission import inputs_of, require_space, spelled_out, submit
from service.api.views import JobPage, JobState, JobView
from service.identifiers import JobId
from service.job_requests import ANY_JOB, UserJob
from service.storage import layout
from service.store import jobs
from service.store.keys import Caller

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=responses(401, 403, 422, 429, 503))

EXAMPLES = {
    "solve": {"value": {"kind": "solve", "capture": "cap_0123456789abcdefghjk"}},
    "relight": {"value": {"kind": "relight", "capture": "cap_0123456789abcdefghjk", "environment": "env_0123456789abcdefghjk",
                          "options": {"frames": "1-24", "spin_degrees": 360}}},
    "pipeline": {"value": {"kind": "pipeline", "capture": "cap_0123456789abcdefghjk", "environment": "env_0123456789abcdefghjk",
                           "relight": {"frames": "1-240", "spin_degrees": 360}, "guided": True}},
}


class Priority(BaseModel):
    """How soon a job that has not begun goes."""

    model_config = ConfigDict(extra="forbid")

    priority: Annotated[int, Field(ge=0, le=100)]


@router.post("", status_code=202, responses=responses(409, 507), summary="Hand a job in")
def create(behind: Behind, caller: Writer, response: Response, request: Annotated[UserJob, Body(openapi_examples=EXAMPLES)],
           token: IdempotencyKey = None) -> JobView:
    """Queue a job. Its Location has its state; /events streams it, /results has what it made."""
    require_space(behind)
    asked = request.model_dump(mode="json", by_alias=True)
    inputs = inputs_of(behind, caller.project, request)
    spelled = spelled_out(behind, caller.project, request)
    job, _ = once(behind, caller, token, ["job", asked], lambda connection: submit(behind, caller, spelled, connection, inputs))
    response.headers["Location"] = f"/v1/jobs/{job}"
    return view(behind, caller, job)


@router.get("", summary="List jobs, the newest first")
def listing(behind: Behind, caller: Reader, state: Annotated[list[JobState] | None, Query()] = None,
            limit: Annotated[int, Query(ge=1, le=500)] = 100,
            before: Annotated[JobId | None, Query(description="`next` of the page before.")] = None) -> JobPage:
    """Jobs of the project, a page at a time."""
    after = None
    if before is not None:
        row = jobs.find(behind.database, before, caller.project)
        if row is None:
            raise ApiError("invalid", f"before: {before} is not in this project")
        after = row["created_at"], row["id"]
    rows = jobs.latest(behind.database, caller.project, states=state or (), limit=limit + 1, before=after)
    return JobPage(jobs=[JobView.of(row) for row in rows[:limit]], next=rows[limit - 1]["id"] if len(rows) > limit else None)


@router.get("/{job}", responses=responses(404), summary="Look at a job")
def look(behind: Behind, caller: Reader, job: JobId) -> JobView:
    """State, progress and error of a job."""
    return view(behind, caller, job)


@router.post("/{job}/cancel", status_code=202, responses=responses(404, 409), summary="Cancel a job")
def cancel(behind: Behind, caller: Writer, job: JobId) -> JobView:
    """Stop a job: at once where it waits, else at its next sign of progress. What it has made stays."""
    before = view(behind, caller, job)
    if not behind.database.transact(lambda connection: jobs.cancel(connection, job)):
        raise ApiError("conflict", f"{job} is {before.state}: it has ended")
    behind.queue.call_off(job, before.attempt)
    return view(behind, caller, job)


@router.post("/{job}/retry", status_code=202, responses=responses(404, 409, 507), summary="Try a failed job again")
def retry(behind: Behind, caller: Writer, job: JobId) -> JobView:
    """Begin a failed job again; steps and frames that are done stay."""
    return _again(behind, caller, job, jobs.FAILED)


@router.post("/{job}/resume", status_code=202, responses=responses(404, 409, 507), summary="Go on with a cancelled job")
def resume(behind: Behind, caller: Writer, job: JobId) -> JobView:
    """Go on with a cancelled job; steps and frames that are done stay."""
    return _again(behind, caller, job, jobs.CANCELLED)


@router.patch("/{job}", responses=responses(404, 409), summary="Change the priority of a job")
def reprioritise(behind: Behind, caller: Writer, job: JobId, wanted: Priority) -> JobView:
    """Give a job that has not begun another priority."""
    before = view(behind, caller, job)

    def work(connection: sa.Connection) -> bool:
        attempt = jobs.set_priority(connection, job, wanted.priority)
        if attempt is not None:
            behind.queue.enqueue(connection, job, attempt, ANY_JOB.validate_python(before.request.model_dump(by_alias=True)),
                                 wanted.priority)
        return attempt is not None

    if not behind.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}: only a queued job has a priority to change")
    behind.queue.call_off(job, before.attempt)
    return view(behind, caller, job)


@router.delete("/{job}", status_code=204, responses=responses(404, 409), summary="Delete a job and its results")
def delete(behind: Behind, caller: Writer, job: JobId) -> None:
    """Remove a job that has ended, with all that it made."""
    before = view(behind, caller, job)

    def work(connection: sa.Connection) -> bool:
        if users := jobs.users_of(connection, job, active=True):
            raise ApiError("conflict", f"{job} is read by {users[0]}, which has not ended")
        return jobs.remove(connection, job)

    if not behind.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}: cancel it first")
    behind.storage.remove(layout.results(caller.project, job))
    behind.queue.forget(job, before.attempt)


def view(behind: Service, caller: Caller, job: str) -> JobView:
    """A job of the caller's project.

    Raises:
        ApiError: there is none.
    """
    row = jobs.find(behind.database, job, caller.project)
    if row is None:
        raise ApiError("not-found", f"there is no {job} in this project")
    return JobView.of(row)


def _again(behind: Service, caller: Caller, job: str, state: str) -> JobView:
    require_space(behind)
    before = view(behind, caller, job)
    request = before.request

    def work(connection: sa.Connection) -> bool:
        attempt = jobs.begin_again(connection, job, state)
        if attempt is not None:
            behind.queue.enqueue(connection, job, attempt, request, before.priority)
        return attempt is not None

    if not behind.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}, not {state}")
    return view(behind, caller, job)
