"""Errors of the client; the text of each is one sentence for a person.

ClientError
├── Unreachable      the service does not answer, or something that answers in its place is not it
├── Refused          the service says no: has its status, kind, sentence and request_id
│   ├── NotAllowed   401, 403: there is no key, it is not valid, or it does not allow this
│   ├── NotFound     404, 410
│   ├── Conflict     409, 412, 423: not in a state for this
│   ├── Invalid      other 4xx: a value cannot be; `errors` names the fields
│   ├── Busy         429, 503, 507: later, and for longer than the client had patience
│   └── Faulty       other 5xx: an error of relit itself; its log has more under request_id
├── IntakeRefused    the check found a capture or environment that cannot be used
├── JobEnded         the job that was waited for has failed, or was cancelled
└── FileError        a file cannot be read or written here, or is not what was sent
"""

import json
from typing import Any, NamedTuple

from service.server.api.views import IntakeView, JobView


class ClientError(Exception):
    """Base of all."""


class Unreachable(ClientError):
    """The service does not answer."""


class FileError(ClientError):
    """A file cannot be used; the message names it."""


class Fault(NamedTuple):
    """One value that cannot be."""

    field: str
    message: str


class Refused(ClientError):
    """The service says no."""

    def __init__(self, status: int, kind: str, detail: str, *, request_id: str = "", errors: tuple[Fault, ...] = ()) -> None:
        """Args: status: of HTTP. kind: not-found, conflict … detail: the sentence. request_id: in the log. errors: wrong values."""
        super().__init__(detail)
        self.status, self.kind, self.detail, self.request_id, self.errors = status, kind, detail, request_id, errors


class NotAllowed(Refused):
    """There is no key, it is not valid, or it does not allow this."""


class NotFound(Refused):
    """There is no such thing in the project of the key, or not any more."""


class Conflict(Refused):
    """It is not in a state for this."""


class Invalid(Refused):
    """A value cannot be."""


class Busy(Refused):
    """The service cannot do it now."""


class Faulty(Refused):
    """An error of relit itself."""


class IntakeRefused(ClientError):
    """A capture or environment cannot be used."""

    def __init__(self, intake: IntakeView) -> None:
        """Args: intake: that was refused."""
        super().__init__(f"{intake.name} ({intake.id}): {intake.problem}")
        self.intake = intake


class JobEnded(ClientError):
    """A job did not succeed."""

    def __init__(self, job: JobView) -> None:
        """Args: job: that failed or was cancelled."""
        super().__init__(job.error if job.error is not None else f"{job.id} was {job.state}")
        self.job = job


PROBLEM = "application/problem+json"
OF_STATUS: dict[int, type[Refused]] = {401: NotAllowed, 403: NotAllowed, 404: NotFound, 410: NotFound, 409: Conflict, 412: Conflict,
                                       423: Conflict, 429: Busy, 503: Busy, 507: Busy}


def refusal(status: int, media_type: str, body: bytes) -> ClientError:
    """The error that an answer is.

    Args:
        status: 300 or more.
        media_type: of the body.
        body: a problem of the service; whatever else comes from something that answered in its place, such as a proxy.
    """
    problem = _problem(body) if media_type.partition(";")[0].strip() == PROBLEM else None
    if problem is None:
        return Unreachable(f"something that is not the service answers with status {status}: look at the server's URL")
    error = OF_STATUS.get(status, Faulty if status >= 500 else Invalid)
    return error(status, str(problem.get("type", "")).rpartition(":")[2], str(problem.get("detail") or problem.get("title")),
                 request_id=str(problem.get("request_id", "")),
                 errors=tuple(Fault(str(fault["field"]), str(fault["message"])) for fault in problem.get("errors", ())))


def _problem(body: bytes) -> dict[str, Any] | None:
    try:
        found = json.loads(body)
    except ValueError:
        return None
    return found if isinstance(found, dict) else None
