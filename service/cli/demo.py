"""relit demo."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import DeviceOption

SERVICE = "service"
"""Folder of the service, in that of the demo."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("relit-demo"),
    device: DeviceOption = None,
    serve: Annotated[bool, typer.Option("--serve", help="Then open the service on it, for this machine alone.")] = False,
) -> None:
    """The main job on the shipped sample: solve, export, relight."""
    from service.cli.bar import Bar
    from service.demo.demo import demo as run

    with Bar() as bar:
        result = run(out, device=device, progress=bar)
    print(f"maps     {result.solved.maps_path}")
    print(f"report   {result.solved.report_path}")
    print(f"asset    {result.asset}")
    print(f"frames   {result.frames[0]} … {result.frames[-1].name}")
    print(f"picture  {result.preview}")
    if serve:
        open_service(out / SERVICE, device)


def open_service(data: Path, device: str | None) -> None:
    """A service for this machine alone, with the sample in it."""
    from service.cli.server import settings_of
    from service.demo.demo import sample_folder
    from service.server.sample import greet
    from service.server.serve import serve

    sample = sample_folder()
    serve(settings_of(None, data=data, host="127.0.0.1", anonymous=True, roots=(sample,), devices=(device,) if device else None),
          greet=lambda address, database, queue: greet(address, database, queue, sample))
