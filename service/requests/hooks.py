"""Hooks: URLs that the service tells how the jobs of a project have ended."""

from typing import Annotated

from pydantic import Field, StringConstraints

from service.requests.base.base import Choice, Commas, Options
from service.requests.base.identifiers import matching

URL_PATTERN = r"^https?://[!-~]+$"


class HookEvent(Choice):
    """An event that a hook is told of."""

    FINISHED = "finished", "a job has succeeded"
    FAILED = "failed", "a job has failed"
    CANCELLED = "cancelled", "a job was cancelled"


class NewHook(Options):
    """Let the service send a signed request to a URL when a job of the project has ended. The secret that signs is shown once."""

    url: Annotated[str, StringConstraints(max_length=2000, pattern=URL_PATTERN), matching(URL_PATTERN, "give https://host/path")]
    """Address of the receiver: https://host/path, or http:// in a network of the setting hook_networks."""
    events: Annotated[tuple[HookEvent, ...], Field(min_length=1), Commas] = tuple(HookEvent)
    """The events that are told, separated by commas."""
