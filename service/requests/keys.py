"""The options of `relit keys create`."""

from typing import Annotated

from pydantic import Field, StringConstraints

from service.requests.base.base import Choice, Options
from service.requests.base.identifiers import Project


class Scope(Choice):
    """The rights of a key; each scope includes those before it."""

    READ = "read", "see captures, jobs and results"
    WRITE = "write", "also upload, submit, cancel and retry jobs, and delete what belongs to the project"
    ADMIN = "admin", "also register folders of the server, set hooks, and see /metrics"


class NewKey(Options):
    """Make a key and print it: the service stores only its hash, so the key cannot be shown again."""

    project: Project
    """Project whose captures, jobs and results the key gives access to; its name is made of a-z, 0-9 and -."""
    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
    """The holder of the key: a person or a program."""
    scope: Scope
    """The rights of the key."""
    expires_days: Annotated[float | None, Field(gt=0, le=36_500)] = None
    """Days after which requests with the key are refused; without it never."""
