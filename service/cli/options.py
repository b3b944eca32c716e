"""Options that several commands take, declared once."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.bar import ProgressStyle

CaptureArgument = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder with a capture.json.", show_default=False)]
DeviceOption = Annotated[str | None, typer.Option("--device", help="cpu, cuda:0, …; without it the first CUDA device or the CPU.",
                                                  show_default=False)]


def _known(name: str | None) -> str | None:
    """Refuse a device that is not there, also where the work is the CPU's in any case."""
    if name is not None:
        from kernels.device import resolve

        resolve(name)
    return name


HostOption = Annotated[str | None, typer.Option(
    "--device", callback=_known, show_default=False,
    help="Taken by every command, so that scripts can name it once; this one works on the CPU in any case.")]
AlignOption = Annotated[bool, typer.Option(
    "--align", help="The subject moves: warp every frame to the time of the middle tracking frame (light type full). "
                    "The mask belongs to that time.")]
AlignToOption = Annotated[str | None, typer.Option(
    "--align-to", metavar="IMAGE", help="Align, to the time of this tracking frame.", show_default=False)]
CacheOption = Annotated[Path | None, typer.Option("--cache", help="Folder for the image stack; without it .relit in the capture.",
                                                  show_default=False)]
ProgressOption = Annotated[ProgressStyle, typer.Option(
    "--progress", help="bar: on a terminal; openjd: lines that a farm's worker reads (docs/farm.md).")]
