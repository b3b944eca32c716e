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
    OPENCV_GRAY = "opencv-gray"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("import")(import_)
    app.command("info")(info)


def import_(
    format: Annotated[Format, typer.Argument(metavar="FORMAT", help="diligent, lp (RTI), or opencv-gray.", show_default=False)],
    source: Annotated[Path, typer.Argument(metavar="SRC", help="Folder of the data, or the .lp file.", show_default=False)],
    destination: Annotated[Path, typer.Argument(metavar="DST", help="Folder for the capture; may be SRC.", show_default=False)],
    projector: Annotated[str | None, typer.Option(
        "--projector", metavar="1280x800", help="opencv-gray: pixels of the projector.", show_default=False)] = None,
    calibration: Annotated[Path | None, typer.Option(
        "--calibration", help="opencv-gray: OpenCV file (.yml, .xml, .json) with both devices, R and T; "
                              "without it see relit calibrate procam.", show_default=False)] = None,
    unit_m: Annotated[float, typer.Option("--unit-m", help="opencv-gray: metres of one unit of T: 0.001 for millimetres.")] = 1.0,
    device: HostOption = None,
) -> None:
    """Write a capture.json for data laid out another way."""
    from service.errors import RequestError
    from stage.importers import diligent, lp

    if format is Format.OPENCV_GRAY:
        from service.cli.calibrate_projector import size
        from stage.importers import opencv_gray

        if projector is None:
            raise RequestError("--projector is missing: opencv-gray needs the projector's pixels to know how many bits there are")
        if not 0 < unit_m < float("inf"):
            raise RequestError(f"--unit-m {unit_m:g}: give metres above 0")
        path = opencv_gray.import_folder(source, destination, projector=size("--projector", projector), calibration=calibration,
                                         unit_m=unit_m)
        print(f"capture  {path}")
        return
    if projector is not None or calibration is not None or unit_m != 1.0:
        raise RequestError(f"--projector, --calibration and --unit-m are for opencv-gray, the format is {format}")
    module = {Format.DILIGENT: diligent, Format.LP: lp}[format]
    print(f"capture  {module.import_folder(source, destination)}")


def info(capture: CaptureArgument, device: HostOption = None) -> None:
    """Say what a capture holds, and what is wrong with it."""
    from service.captures.inspect import inspect
    from service.cli.bar import Bar
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
