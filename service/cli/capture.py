"""relit import, relit info: captures in."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import CaptureArgument, HostOption


class Format(StrEnum):
    """Layouts that relit reads."""

    DILIGENT = "diligent"
    LP = "lp"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("import")(import_)
    app.command("info")(info)


def import_(
    format: Annotated[Format, typer.Argument(metavar="FORMAT", help="diligent, or lp (RTI).", show_default=False)],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="Folder of the data, or the .lp file.", show_default=False)],
    destination: Annotated[Path, typer.Argument(metavar="DST", help="Folder for the capture; may be SRC.", show_default=False)],
    device: HostOption = None,
) -> None:
    """Write a capture.json for data laid out another way."""
    from stage.importers import diligent, lp

    module = {Format.DILIGENT: diligent, Format.LP: lp}[format]
    print(f"capture  {module.import_folder(source, destination)}")


def info(capture: CaptureArgument, device: HostOption = None) -> None:
    """Say what a capture holds, and what is wrong with it."""
    from service.cli.bar import Bar
    from service.pipelines.inspect import inspect
    from stage.errors import StageError

    with Bar() as bar:
        found = inspect(capture, bar)
    for name, value in found.facts:
        print(f"{name:<12} {value}")
    for fault in found.faults:
        print(f"{'wrong':<12} {fault}")
    if found.faults:
        others = f" (and {len(found.faults) - 1} more, above)" if len(found.faults) > 1 else ""
        raise StageError(f"{found.faults[0]}{others}")
