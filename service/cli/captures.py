"""relit info: look at a capture."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.progress import ProgressBar
from service.cli.request_commands import HostOption

CaptureArgument = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder with a capture.json.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("info")(info)


def info(capture: CaptureArgument, device: HostOption = None) -> None:
    """Say what a capture holds, and what is wrong with it."""
    from service.captures.inspect import inspect
    from stage.errors import StageError

    with ProgressBar() as bar:
        found = inspect(capture, bar)
    for name, value in found.facts:
        print(f"{name:<12} {value}")
    for fault in found.faults:
        print(f"{'wrong':<12} {fault}")
    if found.faults:
        others = f" (and {len(found.faults) - 1} more, above)" if len(found.faults) > 1 else ""
        raise StageError(f"{found.faults[0]}{others}")
