"""Routes for operators: health, readiness, metrics, the workers and what they do, and the audit log."""

import shutil
import threading
import time
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Path, Query, Request, Response, Security
from fastapi.security import HTTPAuthorizationCredentials
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from pydantic import BaseModel

from service.requests.answers import AuditEntry, AuditPage, DiskView, JobView, MachinesView, ProjectView, WorkerView
from service.requests.keys import Scope
from service.server.api.context import Admin, Reader, Service, ServiceDep, authenticated, bearer, has_space, require_local
from service.server.api.problems import ApiError, responses
from service.server.database import audit, jobs, workers
from service.server.database.engine import UNANSWERED
from service.server.database.keys import Caller
from service.server.jobs.queue import job_and_attempt
from stage.errors import StorageError

router = APIRouter(tags=["operations"])
WORKER = r"^[A-Za-z0-9_.:-]{1,200}$"
WorkerName = Annotated[str, Path(pattern=WORKER, description="Identifier of the worker.")]
ENDING = responses(401, 403, 404, 409, 422, 429, 503)
MOST_OBJECT = 40
"""Characters of an object of the audit log; the end of a worker's name is what no other has."""
KEEP_S = 1.0
"""Seconds for which a result is used again, so that frequent requests cost nothing."""


class Health(BaseModel):
    """The answer of a service that works."""

    status: Literal["ok"] = "ok"


class Readiness:
    """The last result of the readiness checks."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._looked_at, self._wrong = -KEEP_S, list[str]()

    def wrong(self, service: Service) -> list[str]:
        """Return what is wrong, in sentences that name nothing of the machine, as anybody may read them."""
        if service.draining.is_set():
            return ["the service is ending"]
        with self._lock:
            now = time.monotonic()
            if now - self._looked_at >= KEEP_S:
                self._looked_at, self._wrong = now, _faults(service)
            return self._wrong


def _faults(service: Service) -> list[str]:
    found = []
    try:
        if not workers.seen_lately(service.database):
            found.append(f"no worker was seen in the last {workers.SILENT_S:g} seconds")
    except UNANSWERED:
        found.append("the database does not answer")
    try:
        service.storage.check()
    except StorageError:
        found.append("the storage cannot be written")
    if not has_space(service.settings):
        found.append("there is less space left than min_free_bytes, or no room for further files")
    return found


@router.get("/healthz", summary="Whether the process answers")
async def get_health() -> Health:
    """Tell whether the process answers; needs no key."""
    return Health()


@router.get("/readyz", responses=responses(503), summary="Whether the service can do its work")
def get_readiness(service: ServiceDep, request: Request) -> Health:
    """Check database, storage, space left and workers; 503 says what is wrong, also while the service ends. Needs no key."""
    readiness: Readiness = request.app.state.readiness
    if wrong := readiness.wrong(service):
        raise ApiError("unavailable", "; ".join(wrong), headers={"Retry-After": "5"})
    return Health()


async def operator_of(service: ServiceDep, request: Request,
                      given: Annotated[HTTPAuthorizationCredentials | None, Security(bearer)]) -> None:
    """Refuse who may not read the metrics: a key of scope admin may, and this machine if the service listens to it only."""
    if given is None and service.settings.loopback:
        require_local(request)
    elif not (caller := await authenticated(request)).may(Scope.ADMIN):
        raise ApiError("forbidden", f"the key has the scope {caller.scope}, this needs {Scope.ADMIN}")


@router.get("/metrics", dependencies=[Depends(operator_of)], responses={
    **responses(401, 403, 429), 200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
    response_class=Response, summary="Metrics for Prometheus", openapi_extra={"security": [{}]})
def get_metrics(request: Request) -> Response:
    """Return requests, jobs by state, workers by device and more. A service that listens beyond this machine needs a key of scope admin."""
    return Response(request.app.state.metrics.text(), media_type=CONTENT_TYPE_LATEST)


@router.get("/v1/project", responses=responses(401, 403, 422, 429, 503), summary="See the project of the key")
async def get_project(caller: Reader) -> ProjectView:
    """Return the project of the key that asks, of which a key has one, and the scope of the key."""
    return ProjectView(name=caller.project, scope=caller.scope)


@router.get("/v1/machines", responses=responses(401, 403, 422, 429, 503), summary="Look at workers, queue and space")
def get_machines(service: ServiceDep, caller: Admin, request: Request) -> MachinesView:
    """Return the workers and what they do, how many jobs wait, and the space left. Jobs of other projects are counted, and not shown."""
    readiness: Readiness = request.app.state.readiness
    disk = shutil.disk_usage(service.settings.data)
    return MachinesView.model_validate({
        "workers": _workers(service, caller), "jobs": jobs.counts(service.database), "queued_since": jobs.oldest_queued(service.database),
        "disk": DiskView(free=disk.free, total=disk.total, least_free=service.settings.min_free_bytes), "faults": readiness.wrong(service)})


@router.post("/v1/machines/{worker}/drain", status_code=202, responses=ENDING, summary="Drain a worker")
def drain_worker(service: ServiceDep, caller: Admin, worker: WorkerName) -> WorkerView:
    """Let a worker without a job of another project finish its step, give its job back and end; its supervisor starts another."""
    return _end_worker(service, caller, worker, workers.DRAIN)


@router.post("/v1/machines/{worker}/kill", status_code=202, responses=ENDING, summary="Kill a worker")
def kill_worker(service: ServiceDep, caller: Admin, worker: WorkerName) -> WorkerView:
    """Let a worker without a job of another project end at once; another takes its job over, and its supervisor starts another."""
    return _end_worker(service, caller, worker, workers.KILL)


@router.get("/v1/audit", responses=responses(401, 403, 422, 429, 503), summary="Read the audit log, the newest first")
def get_audit(service: ServiceDep, caller: Admin, limit: Annotated[int, Query(ge=1, le=500)] = 100,
              before: Annotated[int | None, Query(ge=1, le=2**63 - 1, description="`next` of the page before.")] = None) -> AuditPage:
    """Return who did what to which object of the project, one page at a time."""
    rows = audit.listing(service.database, project=caller.project, limit=limit + 1, before=before)
    return AuditPage(entries=[AuditEntry.model_validate(dict(row)) for row in rows[:limit]],
                     next=rows[limit - 1]["id"] if len(rows) > limit else None)


def _end_worker(service: Service, caller: Caller, worker: str, what: str) -> WorkerView:
    found = next((each for each in _workers(service, caller) if each.id == worker), None)
    if found is not None and found.busy and found.job is None:
        raise ApiError("conflict", f"{worker} does a job of another project")
    with audit.recorded(service.database, caller, f"worker.{what}", worker[-MOST_OBJECT:]) as connection:
        if found is None or not workers.ask(connection, worker, what):
            raise ApiError("not-found", f"there is no worker {worker}")
    return found.model_copy(update={"asked": what})


def _workers(service: Service, caller: Caller) -> list[WorkerView]:
    taken = service.queue.taken_by()
    found = []
    for row in workers.seen_lately(service.database):
        workflows = taken.get(row["id"], [])
        shown = [job for name in workflows if (job := jobs.find(service.database, job_and_attempt(name)[0], caller.project)) is not None]
        found.append(WorkerView.model_validate({**row, "busy": bool(workflows), "job": JobView.of(shown[0]) if shown else None}))
    return found
