"""relit import and relit info: make a capture of data laid out another way, and look at one."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.progress import ProgressBar
from service.cli.request_commands import HostOption, local_command
from service.requests.captures import ImportFormat, ImportRequest

CaptureArgument = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder with a capture.json.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "import", _import)
    app.command("info")(info)


def _import(request: ImportRequest) -> None:
    from stage.importers import diligent, lp, opencv_gray

    source, destination = request.source, request.destination
    if request.projector is not None:
        path = opencv_gray.import_folder(source, destination, projector=request.projector, calibration=request.calibration,
                                         unit_m=request.unit_m)
    else:
        module = {ImportFormat.DILIGENT: diligent, ImportFormat.LP: lp}[request.format]
        path = module.import_folder(source, destination)
    print(f"capture  {path}")


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
