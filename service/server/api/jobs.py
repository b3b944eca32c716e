"""Jobs: handed in, looked at, cancelled, begun again, deleted."""

from collections.abc import Sequence
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Body, Path, Query, Response
from fastapi.openapi.models import Example
from pydantic import BaseModel, ConfigDict, Field

from service.requests.identifiers import JobId
from service.requests.jobs import CheckJob, JobRequest, UserJob
from service.server.api.context import IdempotencyKey, Reader, Service, ServiceDep, Writer, made_before, once
from service.server.api.exact import Exact
from service.server.api.problems import ApiError, responses
from service.server.api.space import FOR_WORK, require_space
from service.server.api.submission import inputs_of, require_queue, spelled_out, submit
from service.server.api.views import job_view
from service.server.database import jobs
from service.server.database.keys import Caller
from service.server.storage import layout
from service.views import states
from service.views.jobs import JobPage, JobView

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=responses(401, 403, 422, 429, 503))

CAPTURE, SKY, SOLVED = "cap_0123456789abcdefghjk", "env_0123456789abcdefghjk", "job_0123456789abcdefghjk"
EXAMPLES: dict[str, Example] = {
    "solve": {"value": {"kind": "solve", "capture": CAPTURE, "options": {"method": "robust"}}},
    "depth": {"value": {"kind": "depth", "capture": CAPTURE, "options": {"normals": True}}},
    "relight": {"value": {"kind": "relight", "capture": CAPTURE, "environment": SKY, "options": {"frames": "1-24", "spin_degrees": 360}}},
    "shade": {"value": {"kind": "shade", "maps": SOLVED, "options": {
        "light": [{"position_m": [0.2, 0.3, 0.5], "intensity": [1, 1, 1]}], "exposure": -1}}},
    "export": {"value": {"kind": "export", "maps": SOLVED, "format": "usdz"}},
    "pipeline": {"value": {"kind": "pipeline", "capture": CAPTURE, "environment": SKY, "guided": True,
                           "relight": {"frames": "1-240", "spin_degrees": 360}}},
}
JobName = Annotated[JobId, Path(description="Identifier of the job.")]
Asked = Annotated[JobRequest, Exact(UserJob), Body(openapi_examples=EXAMPLES)]
States = Annotated[Sequence[states.JobState], Query(description="Of these states alone; none: of all.")]


class Priority(BaseModel):
    """How soon a job that has not begun goes."""

    model_config = ConfigDict(extra="forbid")

    priority: Annotated[int, Field(ge=0, le=100, strict=True, description="Higher goes first.")]


@router.post("", status_code=202, responses=responses(404, 409, 507), summary="Hand a job in")
def create_job(service: ServiceDep, caller: Writer, response: Response, request: Asked, token: IdempotencyKey = None) -> JobView:
    """Queue a job. Its Location has its state; /events streams it, /results has what it made."""
    asked = ["job", request.model_dump(mode="json", by_alias=True)]
    job = made_before(service, caller, token, asked)
    if job is None:
        require_space(service, FOR_WORK)
        inputs = inputs_of(service, caller.project, request)
        spelled = spelled_out(service, caller.project, request)
        job, _ = once(service, caller, token, asked, lambda connection: submit(service, caller, spelled, connection, inputs))
    response.headers["Location"] = f"/v1/jobs/{job}"
    return view(service, caller, job)


@router.get("", responses=responses(404), summary="List jobs, the newest first")
def list_jobs(service: ServiceDep, caller: Reader, state: States = (),
              limit: Annotated[int, Query(ge=1, le=500)] = 100,
              before: Annotated[JobId | None, Query(description="`next` of the page before.")] = None) -> JobPage:
    """Jobs of the project, a page at a time."""
    after = None
    if before is not None:
        row = jobs.find(service.database, before, caller.project)
        if row is None:
            raise ApiError("not-found", f"before: {before} is not in this project")
        after = row["created_at"], row["id"]
    rows = jobs.latest(service.database, caller.project, states=state, limit=limit + 1, before=after)
    return JobPage(jobs=[job_view(row) for row in rows[:limit]], next=rows[limit - 1]["id"] if len(rows) > limit else None)


