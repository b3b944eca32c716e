"""What every job of the service has."""

from typing import Annotated

from pydantic import Field

from service.requests.base import Options, Role, Spelling


class JobRequest(Options):
    """Base of every job."""

    name: Annotated[str, Field(max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$"), Role.RUN, Spelling(flag="--job-name", metavar="TEXT")] = ""
    """Name of the job, shown in lists; it need not be unique."""
    priority: Annotated[int, Field(ge=0, le=100), Role.RUN] = 50
    """0 to 100: jobs of higher priority are done first, those of equal priority in the order of submission."""
