"""Errors of the client; the text of each is one sentence for a person.

ClientError
├── Unreachable      the service does not answer, or something else answers in its place
├── Refused          the service answers with an error: `status`, `kind`, `detail` (the sentence), `request_id`, `errors`
│   ├── NotAllowed   401, 403: the key is missing, invalid, or does not allow the request
│   ├── NotFound     404, 410: the project of the key has no such thing, or no longer
│   ├── Conflict     409, 412, 423: the state of the thing does not allow the request
│   ├── Invalid      other 4xx: a value is invalid; `errors` names the fields
│   ├── Busy         429, 503, 507: the service cannot do it now, and could not until the client's patience ended
│   └── Faulty       other 5xx: an error inside the service; its log has more under `request_id`
├── IntakeRefused    the check of a capture or environment found that it cannot be used
├── JobEnded         the job that was waited for failed or was cancelled
└── FileError        a local file cannot be read or written, or changed while it was sent
"""

import json
from typing import Any, NamedTuple

import httpx2

from service.requests.answers import IntakeView, JobView


class ClientError(Exception):
    """Base of all errors of the client."""


class Unreachable(ClientError):
    """The service does not answer."""


class FileError(ClientError):
    """A local file cannot be used; the message names it."""


class Fault(NamedTuple):
    """One invalid value of a request."""

    field: str
    """The place of the value: body.options.frames, query.limit …"""
    message: str


class Refused(ClientError):
    """The service answers with an error: its status, its kind (not-found, conflict …), one sentence, and the fields that are invalid."""

    def __init__(self, status: int, kind: str, detail: str, *, request_id: str = "", errors: tuple[Fault, ...] = ()) -> None:
        super().__init__(detail)
        self.status, self.kind, self.detail, self.request_id, self.errors = status, kind, detail, request_id, errors


class NotAllowed(Refused):
    """The key is missing, invalid, or does not allow the request."""


class NotFound(Refused):
    """The project of the key has no such thing, or no longer."""


class Conflict(Refused):
    """The state of the thing does not allow the request."""


class Invalid(Refused):
    """A value of the request is invalid."""


class Busy(Refused):
    """The service cannot do it now."""


class Faulty(Refused):
    """An error inside the service."""


class IntakeRefused(ClientError):
    """The check of a capture or environment found that it cannot be used."""

    def __init__(self, intake: IntakeView) -> None:
        super().__init__(f"{intake.name} ({intake.id}): {intake.problem}")
        self.intake = intake


class JobEnded(ClientError):
    """A job failed or was cancelled."""

    def __init__(self, job: JobView) -> None:
        super().__init__(job.error if job.error is not None else f"{job.id} was {job.state}")
        self.job = job


PROBLEM = "application/problem+json"
OF_STATUS: dict[int, type[Refused]] = {401: NotAllowed, 403: NotAllowed, 404: NotFound, 410: NotFound, 409: Conflict, 412: Conflict,
                                       423: Conflict, 429: Busy, 503: Busy, 507: Busy}


def refusal(answer: httpx2.Response) -> ClientError:
    """Return the error for an answer with status 300 or more, of the service (RFC 9457) or of a proxy in its place; read it to its end."""
    body, status = answer.read(), answer.status_code
    problem = _problem(body) if answer.headers.get("content-type", "").partition(";")[0].strip() == PROBLEM else None
    if problem is None:
        return Unreachable(f"something that is not the service answers with status {status}: look at the server's URL")
    error = OF_STATUS.get(status, Faulty if status >= 500 else Invalid)
    return error(status, str(problem.get("type", "")).rpartition(":")[2], str(problem.get("detail") or problem.get("title")),
                 request_id=str(problem.get("request_id", "")),
                 errors=tuple(Fault(str(fault["field"]), str(fault["message"])) for fault in problem.get("errors", ())))


def _problem(body: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(body)
    except (ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None
