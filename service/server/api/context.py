"""Dependencies of routes: the service, the caller and its scope, and the space that is left."""

import os
import threading
from collections.abc import Awaitable, Callable
from typing import Annotated, NamedTuple
from urllib.parse import urlsplit

from fastapi import Depends, Header, Request, Security
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from fastapi.security.utils import get_authorization_scheme_param
from starlette.concurrency import run_in_threadpool

from service.requests.keys import Scope
from service.server.api.limits import AtOnce, RateLimiter
from service.server.api.problems import ApiError
from service.server.api.tokens import PROJECT_HEADER, TokenReader
from service.server.api.watch import Watcher
from service.server.base.settings import Settings, is_loopback
from service.server.database import keys
from service.server.database.engine import Database
from service.server.database.keys import DEFAULT_PROJECT, Caller
from service.server.jobs.queue import JobQueue
from service.server.storage.objects import Storage
from service.server.storage.upload_parts import UploadParts

ANONYMOUS = Caller(DEFAULT_PROJECT, Scope.ADMIN, None)
SPACE_RETRY_S = 600
FOR_WORK, FOR_UPLOAD = "new work", "this upload"
"""Purposes of space, as the sentence names them."""
MIN_FREE_FILES = 1000
"""Files that the file system of the data folder must have room for."""
FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")
"""Headers that proxies add to a request."""


class Service(NamedTuple):
    """The parts of the service that routes use."""

    settings: Settings
    database: Database
    queue: JobQueue
    storage: Storage
    parts: UploadParts
    limiter: RateLimiter
    running: AtOnce
    """Requests of each key."""
    key_streams: AtOnce
    """Streams of events of each key."""
    project_streams: AtOnce
    """Streams of events of each project."""
    draining: threading.Event
    """Set when the service is asked to end: it still answers while its workers finish their steps, and says that it is not ready."""
    closing: threading.Event
    """Set when the workers have ended: streams of events end, and then the service."""
    watcher: Watcher
    tokens: TokenReader | None = None
    """Reads the tokens of the identity provider; None: there is none."""


async def service_of(request: Request) -> Service:  # async, as it waits for nothing: FastAPI calls it without a thread
    """Return the service of the app that received the request."""
    found: Service = request.app.state.service
    return found


ServiceDep = Annotated[Service, Depends(service_of)]
bearer = HTTPBearer(auto_error=False, scheme_name="key", description="A key of `relit keys create`.")


async def authenticated(request: Request) -> Caller:
    """Return who sent the request; a key that asks too often costs neither thread nor query, and a second call nothing."""
    known: Caller | None = getattr(request.state, "caller", None)
    if known is not None:
        return known
    service: Service = request.app.state.service
    scheme, given = get_authorization_scheme_param(request.headers.get("Authorization"))
    key = given if scheme.lower() == "bearer" else ""
    service.limiter.require(key.partition(".")[0])
    caller = await run_in_threadpool(_sender_of, request, service, key)
    service.running.enter(caller.key)
    request.state.running = True  # middleware.RequestLog ends it
    return caller


def _sender_of(request: Request, service: Service, key: str) -> Caller:
    """Return who sent a request with a key or a token; empty: without one."""
    caller: Caller | str | None = None
    if key:
        if service.tokens is not None and key.count(".") == 2:  # a JWT; keys have one dot
            caller = service.tokens.caller(key, request.headers.get(PROJECT_HEADER))
        else:
            caller = keys.find(service.database, key)
    elif service.settings.anonymous:
        require_local(request)
        caller = ANONYMOUS
    if not isinstance(caller, Caller):
        fault = "give a key that is valid as Authorization: Bearer KEY" if caller is None else f"{caller}: give a key that is valid"
        raise ApiError("unauthenticated", fault, headers={"WWW-Authenticate": "Bearer"})
    request.state.caller = caller  # for the log, too
    service.limiter.take(caller.key)
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
require_admin = _scoped(Scope.ADMIN)
Admin = Annotated[Caller, Depends(require_admin)]
IdempotencyKey = Annotated[str | None, Header(
    alias="Idempotency-Key", min_length=1, max_length=255, pattern=r"^[\x21-\x7e]+$",
    description="Chosen by the client: the same request sent again with it creates nothing again.")]


def require_local(request: Request) -> None:
    """Refuse a request that a program of this machine did not send.

    A page in a browser here can send requests to a loopback address: under its own name, which it has made to point there (the Host shows
    it), or from another site (the Origin shows it).
    """
    host = request.headers.get("host", "")
    if not is_loopback(_name(host)):
        raise ApiError("forbidden", "without a key, the Host must be localhost or a loopback address")
    if any(name in request.headers for name in FORWARDED):
        raise ApiError("forbidden", "without a key, requests through a proxy are refused: make keys with relit keys create")
    origin = request.headers.get("origin")
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        raise ApiError("forbidden", "without a key, requests from pages of other sites are refused")


def _name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def require_valid(service: Service, caller: Caller) -> None:
    """Refuse a caller whose key or token was revoked or has expired since the request began."""
    if keys.no_longer_valid(service.database, [caller]):
        raise ApiError("unauthenticated", "the key was revoked or has expired", headers={"WWW-Authenticate": "Bearer"})


def has_space(settings: Settings, length: int = 0) -> bool:
    """Return whether the data folder has room for MIN_FREE_FILES files and, after `length` more bytes, for `min_free_bytes`."""
    found = os.statvfs(settings.data)
    has_files = found.f_files == 0 or found.f_favail >= MIN_FREE_FILES  # some file systems have no bound of files, and say 0
    return has_files and found.f_bavail * found.f_frsize - length >= settings.min_free_bytes


def require_space(service: Service, purpose: str, length: int = 0) -> None:
    """Refuse a request, for `purpose` (FOR_WORK or FOR_UPLOAD), after whose `length` bytes less than `min_free_bytes` would be left."""
    if not has_space(service.settings, length):
        raise ApiError("full", f"the service has no space left for {purpose}", headers={"Retry-After": str(SPACE_RETRY_S)})
