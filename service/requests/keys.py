"""What `relit keys create` takes."""

from typing import Annotated

from pydantic import StringConstraints

from service.requests.base import Choice, Options
from service.requests.identifiers import Project


class Scope(Choice):
    """What a key allows; each scope allows what those before it do."""

    READ = "read", "see captures, jobs and results"
    WRITE = "write", "also upload, hand in jobs, cancel them, delete what is the project's"
    ADMIN = "admin", "also register folders of the server, and see /metrics"


class NewKey(Options):
    """Make a key and print it: it is kept as a hash alone, and cannot be shown again."""

    project: Project
    """Project whose captures, jobs and results the key opens: a-z, 0-9 and -."""
    name: Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]+$")]
    """Who holds the key: a person or a program."""
    scope: Scope
    """What the key allows."""
