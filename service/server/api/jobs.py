"""Routes of jobs: submit, look at, cancel, retry, resume, change the priority, delete."""

import json
from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Body, Path, Query, Response
from fastapi.openapi.models import Example
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, TypeAdapter
from pydantic_core import CoreSchema, core_schema

from service.requests import states
from service.requests.answers import JobLog, JobPage, JobView
from service.requests.base.base import JobRequest
from service.requests.base.identifiers import JobId
from service.requests.jobs import CheckJob, UserJob
from service.server.api.context import FOR_WORK, IdempotencyKey, Reader, Service, ServiceDep, Writer, require_space
from service.server.api.json_body import JsonRoute
from service.server.api.problems import ApiError, found_in_project, responses
from service.server.api.submission import inputs_of, require_queue, spelled_out, submit
from service.server.database import audit, idempotency, jobs, quotas
from service.server.database.keys import Caller
from service.server.jobs.queue import workflow_id
from service.server.storage import layout

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=responses(401, 403, 422, 429, 503), route_class=JsonRoute)

CAPTURE, SKY, SOLVED = "cap_0123456789abcdefghjk", "env_0123456789abcdefghjk", "job_0123456789abcdefghjk"
EXAMPLES: dict[str, Example] = {
    "solve": {"value": {"kind": "solve", "capture": CAPTURE, "options": {"method": "robust"}}},
    "depth": {"value": {"kind": "depth", "capture": CAPTURE, "options": {"normals": True}}},
    "relight": {"value": {"kind": "relight", "capture": CAPTURE, "environment": SKY, "options": {"frames": "1-24", "spin_degrees": 360}}},
    "shade": {"value": {"kind": "shade", "maps": SOLVED, "options": {
        "light": [{"position_m": [0.2, 0.3, 0.5], "intensity": [1, 1, 1]}], "exposure": -1}}},
    "export": {"value": {"kind": "export", "maps": SOLVED, "format": "usdz"}},
    "view": {"value": {"kind": "view", "capture": CAPTURE, "maps": SOLVED}},
    "pipeline": {"value": {"kind": "pipeline", "capture": CAPTURE, "environment": SKY, "guided": True,
                           "relight": {"frames": "1-240", "spin_degrees": 360}}},
}


class StrictJson:
    """Annotation of a body that is read as JSON of the given type, without conversions: "5" is not taken for 5, nor 1 for true.

    FastAPI gives Pydantic Python objects, and of these it converts values, which the OpenAPI document does not promise. Its strict mode
    works for JSON text only: of Python objects it refuses every list for a tuple and every text for an enumeration.
    """

    def __init__(self, kind: Any) -> None:
        self._kind, self._adapter = kind, TypeAdapter[Any](kind)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Return the schema of the type, with the strict reader."""
        return core_schema.no_info_wrap_validator_function(
            lambda value, _: self._adapter.validate_json(json.dumps(value), strict=True), handler.generate_schema(self._kind))


JobName = Annotated[JobId, Path(description="Identifier of the job.")]
Asked = Annotated[JobRequest, StrictJson(UserJob), Body(openapi_examples=EXAMPLES)]
States = Annotated[Sequence[states.JobState], Query(description="Of these states alone; none: of all.")]

Kinds = Annotated[Sequence[Annotated[str, Field(max_length=40, pattern=r"^[a-z-]+$")]],
                  Query(description="Of these kinds alone, such as calibrate-dark; none: of all.", max_length=64)]


class Priority(BaseModel):
    """The priority of a queued job."""

    model_config = ConfigDict(extra="forbid")

    priority: Annotated[int, Field(ge=0, le=100, strict=True, description="Higher goes first.")]


@router.post("", status_code=202, responses=responses(404, 409, 507), summary="Submit a job")
def create_job(service: ServiceDep, caller: Writer, response: Response, request: Asked, token: IdempotencyKey = None) -> JobView:
    """Queue a job. Its Location gives its state, /events streams its changes, /results lists its files."""
    asked = ["job", request.model_dump(mode="json", by_alias=True)]
    job = idempotency.created_by(service.database, caller.project, token, asked)
    if job is None:
        require_space(service, FOR_WORK)
        inputs = inputs_of(service, caller.project, request)
        spelled = spelled_out(service, caller.project, request)
        job = idempotency.create_once(service.database, caller.project, token, asked,
                                      lambda connection: submit(service, caller, spelled, connection, inputs))
    response.headers["Location"] = f"/v1/jobs/{job}"
    return view(service, caller, job)


@router.get("", responses=responses(404), summary="List jobs, the newest first")
def list_jobs(service: ServiceDep, caller: Reader, state: States = (), kind: Kinds = (),
              limit: Annotated[int, Query(ge=1, le=500)] = 100,
              before: Annotated[JobId | None, Query(description="`next` of the page before.")] = None) -> JobPage:
    """List the jobs of the project, one page at a time."""
    after = None if before is None else found_in_project(jobs.find(service.database, before, caller.project), before)
    rows = jobs.latest(service.database, caller.project, states=state, kinds=kind, limit=limit + 1, before=after)
    return JobPage(jobs=[JobView.of(row) for row in rows[:limit]], next=rows[limit - 1]["id"] if len(rows) > limit else None)


@router.get("/{job}", responses=responses(404), summary="Look at a job")
def get_job(service: ServiceDep, caller: Reader, job: JobName) -> JobView:
    """Return state, progress and error of a job."""
    return view(service, caller, job)


@router.get("/{job}/log", responses=responses(404), summary="Look at the log of a job")
def get_log(service: ServiceDep, caller: Reader, job: JobName) -> JobLog:
    """Return what happened to a job and when: its stages, workers that it lost, and how it ended."""
    view(service, caller, job)
    return JobLog.model_validate({"entries": [dict(row) for row in jobs.log_of(service.database, job)]})


@router.post("/{job}/cancel", status_code=202, responses=responses(404, 409), summary="Cancel a job")
def cancel_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Cancel a job: at once if it is queued, else at its next sign of progress. Its results stay."""
    before = view(service, caller, job)
    with audit.recorded(service.database, caller, "job.cancel", job) as connection:
        if not jobs.cancel(connection, job):
            raise ApiError("conflict", f"{job} is {before.state}: it has ended")
    service.queue.cancel(workflow_id(job, before.attempt))
    return view(service, caller, job)


