"""The problems with which a request can be refused, in one table (RFC 9457, application/problem+json)."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, NamedTuple, TypeVar

from fastapi import FastAPI, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException

from service.errors import RequestError, sentence
from service.server.base.log import logger
from service.server.database.engine import UNANSWERED, message_of
from service.server.database.quotas import BYTES, QuotaExceeded
from service.server.pages import routes as pages
from stage.errors import StorageError
from stage.records import said

T = TypeVar("T")
MEDIA_TYPE = "application/problem+json"
CHECKSUM_MISMATCH = 460
"""Status of a wrong checksum in the tus protocol."""
RETRY_S, QUOTA_RETRY_S = 5, 600
MAX_TEXT, MAX_FAULTS = 2000, 20
"""Characters of a sentence and number of invalid values that an answer repeats at most."""


class ProblemKind(NamedTuple):
    """Status and title of a kind of problem."""

    status: int
    title: str


KINDS: dict[str, ProblemKind] = {
    "bad-request": ProblemKind(400, "Malformed request"),
    "unauthenticated": ProblemKind(401, "A valid key is needed"),
    "forbidden": ProblemKind(403, "The key does not allow this"),
    "not-found": ProblemKind(404, "Not found in this project"),
    "method-not-allowed": ProblemKind(405, "The path does not take this method"),
    "conflict": ProblemKind(409, "The current state does not allow this"),
    "gone": ProblemKind(410, "The upload has expired"),
    "precondition-failed": ProblemKind(412, "The precondition does not hold"),
    "too-large": ProblemKind(413, "Larger than the service accepts"),
    "unsupported-media-type": ProblemKind(415, "The path does not take this content type"),
    "range-not-satisfiable": ProblemKind(416, "The range lies outside the file"),
    "invalid": ProblemKind(422, "Invalid value"),
    "locked": ProblemKind(423, "Another request is writing this upload"),
    "too-many": ProblemKind(429, "Too many requests or jobs"),
    "checksum-mismatch": ProblemKind(CHECKSUM_MISMATCH, "Wrong checksum"),
    "internal": ProblemKind(500, "Internal error of relit"),
    "unavailable": ProblemKind(503, "The service cannot answer now"),
    "full": ProblemKind(507, "No space left"),
}
OF_STATUS = {kind.status: name for name, kind in KINDS.items()}


class Fault(BaseModel):
    """One invalid value."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    field: str
    """The name of the value: body.options.frames, query.limit …"""
    message: str


class Problem(BaseModel):
    """The answer to a refused request (RFC 9457)."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    type: str
    """urn:relit:problem: and the kind of problem."""
    title: str
    status: int
    detail: str
    """One sentence for people."""
    request_id: str
    """The identifier of the request, which is also in the log."""
    errors: list[Fault] = []
    """The invalid values, if there are any."""


class ApiError(Exception):
    """Raised to refuse a request, with a kind of KINDS, one sentence, and headers of the answer."""

    def __init__(self, kind: str, detail: str, *, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.kind, self.detail, self.headers = kind, detail, dict(headers or {})


def found_in_project(found: T | None, identifier: str) -> T:
    """Return what was found of an identifier; refuse the request where that is nothing, or another project's."""
    if found is None:
        raise ApiError("not-found", f"there is no {identifier} in this project")
    return found


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the problems that a route may answer with, for the OpenAPI document."""
    return {status: {"model": Problem, "description": KINDS[OF_STATUS[status]].title} for status in statuses}


def install(app: FastAPI) -> None:
    """Answer the errors of the app from the table; middleware.RequestLog answers those that are unexpected."""

    @app.exception_handler(ApiError)
    async def refused(request: Request, error: ApiError) -> Response:
        return answer(request, error.kind, error.detail, headers=error.headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> Response:
        faults = [Fault(field=plain(".".join(map(str, fault["loc"]))), message=plain(said(fault))) for fault in error.errors()[:MAX_FAULTS]]
        return answer(request, "invalid", "; ".join(f"{fault.field}: {fault.message}" for fault in faults), faults=faults)

    @app.exception_handler(RequestError)
    async def unasked(request: Request, error: RequestError) -> Response:
        if isinstance(error, QuotaExceeded) and error.quota != BYTES:
            return answer(request, "too-many", str(error), headers={"Retry-After": str(QUOTA_RETRY_S)})
        return answer(request, "too-large" if isinstance(error, QuotaExceeded) else "invalid", sentence(error))

    @app.exception_handler(HTTPException)
    async def routed(request: Request, error: HTTPException) -> Response:
        kind, headers = OF_STATUS.get(error.status_code, "bad-request"), dict(error.headers or {})
        path, detail = request.scope["path"], str(error.detail or HTTPStatus(error.status_code).phrase)
        if detail == HTTPStatus.NOT_FOUND.phrase:  # of the router, which knows no more
            detail = f"nothing has the address {path}"
        if error.status_code == KINDS["method-not-allowed"].status:  # the router names the methods of its first route alone
            found = (route.methods or () for route in iter_route_contexts(request.app.routes) if route.path_regex.match(path))
            headers["Allow"] = ", ".join(sorted({method for methods in found for method in methods}))
            detail = f"{path} takes {headers['Allow']}, and not {request.method}"
        return answer(request, kind, detail, headers=headers)

    @app.exception_handler(StorageError)
    async def full(request: Request, error: StorageError) -> Response:
        logger.error("storage refuses", error=str(error))
        return answer(request, "full", "the storage of the service cannot be written: its operator can see why in the log",
                      headers={"Retry-After": "60"})

    async def unavailable(request: Request, error: Exception) -> Response:
        logger.error("database does not answer", error=message_of(error))
        return answer(request, "unavailable", "the database does not answer: try again", headers={"Retry-After": str(RETRY_S)})

    for fault in UNANSWERED:
        app.add_exception_handler(fault, unavailable)


def plain(text: str) -> str:
    """Return text that can be sent: cut to MAX_TEXT, and with halves of characters, which UTF-8 does not have, written as escapes."""
    return text[:MAX_TEXT].encode("utf-8", "backslashreplace").decode()


def answer(request: Request, kind: str, detail: str, *, faults: list[Fault] | None = None,
           headers: Mapping[str, str] | None = None) -> Response:
    """Return the response for a kind of problem: a page for a browser that goes to an address, else a problem document."""
    row, detail = KINDS[kind], plain(detail)
    request.state.problem = detail  # for the log
    if pages.wants_page(request):
        page = pages.fault_page(request, row.status, row.title, detail)
        page.headers.update(headers or {})
        return page
    problem = Problem(type=f"urn:relit:problem:{kind}", title=row.title, status=row.status, detail=detail,
                      request_id=getattr(request.state, "request_id", ""), errors=faults or [])
    return JSONResponse(jsonable_encoder(problem), row.status, headers=dict(headers or {}), media_type=MEDIA_TYPE)
