"""What every route is given: the service behind the app, who asks, and the token of a request that creates something."""

import threading
from collections.abc import Awaitable, Callable
from typing import Annotated, Any, NamedTuple

import sqlalchemy as sa
from fastapi import Depends, Header, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from service.requests.keys import Scope
from service.server.api.limits import Limiter
from service.server.api.local import require_local
from service.server.api.problems import ApiError
from service.server.api.watch import Watcher
from service.server.database import idempotency, keys
from service.server.database.engine import Database
from service.server.database.keys import Caller
from service.server.jobs.queue import JobQueue
from service.server.settings import Settings
from service.server.storage.folder import Storage

DEFAULT_PROJECT = "default"
ANONYMOUS = Caller(DEFAULT_PROJECT, Scope.ADMIN, None)


class Service(NamedTuple):
    """ServiceDep the app."""

    settings: Settings
    database: Database
    queue: JobQueue
    storage: Storage
    limiter: Limiter
    draining: threading.Event
    """Set when the service is to end: it answers on while its workers finish their steps, and is not ready."""
    closing: threading.Event
    """Set when the workers have ended: streams end now, and then the service."""
    watcher: Watcher


async def service_of(request: Request) -> Service:  # what waits for nothing is async, which saves a turn in a thread
    """The service of the app that got the request."""
    found: Service = request.app.state.service
    return found


ServiceDep = Annotated[Service, Depends(service_of)]
bearer = HTTPBearer(auto_error=False, scheme_name="key", description="A key of `relit keys create`.")


def caller_of(service: ServiceDep, request: Request, given: Annotated[HTTPAuthorizationCredentials | None, Security(bearer)]) -> Caller:
    """Who asks, within the limits of the key."""
    caller = None
    if given is not None:
        caller = keys.find(service.database, given.credentials)
    elif service.settings.anonymous:
        require_local(request)
        caller = ANONYMOUS
    if caller is None:
        raise ApiError("unauthenticated", "give a key that is valid as Authorization: Bearer KEY", headers={"WWW-Authenticate": "Bearer"})
    request.state.caller = caller  # for the log
    service.limiter.take(caller.key)
    return caller


def _scoped(scope: Scope) -> Callable[[Caller], Awaitable[Caller]]:
    async def check(caller: Annotated[Caller, Depends(caller_of)]) -> Caller:
        if not caller.may(scope):
            raise ApiError("forbidden", f"the key has the scope {caller.scope}, this needs {scope}")
        return caller

    return check


Reader = Annotated[Caller, Depends(_scoped(Scope.READ))]
Writer = Annotated[Caller, Depends(_scoped(Scope.WRITE))]
Admin = Annotated[Caller, Depends(_scoped(Scope.ADMIN))]
IdempotencyKey = Annotated[str | None, Header(
    alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+$",
    description="Chosen by the client: the same request sent again with it creates nothing again.")]


def made_before(service: Service, caller: Caller, token: str | None, asked: Any) -> str | None:
    """What the same request has created already: it is not looked at again whether it could be created now."""
    try:
        return None if token is None else idempotency.created_by(service.database, caller.project, token, asked)
    except idempotency.TokenReused:
        raise _reused(token) from None


def once(service: Service, caller: Caller, token: str | None, asked: Any, make: Callable[[sa.Connection], str]) -> tuple[str, bool]:
    """Create something, once for an Idempotency-Key; arguments as `idempotency.create_once`."""
    try:
        return idempotency.create_once(service.database, caller.project, token, asked, make)
    except idempotency.TokenReused:
        raise _reused(token) from None


def _reused(token: str | None) -> ApiError:
    return ApiError("invalid", f"Idempotency-Key {token}: came with another request before: choose a new one")
