"""Options that several commands take, declared once."""

from pathlib import Path
from typing import Annotated

import typer

CaptureArgument = Annotated[Path, typer.Argument(metavar="CAPTURE", help="Folder with a capture.json.", show_default=False)]
DeviceOption = Annotated[str | None, typer.Option("--device", help="cpu, cuda:0, …; without it the first CUDA device or the CPU.",
                                                  show_default=False)]
CacheOption = Annotated[Path | None, typer.Option("--cache", help="Folder for the image stack; without it .relit in the capture.",
                                                  show_default=False)]
