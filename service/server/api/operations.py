"""Routes for operators: health, readiness and metrics."""

import threading
import time
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Request, Response, Security
from fastapi.security import HTTPAuthorizationCredentials
from pydantic import BaseModel

from service.requests.keys import Scope
from service.server.api.context import Service, ServiceDep, authenticated, bearer, has_space, require_local
from service.server.api.metrics import CONTENT_TYPE
from service.server.api.problems import ApiError, responses
from service.server.database import workers
from service.server.database.engine import UNANSWERED
from stage.errors import StorageError

router = APIRouter(tags=["operations"])
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
    return Response(request.app.state.metrics.text(), media_type=CONTENT_TYPE)
