"""relit info: look at a capture."""

import typer

from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.captures import InfoRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "info", _info)


def _info(request: InfoRequest) -> None:
    from service.captures.inspect import inspect
    from stage.errors import StageError

    with ProgressBar() as bar:
        found = inspect(request, bar)
    for name, value in found.facts:
        print(f"{name:<12} {value}")
    for finding in found.findings:
        print(f"{'finding':<12} {finding}")
    for fault in found.faults:
        print(f"{'wrong':<12} {fault}")
    if found.faults:
        others = f" (and {len(found.faults) - 1} more, above)" if len(found.faults) > 1 else ""
        raise StageError(f"{found.faults[0]}{others}")
