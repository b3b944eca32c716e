"""The options of the commands that speak with a service, and the client that they use."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from service.client import Client

ServerOption = Annotated[str, typer.Option(
    "--server", metavar="URL", envvar="RELIT_SERVER", help="Address of the service, as relit serve prints it.")]
KeyOption = Annotated[str | None, typer.Option(
    "--key", metavar="KEY", envvar="RELIT_KEY", show_default=False,
    help="Key that relit keys create printed; set it in the environment, as other users of this machine see command lines.")]
WaitOption = Annotated[bool, typer.Option("--wait", help="Wait until the job has ended; the exit code is 0 if it succeeded, else 1.")]
ResultsOption = Annotated[Path | None, typer.Option(
    "--out", metavar="DIR", show_default=False, help="Wait until the job has ended, then fetch its results into this folder.")]
CancelOption = Annotated[bool, typer.Option(
    "--cancel-on-interrupt", help="Cancel the job when Ctrl-C ends the waiting; without it the job goes on.")]


@contextmanager
def connected(server: str, key: str | None) -> "Iterator[Client]":
    """Yield a client whose errors become one sentence and exit code 2.

    Raises:
        RequestError: the service says no, or does not answer.
    """
    from service.client import Client, ClientError
    from service.errors import RequestError

    try:
        with Client(server, key) as client:
            yield client
    except ClientError as error:
        raise RequestError(str(error)) from error
