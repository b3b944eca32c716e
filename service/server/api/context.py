"""What routes depend on: the service, the caller and its scope, the space that is left, and requests that may be sent twice."""

import shutil
import threading
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, NamedTuple

import sqlalchemy as sa
from fastapi import Depends, Header, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.utils import get_authorization_scheme_param
from starlette.concurrency import run_in_threadpool

from service.requests.keys import Scope
from service.server.api.access import RateLimiter, RunningRequests, require_local
from service.server.api.problems import ApiError
from service.server.api.request_leases import RequestLeases
from service.server.api.stream_leases import StreamLeases
from service.server.api.tokens import PROJECT_HEADER, TokenReader
from service.server.api.watch import Watcher
from service.server.database import idempotency, keys, quotas
from service.server.database.engine import Database
from service.server.database.keys import DEFAULT_PROJECT, Caller
from service.server.jobs.queue import JobQueue
from service.server.settings import Settings
from service.server.storage.objects import Storage
from service.server.storage.upload_parts import UploadParts

ANONYMOUS = Caller(DEFAULT_PROJECT, Scope.ADMIN, None)
SPACE_RETRY_S = QUOTA_RETRY_S = 600
FOR_WORK, FOR_UPLOAD = "new work", "this upload"
"""Purposes of space, as the sentence names them."""


class Service(NamedTuple):
    """The parts of the service that routes use."""

    settings: Settings
    database: Database
    queue: JobQueue
    storage: Storage
    parts: UploadParts
    limiter: RateLimiter
    running: RunningRequests
    draining: threading.Event
    """Set when the service is asked to end: it still answers while its workers finish their steps, and says that it is not ready."""
    closing: threading.Event
    """Set when the workers have ended: streams of events end, and then the service."""
    watcher: Watcher
    leases: StreamLeases
    """Count the streams of events of each key and project."""
    rates: RequestLeases
    """Count the requests of each key over all API processes; `limiter` counts those of this one, also while the database is away."""
    tokens: TokenReader | None = None
    """Reads the tokens of the identity provider; None: there is none."""


async def service_of(request: Request) -> Service:  # async, as it waits for nothing: FastAPI calls it without a thread
    """Return the service of the app that received the request."""
    found: Service = request.app.state.service
    return found


ServiceDep = Annotated[Service, Depends(service_of)]
bearer = HTTPBearer(auto_error=False, scheme_name="key", description="A key of `relit keys create`.")


def authenticate(request: Request) -> Caller:
    """Return who sent the request; a second call of the same request returns the same.

    Raises:
        ApiError: there is no valid key and none may be left out, or the key asks too often.
    """
    known: Caller | None = getattr(request.state, "caller", None)
    if known is not None:
        return known
    service: Service = request.app.state.service
    scheme, given = get_authorization_scheme_param(request.headers.get("Authorization"))
    caller = None
    if scheme.lower() == "bearer" and given:
        if service.tokens is not None and given.count(".") == 2:  # a JWT; keys have one dot
            caller = service.tokens.caller(given, request.headers.get(PROJECT_HEADER))
        else:
            caller = keys.find(service.database, given)
    elif service.settings.anonymous:
        require_local(request)
        caller = ANONYMOUS
    if caller is None:
        raise ApiError("unauthenticated", "give a key that is valid as Authorization: Bearer KEY", headers={"WWW-Authenticate": "Bearer"})
    request.state.caller = caller  # for the log, too
    service.limiter.take(caller.key)
    return caller


async def authenticated(request: Request) -> Caller:
    """Return who sent the request, as `authenticate` does in another thread; a key that asks too often costs neither thread nor query."""
    service: Service = request.app.state.service
    scheme, given = get_authorization_scheme_param(request.headers.get("Authorization"))
    if getattr(request.state, "caller", None) is None and scheme.lower() == "bearer":
        service.limiter.require(given.partition(".")[0])
        service.rates.require(given.partition(".")[0])
    caller = await run_in_threadpool(authenticate, request)
    if not getattr(request.state, "running", False):
        service.running.enter(caller.key)
        request.state.running = True  # middleware.RequestLog ends it
        await service.rates.take(caller.key or "")
    return caller


async def caller_of(request: Request, _given: Annotated[HTTPAuthorizationCredentials | None, Security(bearer)]) -> Caller:
    """Return who sent the request; the scheme is for the OpenAPI document."""
    return await authenticated(request)


def _scoped(scope: Scope) -> Callable[[Caller], Awaitable[Caller]]:
    async def check(caller: Annotated[Caller, Depends(caller_of)]) -> Caller:
        if not caller.may(scope):
            raise ApiError("forbidden", f"the key has the scope {caller.scope}, this needs {scope}")
        return caller

    return check


Reader = Annotated[Caller, Depends(_scoped(Scope.READ))]
Writer = Annotated[Caller, Depends(_scoped(Scope.WRITE))]
IdempotencyKey = Annotated[str | None, Header(
    alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+$",
    description="Chosen by the client: the same request sent again with it creates nothing again.")]


def created_before(service: Service, caller: Caller, token: str | None, asked: Any) -> str | None:
    """Return what the same request has created before; None: nothing. Whether it could be created now does not matter then."""
    try:
        return None if token is None else idempotency.created_by(service.database, caller.project, token, asked)
    except idempotency.TokenReused:
        raise _reused(token) from None


def create_once(service: Service, caller: Caller, token: str | None, asked: Any, make: Callable[[sa.Connection], str]) -> tuple[str, bool]:
    """Create something once for an Idempotency-Key; the arguments are those of `idempotency.create_once`."""
    try:
        return idempotency.create_once(service.database, caller.project, token, asked, make)
    except idempotency.TokenReused:
        raise _reused(token) from None


def _reused(token: str | None) -> ApiError:
    return ApiError("invalid", f"Idempotency-Key {token}: came with another request before: choose a new one")


def has_space(settings: Settings, length: int = 0) -> bool:
    """Return whether `min_free_bytes` are left in the data folder after `length` more bytes."""
    return shutil.disk_usage(settings.data).free - length >= settings.min_free_bytes


def require_space(service: Service, purpose: str, length: int = 0) -> None:
    """Refuse a request for which there is no space.

    Args:
        service: of the request.
        purpose: FOR_WORK or FOR_UPLOAD.
        length: bytes that will be written, if that is known.

    Raises:
        ApiError: less than `min_free_bytes` would be left.
    """
    if not has_space(service.settings, length):
        raise ApiError("full", f"the service has no space left for {purpose}", headers={"Retry-After": str(SPACE_RETRY_S)})


def require_quota(service: Service, connection: sa.Connection, quota: str, project: str, more: int) -> None:
    """Refuse, and so roll back the transaction, if a project would have more than it may; the arguments are those of `quotas.require`.

    Raises:
        ApiError: the quota is exceeded: too-large for bytes, else too-many.
    """
    try:
        quotas.require(connection, service.settings, quota, project, more)
    except quotas.QuotaExceeded as error:
        if quota == quotas.BYTES:
            raise ApiError("too-large", str(error)) from None
        raise ApiError("too-many", str(error), headers={"Retry-After": str(QUOTA_RETRY_S)}) from None