@router.post("/{job}/retry", status_code=202, responses=responses(404, 409, 507), summary="Retry a failed job")
def retry_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Queue a failed job again; its finished steps and frames are kept."""
    return _again(service, caller, job, states.FAILED)


@router.post("/{job}/resume", status_code=202, responses=responses(404, 409, 507), summary="Resume a cancelled job")
def resume_job(service: ServiceDep, caller: Writer, job: JobName) -> JobView:
    """Queue a cancelled job again; its finished steps and frames are kept."""
    return _again(service, caller, job, states.CANCELLED)


@router.patch("/{job}", responses=responses(404, 409), summary="Change the priority of a job")
def change_priority(service: ServiceDep, caller: Writer, job: JobName,
                    wanted: Annotated[Priority, Body(openapi_examples={"sooner": {"value": {"priority": 90}}})]) -> JobView:
    """Change the priority of a queued job; it stays the same attempt."""
    before = view(service, caller, job)
    with audit.recorded(service.database, caller, "job.priority", job) as connection:
        attempt = jobs.set_priority(connection, job, wanted.priority)
        if attempt is None:
            raise ApiError("conflict", f"{job} is {before.state}: only a queued job has a priority to change")
        service.queue.set_priority(connection, job, attempt, wanted.priority)
    return view(service, caller, job)


@router.delete("/{job}", status_code=204, responses=responses(404, 409), summary="Delete a job and its results")
def delete_job(service: ServiceDep, caller: Writer, job: JobName) -> None:
    """Delete a job that has ended, with its results."""
    before = view(service, caller, job)
    with audit.recorded(service.database, caller, "job.delete", job) as connection:
        if users := jobs.users_of(connection, job):
            raise ApiError("conflict", f"{job} is read by {users[0]}, which has not ended")
        if not jobs.remove(connection, job):
            raise ApiError("conflict", f"{job} is {before.state}: cancel it first")
    service.storage.remove(layout.results(caller.project, job))
    service.storage.remove(layout.shared(caller.project, job))
    service.queue.forget(job)


def view(service: Service, caller: Caller, job: str) -> JobView:
    """Return a job of the caller's project, or refuse the request."""
    return JobView.of(found_in_project(jobs.find(service.database, job, caller.project), job))


def _again(service: Service, caller: Caller, job: str, state: str) -> JobView:
    require_space(service, FOR_WORK)
    before = view(service, caller, job)
    request = before.request
    if isinstance(request, CheckJob):
        raise ApiError("conflict", f"{job} is a check: validate {request.intake} again")
    with audit.recorded(service.database, caller, "job.again", job) as connection:
        attempt = jobs.queue_again(connection, job, state)
        if attempt is None:
            raise ApiError("conflict", f"{job} is {before.state}, not {state}")
        service.queue.enqueue(connection, job, attempt, request, before.priority, caller.project)
        require_queue(service, caller, connection)
        quotas.require(connection, service.settings, quotas.JOBS, caller.project, 0)
    return view(service, caller, job)
