"""Options of the commands that speak with a service, declared once.

What may be chosen about the work itself is taken from the commands that do it here.
"""

import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from service.client import Client

ServerOption = Annotated[str, typer.Option(
    "--server", metavar="URL", envvar="RELIT_SERVER", help="The service, as relit serve prints it.")]
KeyOption = Annotated[str | None, typer.Option(
    "--key", metavar="KEY", envvar="RELIT_KEY", show_default=False,
    help="Of relit keys create; better in the environment, where other users of this machine cannot see it.")]
WaitOption = Annotated[bool, typer.Option("--wait", help="Until the job has ended: exit code 0 if it succeeded, else 1.")]
ResultsOption = Annotated[Path | None, typer.Option(
    "--out", metavar="DIR", show_default=False, help="Wait, then fetch what the job made into this folder.")]
CancelOption = Annotated[bool, typer.Option(
    "--cancel-on-interrupt", help="Cancel the job when Ctrl-C ends the waiting; without it the job goes on.")]
NameOption = Annotated[str, typer.Option("--job-name", metavar="TEXT", help="Of the job, for people.", show_default=False)]
PriorityOption = Annotated[int, typer.Option("--priority", min=0, max=100, help="Higher goes first.")]

DEFAULT_SERVER = "http://127.0.0.1:8470"
DEFAULT_PRIORITY = 50
HERE = {"capture", "maps", "out", "environment", "keys", "reference_ball", "tof_calibration", "device", "cache", "only", "overwrite",
        "sheet", "report", "progress"}
"""Parameters of local commands that name files of this machine, or how it does the work: a service has others, or none."""


def options_of(*commands: Callable[..., None]) -> list[inspect.Parameter]:
    """What may be chosen about the work of local commands, each option once."""
    found: dict[str, inspect.Parameter] = {}
    for command in commands:
        for name, parameter in inspect.signature(command).parameters.items():
            if name not in HERE:
                found.setdefault(name, parameter)
    return list(found.values())


def with_parameters(function: Callable[..., None], own: Callable[..., Any], parameters: list[inspect.Parameter]) -> Callable[..., None]:
    """Make a function that takes anything by name a command with these parameters, and the name and help of another function."""
    by_name = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    function.__signature__ = inspect.Signature(by_name)  # type: ignore[attr-defined]
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in by_name}
    function.__name__, function.__doc__ = own.__name__, own.__doc__
    return function


@contextmanager
def connected(server: str, key: str | None) -> "Iterator[Client]":
    """A client; its errors become one sentence and exit code 2.

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