@router.get("/{job}", responses=responses(404), summary="Look at a job")
def get_job(service: ServiceDep, caller: Reader, job: JobName) -> JobView:
    """State, progress and error of a job."""
    return view(service, caller, job)


@router.post("/{job}/cancel", status_code=202, responses=responses(404, 409), summary="Cancel a job")
def cancel_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Stop a job: at once where it waits, else at its next sign of progress. What it has made stays."""
    before = view(service, caller, job)
    if not service.database.transact(lambda connection: jobs.cancel(connection, job)):
        raise ApiError("conflict", f"{job} is {before.state}: it has ended")
    service.queue.cancel(job, before.attempt)
    return view(service, caller, job)


@router.post("/{job}/retry", status_code=202, responses=responses(404, 409, 507), summary="Try a failed job again")
def retry_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Begin a failed job again; steps and frames that are done stay."""
    return _again(service, caller, job, states.FAILED)


@router.post("/{job}/resume", status_code=202, responses=responses(404, 409, 507), summary="Go on with a cancelled job")
def resume_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Go on with a cancelled job; steps and frames that are done stay."""
    return _again(service, caller, job, states.CANCELLED)


@router.patch("/{job}", responses=responses(404, 409), summary="Change the priority of a job")
def change_priority(service: ServiceDep, caller: Writer, job: JobName,
                    wanted: Annotated[Priority, Body(openapi_examples={"sooner": {"value": {"priority": 90}}})]) -> JobView:
    """Give a job that has not begun another priority."""
    before = view(service, caller, job)

    def work(connection: sa.Connection) -> bool:
        attempt = jobs.set_priority(connection, job, wanted.priority)
        if attempt is not None:
            service.queue.set_priority(connection, job, attempt, wanted.priority)
        return attempt is not None

    if not service.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}: only a queued job has a priority to change")
    return view(service, caller, job)


@router.delete("/{job}", status_code=204, responses=responses(404, 409), summary="Delete a job and its results")
def delete_job(service: ServiceDep, caller: Writer, job: JobName) -> None:
    """Remove a job that has ended, with all that it made."""
    before = view(service, caller, job)

    def work(connection: sa.Connection) -> bool:
        if users := jobs.users_of(connection, job, active=True):
            raise ApiError("conflict", f"{job} is read by {users[0]}, which has not ended")
        return jobs.remove(connection, job)

    if not service.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}: cancel it first")
    service.storage.remove(layout.results(caller.project, job))
    service.queue.forget(job, before.attempt)


def job_of(service: ServiceDep, caller: Reader, job: JobName) -> JobView:
    """The job that a path names."""
    return view(service, caller, job)


def view(service: Service, caller: Caller, job: str) -> JobView:
    """A job of the caller's project.

    Raises:
        ApiError: there is none.
    """
    row = jobs.find(service.database, job, caller.project)
    if row is None:
        raise ApiError("not-found", f"there is no {job} in this project")
    return job_view(row)


def _again(service: Service, caller: Caller, job: str, state: str) -> JobView:
    require_space(service, FOR_WORK)
    before = view(service, caller, job)
    request = before.request
    if isinstance(request, CheckJob):
        raise ApiError("conflict", f"{job} is a check: validate {request.intake} again")

    def work(connection: sa.Connection) -> bool:
        attempt = jobs.queue_again(connection, job, state)
        if attempt is not None:
            service.queue.enqueue(connection, job, attempt, request, before.priority)
            require_queue(service, caller, connection)
        return attempt is not None

    if not service.database.transact(work):
        raise ApiError("conflict", f"{job} is {before.state}, not {state}")
    return view(service, caller, job)
