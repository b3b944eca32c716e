"""Everything that a request can be refused with, in one table (RFC 9457, application/problem+json)."""

from collections.abc import Mapping
from http import HTTPStatus
from typing import Any, NamedTuple

from fastapi import FastAPI, Request
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import iter_route_contexts
from pydantic import BaseModel, ConfigDict
from starlette.exceptions import HTTPException

from service.errors import RequestError, sentence
from service.server.database.engine import UNANSWERED, message_of
from service.server.log import logger
from stage.errors import StorageError

MEDIA_TYPE = "application/problem+json"
CHECKSUM_MISMATCH = 460
"""What the tus protocol gives a wrong checksum."""
RETRY_S = 5
MAX_FAULTS = 20
"""Of a request, that are told."""
MAX_TEXT, MAX_FAULTS = 2000, 20
"""Characters of a sentence, and values, that an answer says at most: it may repeat what was sent."""


class Kind(NamedTuple):
    """A row of the table."""

    status: int
    title: str


KINDS: dict[str, Kind] = {
    "bad-request": Kind(400, "The request is malformed"),
    "unauthenticated": Kind(401, "A valid key is needed"),
    "forbidden": Kind(403, "The key does not allow this"),
    "not-found": Kind(404, "There is no such thing in this project"),
    "method-not-allowed": Kind(405, "The method is not allowed here"),
    "conflict": Kind(409, "It is not in a state for this"),
    "gone": Kind(410, "It is not there any more"),
    "precondition-failed": Kind(412, "The precondition does not hold"),
    "too-large": Kind(413, "It is larger than the service takes"),
    "unsupported-media-type": Kind(415, "The content type is not taken here"),
    "range-not-satisfiable": Kind(416, "The range lies outside the file"),
    "invalid": Kind(422, "A value cannot be"),
    "locked": Kind(423, "Another request is writing it"),
    "too-many": Kind(429, "Too many requests or jobs"),
    "checksum-mismatch": Kind(CHECKSUM_MISMATCH, "The checksum does not fit"),
    "internal": Kind(500, "An error of relit itself"),
    "unavailable": Kind(503, "The service cannot answer now"),
    "full": Kind(507, "There is no space left"),
}
OF_STATUS = {kind.status: name for name, kind in KINDS.items()}


class Fault(BaseModel):
    """One value that cannot be."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    field: str
    """Where it is: body.options.frames, query.limit …"""
    message: str


class Problem(BaseModel):
    """What a refused request is answered with (RFC 9457)."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    type: str
    """urn:relit:problem: and the kind."""
    title: str
    status: int
    detail: str
    """One sentence for a person."""
    request_id: str
    """Also in the log."""
    errors: list[Fault] = []
    """Values that cannot be, where there are such."""


class ApiError(Exception):
    """Refuse a request."""

    def __init__(self, kind: str, detail: str, *, headers: Mapping[str, str] | None = None) -> None:
        """Args: kind: of KINDS. detail: one sentence. headers: of the answer."""
        super().__init__(detail)
        self.kind, self.detail, self.headers = kind, detail, dict(headers or {})


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The problems that a route may answer with, for the OpenAPI document."""
    return {status: {"model": Problem, "description": KINDS[OF_STATUS[status]].title,
                     "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}} for status in statuses}


def install(app: FastAPI) -> None:
    """Answer every error of the app from the table; what is none of these, service.server.api.trace does."""

    @app.exception_handler(ApiError)
    async def refused(request: Request, error: ApiError) -> JSONResponse:
        return answer(request, error.kind, error.detail, headers=error.headers)

    @app.exception_handler(RequestValidationError)
    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        faults = [Fault(field=plain(".".join(map(str, fault["loc"]))), message=plain(fault["msg"].removeprefix("Value error, ")))
                  for fault in error.errors()[:MAX_FAULTS]]
        return answer(request, "invalid", "; ".join(f"{fault.field}: {fault.message}" for fault in faults), faults=faults)

    @app.exception_handler(RequestError)
    async def unasked(request: Request, error: RequestError) -> JSONResponse:
        return answer(request, "invalid", sentence(error))

    @app.exception_handler(HTTPException)
    async def routed(request: Request, error: HTTPException) -> JSONResponse:
        kind, headers = OF_STATUS.get(error.status_code, "bad-request"), dict(error.headers or {})
        if error.status_code == KINDS["method-not-allowed"].status:
            headers["Allow"] = ", ".join(_allowed(request))
        return answer(request, kind, str(error.detail or HTTPStatus(error.status_code).phrase), headers=headers)

    @app.exception_handler(StorageError)
    async def full(request: Request, error: StorageError) -> JSONResponse:
        logger.error("storage refuses", error=str(error))
        return answer(request, "full", "the storage of the service cannot be written: its operator can see why in the log",
                      headers={"Retry-After": "60"})

    async def unavailable(request: Request, error: Exception) -> JSONResponse:
        logger.error("database does not answer", error=message_of(error))
        return answer(request, "unavailable", "the database does not answer: try again", headers={"Retry-After": str(RETRY_S)})

    for fault in UNANSWERED:
        app.add_exception_handler(fault, unavailable)


def plain(text: str) -> str:
    """Text that can be sent: halves of characters, which JSON can say and UTF-8 cannot, are spelled out; and not too long."""
    return text[:MAX_TEXT].encode("utf-8", "backslashreplace").decode()


def _allowed(request: Request) -> list[str]:
    """The methods of all routes of a path: the router knows those of the first alone."""
    path = request.scope["path"]
    found = (route.methods or () for route in iter_route_contexts(request.app.routes) if route.path_regex.match(path))
    return sorted({method for methods in found for method in methods})


def answer(request: Request, kind: str, detail: str, *, faults: list[Fault] | None = None,
           headers: Mapping[str, str] | None = None) -> JSONResponse:
    """The response of a kind."""
    row, detail = KINDS[kind], plain(detail)
    request.state.problem = detail  # for the log
    problem = Problem(type=f"urn:relit:problem:{kind}", title=row.title, status=row.status, detail=detail,
                      request_id=getattr(request.state, "request_id", ""), errors=faults or [])
    return JSONResponse(jsonable_encoder(problem), row.status, headers=dict(headers or {}), media_type=MEDIA_TYPE)
