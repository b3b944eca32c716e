"""Views of intakes (captures and environments) and of the files that are uploaded into them."""

from typing import Any

from service.requests.base.identifiers import UploadId
from service.requests.views import Time, View
from service.requests.views.states import IntakeState


class IntakeView(View):
    """A capture or an environment."""

    id: str
    name: str
    state: IntakeState
    """receiving: takes files; checking: is being looked at; ready: jobs may use it; refused: `problem` says why."""
    registered: bool
    """True if it lies in a folder of the server, and was not uploaded."""
    problem: str | None
    facts: dict[str, Any] | None
    """The findings of the check: captures, frames, resolution …"""
    created_at: Time


class IntakePage(View):
    """Captures or environments, the newest first."""

    items: list[IntakeView]
    next: str | None
    """Give it as `before` for the page after this one; null: this is the last page."""


class FileView(View):
    """A file of a capture or environment."""

    upload: UploadId
    """Its bytes are sent to, and it is deleted at, /v1/uploads/ and this."""
    path: str
    length: int
    received: int
    """Bytes that are safe."""
    done: bool
    sha256: str | None
    """As the client said it; where the file is done, also as it was found."""


class FilePage(View):
    """Files, in the order of their paths; upper and lower case count as the same."""

    files: list[FileView]
    next: str | None
    """Give it as `after` for the page after this one; null: this is the last page."""
